"""The command `usvlearn live …`: a node aboard, which listens, predicts, learns, warns and saves."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from usvlearn.cli.warm import warm_live
from usvlearn.errors import ConfigError, did_you_mean, exit_on_user_error

USAGE = """usage: usvlearn live moos MISSION.moos [ALIAS]      on a MOOSDB
       usvlearn live mavlink udpin:127.0.0.1:14550  beside an autopilot
       usvlearn live ros2 [--ros-args …]            as a node of ROS 2
       usvlearn live status FOLDER                  what a node last knew
       usvlearn live warm                           compile everything ahead
Each has --help. A node starts from the newest readable checkpoint of its
folder, else from --start CHECKPOINT, else from a prior by --mass and
--surge-max. It needs no torch."""
SHELLS = {
    "moos": "usvlearn.live.moos.app",
    "mavlink": "usvlearn.live.mavlink.shell",
    "ros2": "usvlearn.live.ros2.shell",
}


def status(arguments: Sequence[str]) -> int:
    """Print what a node last knew."""
    from usvlearn.live.status import status_lines

    if len(arguments) != 1 or arguments[0].startswith("-"):
        print("usage: usvlearn live status FOLDER")
        return 0 if arguments in (["-h"], ["--help"]) else 2
    print(*status_lines(Path(arguments[0]).expanduser()), sep="\n")
    return 0


COMMANDS: dict[str, Callable[[Sequence[str]], int]] = {"status": status, "warm": warm_live}


def work(arguments: Sequence[str]) -> int:
    """Do one of the commands; returns the exit code."""
    name, *rest = arguments
    if name in COMMANDS:
        return COMMANDS[name](rest)
    if name in SHELLS:
        code: int = importlib.import_module(SHELLS[name]).main(rest)
        return code
    known = [*SHELLS, *COMMANDS]
    raise ConfigError(f"live: found {name!r}, expected one of {', '.join(known)}{did_you_mean(name, known)}")


def main() -> int:
    """The command; returns the exit code."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        return 0
    with exit_on_user_error():
        return work(arguments)


def moos_app() -> int:
    """The program `pUSVLearn`, as which pAntler starts `usvlearn live moos`; returns the exit code."""
    with exit_on_user_error():
        return work(["moos", *sys.argv[1:]])
