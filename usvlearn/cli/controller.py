"""The command `usvlearn controller RUN`: speed and steering controllers from what a run has identified.

It prints the feedforward, gains that hold over the identified intervals, their margins, how the closed loops follow on
boats that are drawn from the intervals, and the parameters for ArduRover, MOOS-IvP and PX4. Steering needs a fit.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from usvlearn.cli.plain_command import out_folder, without_key
from usvlearn.errors import complain

if TYPE_CHECKING:
    from usvlearn.estimators.joint.periodic_estimates import Identified
    from usvlearn.model.controller.design import Controller
    from usvlearn.model.read_boats import IdentifiedBoat

USAGE = "usage: usvlearn controller RUN [--boat NAME] [--out FOLDER] …; all options: usvlearn controller --help"


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("usvlearn controller", description=__doc__)
    parser.add_argument("path", metavar="RUN", type=without_key, help="the folder of a run, or a checkpoint")
    parser.add_argument("--boat", help="only this one")
    parser.add_argument("--speed", type=float, help="cruise speed, m/s (the middle of --range)")
    parser.add_argument(
        "--range", type=float, nargs=2, metavar=("LOW", "HIGH"),
        help="speeds at which the gains must hold, m/s (from a quarter of the top speed to 0.9 of its lower end)",
    )  # fmt: skip
    parser.add_argument("--bandwidth", type=float, help="ω of the wanted poles, rad/s (from time constant and delay)")
    parser.add_argument("--damping", type=float, help="ζ of the wanted poles (from the same, or 1 with --bandwidth)")
    parser.add_argument("--period", type=float, help="of the loop, s (that of the logged commands, at most 0.2)")
    parser.add_argument("--delay", type=float, help="of the commands, s (identified: their delay and lag)")
    parser.add_argument("--boats", type=int, default=200, help="drawn from the intervals for the closed loop (200)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws (0)")
    parser.add_argument("--out", metavar="FOLDER", help="write BOAT.controller.json, and a file for each autopilot")
    return parser


def work(arguments: Sequence[str]) -> None:
    """Design, print, and write."""
    given = vars(parser().parse_args(list(arguments)))
    path, name, out = given.pop("path"), given.pop("boat"), given.pop("out")
    from usvlearn.display import terminal
    from usvlearn.display.terminal import Activity

    with Activity(terminal.console(), "loading"):
        from usvlearn.model.controller.design import Wanted, controller, parts
        from usvlearn.model.read_boats import read_boats

    folder = None if out is None else out_folder(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    given["range"] = None if given["range"] is None else tuple(given["range"])
    wanted = Wanted(**given)
    with Activity(terminal.console(), "designing"):
        boats, designed = read_boats(path, name), []
        for online in boats:
            boat, fit = with_fit(path, online)
            boat.check_physical()
            designed.append(controller(boat, wanted, fit))
        names = [[] if folder is None else _write(folder, design) for design in designed]
    for number, design in enumerate(designed):
        terminal.show(*([""] if number else []), *parts(design))
        if folder is not None:
            terminal.show(f"Written to {folder}: {', '.join(names[number])}")


def with_fit(path: str, boat: IdentifiedBoat) -> tuple[IdentifiedBoat, Identified | None]:
    """The boat as the fit of its run knows it, and its fit where it has doubts."""
    from usvlearn.model.read_boats import read_boats
    from usvlearn.runs.files import CHECKPOINTS

    folder = Path(path).expanduser() / "fit"
    values = folder / f"{boat.name}.fit.json"
    if not (values.is_file() and (folder / CHECKPOINTS / boat.name).is_dir()):
        return boat, None
    (fitted,), doubts = read_boats(folder, boat.name), json.loads(values.read_text()).get("doubts")
    if not doubts:
        return fitted, None
    complain(f"warning: {boat.name}: speeds are as learned online, as its fit has doubts: {doubts[0]}")
    return boat, fitted.identified


def _write(folder: Path, design: Controller) -> list[str]:
    """Write all files of a boat; returns their names."""
    from usvlearn.core.checkpoint import write_atomically
    from usvlearn.model.controller.design import facts, files

    name = design.boat.stem
    written = {name + end: text for end, text in files(design).items()}
    written[f"{name}.controller.json"] = json.dumps(facts(design), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    for file, content in written.items():
        write_atomically(folder / file, content.encode())
    return list(written)
