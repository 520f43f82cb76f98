"""The command `usvlearn`, also `python -m usvlearn`: from any folder what train.py and evaluate.py do in a checkout."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Sequence

import usvlearn

COMMANDS = {  # name -> the module whose `main` does it, and what it does
    "train": ("usvlearn.cli.train", "replay logs through estimators online, save parameter sets and predictions"),
    "evaluate": ("usvlearn.cli.evaluate", "judge saved runs, compare the jobs of a sweep, or make a study"),
    "example": ("usvlearn.cli.example", "write logs of a simulated boat, to try the other commands on"),
    "inspect": ("usvlearn.cli.inspect", "tell what own logs hold, and write the configuration that reads them"),
    "delay": ("usvlearn.cli.delay", "find the delay from the commands to the speed in own logs"),
    "export": ("usvlearn.cli.exporting", "write what was learned for C, MATLAB, CasADi, ONNX, Gazebo, MCAP, CSV"),
    "controller": ("usvlearn.cli.speed_controller", "design a speed controller from what a run has identified"),
    "plan": ("usvlearn.cli.plan", "tell what to sail next, so that the identified quantities become surer"),
    "live": ("usvlearn.cli.aboard", "learn aboard: a node on MOOS, MAVLink or ROS 2, and its status"),
    "warm": ("usvlearn.cli.warm", "compile everything ahead of need, when a boat's computer is set up"),
    "certify": ("certify.__main__", "prove whether the networks in parameter sets contract"),
}
USAGE = "usage: usvlearn COMMAND ARGUMENTS, usvlearn COMMAND --help or usvlearn --version"


def main(arguments: Sequence[str] | None = None) -> int:
    """Hand the arguments to a command; returns the exit code.

    >>> main(["--version"])
    usvlearn 0.2.0
    0
    """
    name, *rest = (sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if name in ("-h", "--help"):
        print(USAGE, "", *(f"  {each:12}{what}" for each, (_, what) in COMMANDS.items()), sep="\n")
        return 0
    if name == "--version":
        print("usvlearn", usvlearn.__version__)
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else "see usvlearn --help"
        print(f"error: found the command {name!r}, expected one of {', '.join(COMMANDS)}: {hint}", file=sys.stderr)
        return 2
    sys.argv = [f"usvlearn {name}", *rest]
    try:
        return importlib.import_module(COMMANDS[name][0]).main() or 0
    except ModuleNotFoundError as error:
        if (package := (error.name or "").partition(".")[0]) in ("", "usvlearn", "certify"):
            raise
        print(
            f"error: usvlearn {name} needs the package {package}, which is not installed (usvlearn-aboard leaves it "
            "out): use an environment where all of usvlearn is installed, by `pip install .`",
            file=sys.stderr,
        )
        return 2


if __name__ == "__main__":
    sys.exit(main())
