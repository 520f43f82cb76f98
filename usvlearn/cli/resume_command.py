"""The command that resumes an interrupted run or sweep."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from usvlearn.runs.file_names import JOURNAL, RUNS


def again(sweep: Path | None, run: Path | None) -> str:
    """The command that continues in the same folder, or starts anew if nothing was saved.

    Args:
        sweep: its folder, or None.
        run: the folder of the run that was stopped, or None.

    >>> again(Path("multirun/a"), None).endswith("hydra.sweep.dir=multirun/a")
    True
    """
    more = []
    if sweep is not None:
        more = [f"hydra.sweep.dir={sweep}"]
    elif run is not None and (run / RUNS).exists():
        more = [f"hydra.run.dir={run}", "resume=latest"]
    elif run is not None and (run / JOURNAL).exists():
        more = [f"hydra.run.dir={run}"]
    keys, script, *arguments = [each.partition("=")[0] for each in more], *sys.argv
    overrides = [each for each in arguments if each.startswith("~") or ("=" in each and not each.startswith("-"))]
    flags = [each for each in arguments if each not in overrides]  # flags must not stand between overrides
    kept = [each for each in overrides if each.partition("=")[0] not in keys]
    program = ["python", script] if script.endswith(".py") else script.split(" ")  # else the command `usvlearn train`
    return shlex.join([*program, *flags, *kept, *more])
