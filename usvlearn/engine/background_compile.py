"""Compiles in a second process what a first use needs, while this one imports torch, reads and aligns logs.

Compiling holds the GIL, so a thread would not help.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from usvlearn.core.jit import HERE, NUMBA, count_seconds, mark_of

DISPATCH = str(HERE / "engine" / "dispatch.py")
RUNS, STEPS, TRACKS = "runs", "single steps", "tracks"  # what needs kernels
CHILD = "from usvlearn.engine import first_use; first_use.compile_all()"


def kernels(of: str, dtype: object) -> str:
    """What is compiled, in words."""
    return f"kernels of {of}, {dtype}"


@contextmanager
def compile_ahead(dtype: str = "float64", tracks: bool = False) -> Iterator[subprocess.Popen | None]:
    """A context in whose background a process compiles the kernels, unless they are compiled; at its end they all are.

    One process compiles all, with `tracks` theirs, too: runs and single steps need most of the same. If it fails, or
    there is one processor alone, what needs the kernels compiles them.
    """
    parts = [kernels(of, dtype) for of in ((RUNS, STEPS, TRACKS) if tracks else (RUNS, STEPS))]
    wanted = not NUMBA.DISABLE_JIT and (os.cpu_count() or 1) > 1 and sys.executable
    search = os.pathsep.join(filter(None, (str(HERE.parent), os.environ.get("PYTHONPATH"))))
    quick = {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}  # numba colours errors that it then drops
    process = None
    if wanted and not all(mark_of(DISPATCH, each).exists() for each in parts):
        with suppress(OSError):
            process = subprocess.Popen(
                [sys.executable, "-c", CHILD, dtype, *(["tracks"] if tracks else [])],
                env={**os.environ, **quick, "PYTHONPATH": search},
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
    try:
        yield process
        if process is not None and process.poll() is None:
            from usvlearn.display.terminal import Activity, console  # a boat has no rich

            with Activity(console()), count_seconds(f"compiling the {parts[-1]}, only once …", "kept beside others"):
                process.wait()
    finally:
        if process is not None:
            process.kill()
            process.wait()
