"""The command `usvlearn fit RUN`: the best parameters that a run's logs can give, beside those learned online."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from usvlearn.cli.forgiving import without_key
from usvlearn.cli.without_hydra import out_folder, run_command
from usvlearn.errors import CheckpointError, ConfigError, UsvlearnError

if TYPE_CHECKING:
    from usvlearn.core.samples import Fleet
    from usvlearn.model.fit.fitted import Fitted

USAGE = (
    "usage: usvlearn fit RUN [--boat NAME] [--terms SET] [--out FOLDER] [data.KEY=VALUE …]; more: usvlearn fit --help"
)


def parser() -> argparse.ArgumentParser:
    found = argparse.ArgumentParser("usvlearn fit", description=__doc__)
    found.add_argument("run", metavar="RUN", type=without_key, help="the folder of a run")
    found.add_argument("data", metavar="data.KEY=VALUE", nargs="*", help="such as data.path=LOGS, if they have moved")
    found.add_argument("--boat", help="only this one")
    found.add_argument(
        "--terms", metavar="SET", help="of the model, in place of the one that does best on unseen missions"
    )
    found.add_argument("--out", metavar="FOLDER", help="where BOAT.fit.json is written (RUN/fit)")
    return found


def work(arguments: Sequence[str]) -> None:
    """Fit each boat, print, and write.

    Raises:
        ConfigError: there is no run, no such boat or set of terms, or too little was measured.
        UsvlearnError: the logs cannot be read.
    """
    given = parser().parse_args(list(arguments))
    folder = Path(given.run).expanduser()
    out = folder / "fit" if given.out is None else out_folder(given.out)
    from usvlearn.display import terminal
    from usvlearn.display.activity_bar import Activity

    console = terminal.console()
    with Activity(console, "loading"):
        from usvlearn.model.fit.fitted import check_terms, fit_boat
        from usvlearn.model.fit.logs import missions_of
        from usvlearn.model.fit.shown import tables
        from usvlearn.model.fit.terms import SETS
        from usvlearn.model.read_boats import read_boats
        from usvlearn.runs.saved import configuration

        check_terms(given.terms)
        settings = configuration(folder)
        fleet = _logs(settings, given.data)
    if given.boat is not None and given.boat not in fleet.boats:
        raise ConfigError(f"--boat: found {given.boat!r}, expected one of {', '.join(fleet.boats)}")
    mass, top = float(settings["vehicle"]["mass"]), float(settings["vehicle"]["surge_max"])
    try:
        online = {each.name: each.found for each in read_boats(folder, given.boat)}
    except (CheckpointError, ConfigError):  # an ensemble that identifies nothing online
        online = {}
    boats = [boat for boat in fleet.boats if given.boat in (None, boat)]
    missions, fitted = [missions_of(fleet, boat) for boat in boats], []
    with Activity(console) as activity:
        activity.begin("fitting", total=len(boats) * len(SETS))
        for boat, rows in zip(boats, missions, strict=True):

            def advance(name: str, boat: str = boat) -> None:
                activity.tell(f"fitting {boat}: {name}")
                activity.advance(1)

            fitted.append(fit_boat(boat, rows, mass, top, given.terms, advance))
    for number, each in enumerate(fitted):
        if number:
            console.print()
        console.print(*tables(each, online.get(each.boat)), sep="\n")
        terminal.show(f"Written to {_write(out, each)}")


def _logs(settings: dict[str, Any], changed: Sequence[str]) -> Fleet:
    """The run's logs on the grid of the fit."""
    import yaml

    from usvlearn.cli.settings import instantiate
    from usvlearn.logs.recordings import align_fleet
    from usvlearn.model.fit.logs import DT

    data = dict(settings["data"])
    for each in changed:
        key, equals, value = each.partition("=")
        name = key.removeprefix("data.")
        if not equals or key == name:
            raise ConfigError(f"found {each!r}, expected data.KEY=VALUE, such as data.path=LOGS")
        try:
            data[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"{key}: found {value!r}, expected a value as YAML has them") from error
    try:
        recordings = list(instantiate(data))
    except UsvlearnError as error:
        hint = "" if "path" not in data else f"; if the logs have moved, give data.path=FOLDER (found {data['path']!r})"
        raise type(error)(f"{error}{hint}") from error
    return align_fleet(recordings, **{**settings["align"], "dt": DT, "steps": "grid"})


def _write(folder: Path, found: Fitted) -> Path:
    from usvlearn.core.checkpoint import write_atomically

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{found.boat}.fit.json"
    write_atomically(path, (json.dumps(found.json(), indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())
    return path


def main() -> int:
    """The command; returns the exit code."""
    return run_command(work, USAGE)
