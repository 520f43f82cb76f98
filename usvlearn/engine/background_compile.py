"""Compiles in a second process what a first use needs, while this one imports torch, reads and aligns logs.

Compiling holds the GIL, so a thread would not help.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from usvlearn.core.jit import HERE, NUMBA, counted, mark_of

DISPATCH = str(HERE / "engine" / "dispatch.py")
CHILD = f"import {__name__} as ahead; ahead.compile_all()"
PERIOD = 0.2  # s


class Ahead:
    """The process, if there is one.

    Args:
        dtype: name of that of the runs.
        tracks: whether they have tracks, too.
    """

    def __init__(self, dtype: str, tracks: bool):
        self._told = tempfile.TemporaryFile()  # the process writes there the share that is done
        search = os.pathsep.join(filter(None, (str(HERE.parent), os.environ.get("PYTHONPATH"))))
        quick = {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}  # numba colours errors that it then drops
        more = ["tracks"] if tracks else []
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", CHILD, dtype, *more], env={**os.environ, **quick, "PYTHONPATH": search},
                stdin=subprocess.DEVNULL, stdout=self._told, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError:
            self._told.close()
            raise

    def share(self) -> float:
        """What is done of the kernels of runs, 0 to 1; 0 where a file cannot be read beside its writer."""
        if not hasattr(os, "pread"):
            return 0.0
        size = os.fstat(self._told.fileno()).st_size
        lines = os.pread(self._told.fileno(), 64, max(0, size - 64)).split(b"\n")
        with suppress(ValueError, IndexError):
            return float(lines[-2])
        return 0.0

    def lives(self) -> bool:
        """Whether it is still compiling."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Until all is compiled; or until the process has ended, whatever the cause."""
        self._process.wait()

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._told.close()


running: list[Ahead] = []  # one at most


def runs_of(dtype: object) -> str:
    """What a run needs, in words."""
    return f"kernels of runs, {dtype}"


def steps_of(dtype: object) -> str:
    """What single steps need, in words."""
    return f"kernels of single steps, {dtype}"


def tracks_of(dtype: object) -> str:
    """What single steps with tracks need, in words."""
    return f"kernels of tracks, {dtype}"


def share() -> float:
    """What the process, if there is one, has done."""
    return sum(each.share() for each in running)


@contextmanager
def compiling(dtype: str = "float64", tracks: bool = False) -> Iterator[None]:
    """A context in whose background the kernels are compiled, unless they are; at its end they all are.

    One process compiles them all: what it has compiled for runs is most of single steps, and of those with tracks.

    Where the process fails, or there is one processor alone, what needs the kernels compiles them, as without it.
    """
    wanted = not NUMBA.DISABLE_JIT and not running and (os.cpu_count() or 1) > 1 and sys.executable
    parts = (runs_of, steps_of, tracks_of) if tracks else (runs_of, steps_of)
    if not wanted or all(mark_of(DISPATCH, each(dtype)).exists() for each in parts):
        yield
        return
    try:
        running.append(Ahead(dtype, tracks))
    except OSError:  # no process, or no temporary file
        yield
        return
    try:
        yield
        if running[0].lives():
            with counted(f"usvlearn: compiling the {parts[-1](dtype)}, only once …", "kept beside the others"):
                running[0].wait()
    finally:
        running.pop().stop()


def compile_all() -> None:
    """What the process does."""
    import threading

    import numpy as np

    from usvlearn.core.jit import of_parts
    from usvlearn.engine.first_use import compile_planar, compile_runs, compile_steps

    dtype, done, parent = np.dtype(sys.argv[1]), of_parts(), os.getppid()

    def tell() -> None:
        while os.getppid() == parent:  # nobody needs this after the command was killed
            print(done(), flush=True)
            time.sleep(PERIOD)
        os._exit(1)

    threading.Thread(target=tell, daemon=True).start()
    compile_runs(dtype)
    compile_steps(dtype)
    if "tracks" in sys.argv[2:]:
        compile_planar(dtype)
