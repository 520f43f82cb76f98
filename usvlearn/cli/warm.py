"""The command `usvlearn warm [float32]`: compile all that a boat needs ahead of its first run. It needs no torch."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np

USAGE = "usage: usvlearn warm [float32]; float32 also compiles the estimators' kernels of that precision"


def warm(float32: bool = False) -> Path:
    """Compile estimators, alignment and, where torch is installed, the simulator; returns the folder of the code.

    What is compiled already is only read.

    Args:
        float32: compile the estimators' kernels for float32, too.
    """
    from usvlearn.engine import dispatch
    from usvlearn.engine.first_use import compile_steps
    from usvlearn.engine.free_runs import compile_free_runs
    from usvlearn.jit import folder
    from usvlearn.logs.align import Aligner
    from usvlearn.logs.channel import REQUIRED, Source

    Aligner({name: Source(name) for name in REQUIRED})
    if importlib.util.find_spec("torch") is not None:
        from usvlearn.simulate.fleet import fleet

        fleet(n=1, hours=0.01)
    for dtype in map(np.dtype, (np.float64, np.float32) if float32 else (np.float64,)):
        compile_steps(dtype)
        compile_free_runs(dtype)
    return folder(Path(dispatch.__file__)).parent


def main() -> int:
    """The command; returns the exit code."""
    arguments = sys.argv[1:]
    if arguments in (["-h"], ["--help"]):
        print(USAGE)
        return 0
    if arguments not in ([], ["float32"]):
        print(f"error: found {' '.join(arguments)!r}, expected nothing or float32: {USAGE}", file=sys.stderr)
        return 2
    print(f"usvlearn: everything is compiled; it is kept in {warm(bool(arguments))}")
    return 0
