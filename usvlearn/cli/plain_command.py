"""Runs a command without Hydra: usage, one sentence for bad input, exit codes."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from usvlearn.errors import ConfigError, columns_of, complain, exit_on_user_error, folded


def run_command(work: Callable[[Sequence[str]], None], usage: str) -> int:
    """Do the work of a command with the arguments of this program, or print its usage; returns the exit code."""
    from usvlearn.cli.signals import Stopped, stoppable

    if not sys.argv[1:]:
        print(folded(usage, columns_of(sys.stderr)), file=sys.stderr)
        return 2
    try:
        with exit_on_user_error(), stoppable():
            work(sys.argv[1:])
    except Stopped as stopped:
        complain(f"{stopped}; nothing was written")
        return stopped.code
    return 0


def out_folder(given: str, option: str = "--out") -> Path:
    """The folder that an option names, which need not exist."""
    folder = Path(os.path.expanduser(given))
    if not given or (folder.exists() and not folder.is_dir()):
        raise ConfigError(f"{option}: found {'the file ' * bool(given)}{given!r}, expected a folder")
    return folder


def without_key(word: str) -> str:
    """The folder of a run, also where a user writes `runs=FOLDER` or `run=FOLDER`, as for evaluate."""
    return word.removeprefix("runs=").removeprefix("run=")
