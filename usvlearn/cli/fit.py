"""The command `usvlearn fit RUN`: the best parameters that a run's logs can give, beside those learned online."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from usvlearn.cli.plain_command import out_folder, without_key
from usvlearn.cli.signals import Stopped, was_stopped
from usvlearn.errors import CheckpointError, ConfigError, UsvlearnError, complain, did_you_mean

if TYPE_CHECKING:
    from rich.console import Console

    from usvlearn.core.samples import Fleet
    from usvlearn.model.fit.fitted import Fitted
    from usvlearn.model.fit.hand_over import Last
    from usvlearn.model.fit.open_loop import FreeMode
    from usvlearn.report.summary import Quantities

USAGE = (
    "usage: usvlearn fit RUN [--boat NAME] [--terms SET] [--out FOLDER] [--all] [data.KEY=VALUE …]; more: usvlearn fit "
    "--help"
)
SHOWN, TRUST = 4, "trust="  # names in a warning; before a module that is trusted


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("usvlearn fit", description=__doc__)
    parser.add_argument("run", metavar="RUN", type=without_key, help="the folder of a run")
    parser.add_argument("data", metavar="KEY=VALUE", nargs="*", help="data.path=LOGS; trust=MODULE, which reads them")
    parser.add_argument("--boat", help="only this one")
    parser.add_argument("--terms", metavar="SET", help="of the model, in place of what is best on unseen missions")
    parser.add_argument("--out", metavar="FOLDER", help="where BOAT.fit.json is written (RUN/fit)")
    parser.add_argument("--all", action="store_true", help="print all quantities, sets of terms and remarks")
    return parser


def work(arguments: Sequence[str], console: Console | None = None, trust: Any = None) -> dict[str, Quantities]:
    """Fit each boat, print, and write; on the way of another command, on its console. Returns what is to be used."""
    given = parser().parse_intermixed_args([each for each in arguments if not each.startswith(TRUST)])
    trust = trust or [each.removeprefix(TRUST) for each in arguments if each.startswith(TRUST)]
    folder = Path(given.run).expanduser()
    out = folder / "fit" if given.out is None else out_folder(given.out)
    if (folder / "missions").is_dir():
        from usvlearn.cli.refit import refit

        if given.boat or given.terms or given.out or given.data:
            raise ConfigError(f"{folder}: is the folder of a node, whose missions are fitted without options")
        print(f"{refit(folder)}\nvalues: usvlearn live status {folder}")
        return {}
    from usvlearn.display import terminal
    from usvlearn.display.terminal import Activity

    alone, console = console is None, console or terminal.console()
    with Activity(console, "loading"):
        from usvlearn.core.unconfirmed import open_questions, unconfirmed
        from usvlearn.model.fit.fitted import check_terms, fit_boat
        from usvlearn.model.fit.hand_over import last_of, write
        from usvlearn.model.fit.logs import missions_of, without_losses
        from usvlearn.model.fit.shown import tables
        from usvlearn.model.fit.terms import SETS
        from usvlearn.report.summary import displayed, summary
        from usvlearn.report.tables import quoted
        from usvlearn.runs.files import CHECKPOINTS
        from usvlearn.runs.saved import configuration, results

        check_terms(given.terms)
        _check_run(folder)
        settings = configuration(folder, trust, ["estimators", "combiners", "forecasts"])
        data = _changed_data(settings["data"], given.data)
        coarse, fine = _logs(folder, settings, data)
        changed = _changed(folder, coarse)
    if given.boat is not None and given.boat not in fine.boats:
        hint = did_you_mean(given.boat, fine.boats)
        raise ConfigError(f"--boat: found {given.boat!r}, expected one of {', '.join(fine.boats)}{hint}")
    mass, top = float(settings["vehicle"]["mass"]), float(settings["vehicle"]["surge_max"])
    missions = {boat: missions_of(fine, boat) for boat in fine.boats if given.boat in (None, boat)}
    for sentence in changed.values():
        complain(f"warning: {sentence}")
    events = results(folder).get("events", {})
    for boat in [each for each in missions if each not in changed]:
        missions[boat] = without_losses(boat, missions[boat], events.get(boat, []))
    fitted: Fitted | None = None
    done: list[tuple[Fitted, Last | None, list[Path]]] = []
    stopped: Stopped | None = None
    with Activity(console) as activity:
        activity.begin("fitting", total=len(missions) * (len(SETS) + 2))
        for boat, rows in missions.items():

            def advance(name: str, boat: str = boat) -> None:
                activity.tell(f"fitting {boat}: {name}")
                activity.advance(1)

            try:
                last = last_of(folder / CHECKPOINTS / boat)
                online = None if last is None else last.online
                fitted = fit_boat(boat, rows, mass, top, given.terms, advance, Stopped, online)
                stopped = None if set(SETS) <= set(fitted.fits) else was_stopped() or Stopped(signal.SIGINT)
                if stopped is None and boat not in changed:
                    advance("on half of the missions")
                    fitted = replace(fitted, simulation=_simulation(folder, fitted, fine, coarse))
            except Stopped as received:
                stopped = received
                if fitted is None or fitted.boat != boat:
                    break
            done.append((fitted, last, write(out, fitted, last, float(settings["align"]["dt"]))))
            if stopped is not None:
                break
    if stopped is not None and not done:
        raise stopped
    whole = given.all if alone else terminal.ALL in terminal.asked
    use: dict[str, Quantities] = {x.boat: displayed(x.identified) for x, *_ in done if not x.doubts}
    for fitted, last, files in done:
        if whole or (alone and len(done) == 1):
            console.print(*tables(fitted, None if last is None else last.online, whole), sep="\n")
            terminal.show(f"Written to {', '.join(map(str, files))}", to=console)
        else:
            terminal.show(*(f"{fitted.boat}: its fit is not to be used: {each}" for each in fitted.doubts), to=console)
    asked = open_questions({**settings, "data": data})
    if alone:
        terminal.show(*unconfirmed(asked), "", to=console)
    if out == folder / "fit":
        _add_to_results(folder, [each for each, _, _ in done])
        if alone and not given.data and (scored := results(folder)):
            terminal.show(*summary(scored, asked, use), f"next         usvlearn evaluate {quoted(folder)}")
    if stopped is not None:
        raise SystemExit(stopped.code)
    return use


def fit_on_the_way(folder: Path, console: Console, trust: Any = None) -> dict[str, Quantities]:
    """Fit a run for a command that goes on without a fit, too; returns the quantities that are to be used."""
    try:
        return work([str(folder.absolute())], console, trust)
    except (ValueError, ArithmeticError, OSError) as error:  # also of a folder that is only read
        complain(f"warning: no fit was made: {error}")
        return {}


def _check_run(folder: Path) -> None:
    """Raise a ConfigError if there is no folder, or that of a fit."""
    from usvlearn.runs.files import RUNS

    if not folder.is_dir():
        raise ConfigError(f"{folder}: there is no such folder: give that of a run, which train has written")
    if folder.name == "fit" and not (folder / RUNS).exists() and (folder.resolve().parent / RUNS).exists():
        raise ConfigError(f"{folder}: is the folder of a fit: give that of its run, {folder.parent}")


def _changed_data(settings: Mapping[str, Any], changed: Sequence[str]) -> dict[str, Any]:
    """The settings of the logs, with what the user gives in their place."""
    import yaml

    data = dict(settings)
    for each in changed:
        key, equals, value = each.partition("=")
        name = key.removeprefix("data.")
        if not equals or key == name:
            raise ConfigError(f"found {each!r}, expected data.KEY=VALUE, such as data.path=LOGS")
        if name not in (keys := [each for each in data if not each.startswith("_")]):
            raise ConfigError(f"{key}: expected a key of the run's logs: {', '.join(keys)}{did_you_mean(name, keys)}")
        try:
            data[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise ConfigError(f"{key}: found {value!r}, expected a value as YAML has them") from error
    return data


def _logs(folder: Path, settings: Mapping[str, Any], data: Mapping[str, Any]) -> tuple[Fleet, Fleet]:
    """The run's logs, on its own grid and on that of the fit."""
    from usvlearn.composition.configuration import instantiate
    from usvlearn.logs.recordings import align_fleet
    from usvlearn.model.fit.logs import fine

    path = data.get("path")
    try:
        recordings = list(instantiate(dict(data)))
    except UsvlearnError as error:
        gone = isinstance(path, str) and not Path(path).expanduser().exists()
        hint = f". If the logs have moved, give data.path=FOLDER (found {path!r})" if gone else ""
        raise type(error)(f"{error}{hint}") from error
    learned, boats = list(_runs(folder)), list(dict.fromkeys(each.boat for each in recordings))
    if learned and not set(boats) <= set(learned):
        if len(learned) > 1 or len(boats) > 1:
            raise ConfigError(
                f"the logs are of {', '.join(boats)}, and the run has learned {', '.join(learned)}: give its logs by "
                "data.path"
            )
        recordings = [
            each._replace(boat=learned[0]) for each in recordings
        ]  # named after their folder, which has moved
    return align_fleet(recordings, **settings["align"]), align_fleet(recordings, **fine(settings["align"]))


def _runs(folder: Path) -> dict[str, Any]:
    """Name, length and digest of each run that was learned, by boat; {} without an index."""
    from usvlearn.runs.files import runs_file

    try:
        runs: dict[str, Any] = runs_file(folder)["boats"]
        return runs
    except CheckpointError:
        return {}


def _changed(folder: Path, fleet: Fleet) -> dict[str, str]:
    """A sentence for each boat whose logs are not those of which the run has learned."""
    from usvlearn.runs.files import digest

    changes = {}
    for boat, runs in _runs(folder).items():
        if boat not in fleet.boats:
            continue
        element = fleet.boats.index(boat)
        now = {digest(run, element): run.names[element] for run in fleet.runs if run.lengths[element]}
        then = {key: name for name, length, key in runs if length}
        other, gone = ([a[key] for key in a if key not in b] for a, b in ((now, then), (then, now)))
        if differ := list(dict.fromkeys([*other, *gone])):
            more = f" and {len(differ) - SHOWN} more" if len(differ) > SHOWN else ""
            changes[boat] = (
                f"{boat}: the run has not learned these logs as they are now: {', '.join(differ[:SHOWN])}{more}. "
                "The fit takes them as they are"
            )
    return changes


def _simulation(folder: Path, fitted: Fitted, fine: Fleet, coarse: Fleet) -> FreeMode:
    """Which open-loop simulation to use, by the errors of the ensemble in the run's folder."""
    from usvlearn.evaluation.comparison import from_csv
    from usvlearn.evaluation.free_simulation import middle
    from usvlearn.evaluation.objective import FREE
    from usvlearn.model.fit.open_loop import ENSEMBLE, NOTHING, decide
    from usvlearn.runs.files import ERRORS

    try:
        errors = from_csv((folder / ERRORS).read_text())
    except (OSError, ValueError):  # the run was stopped before its end
        return NOTHING
    ensemble = {
        each.run: each.mae[ENSEMBLE]
        for each in errors
        if each.boat == fitted.boat and each.ahead == FREE and ENSEMBLE in each.mae
    }
    return decide(fitted.boat, fitted.chosen, fitted.fit.top, fine, coarse, middle(coarse.runs), ensemble)


def _add_to_results(folder: Path, fitted: Sequence[Fitted]) -> None:
    """Say in `results.json` which terms were chosen, and which open-loop simulation to use."""
    from usvlearn.runs.files import RESULTS, save_results
    from usvlearn.runs.saved import results

    if not (folder / RESULTS).exists() or not (known := results(folder)):
        return
    keys = ["terms", "doubts", "quantities"] + ["simulation"] * all(each.simulation for each in fitted)
    new = {x.boat: {"use": not x.doubts, **{k: x.json()[k] for k in keys}} for x in fitted}
    save_results(folder, known | {"fit": known.get("fit", {}) | new})
