"""Compiling ahead of need, when the computer of a boat is set up: `usvlearn warm [float32]`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from usvlearn.engine import dispatch
from usvlearn.engine.first_use import compile_steps
from usvlearn.engine.free_runs import compile_free_runs
from usvlearn.jit import folder


def warm(float32: bool = False) -> Path:
    """Compile the kernels of runs, single steps and free runs in float64; returns the folder of the cache.

    Cached kernels are not compiled again.

    Args:
        float32: also compile them for float32.
    """
    for dtype in map(np.dtype, (np.float64, np.float32) if float32 else (np.float64,)):
        compile_steps(dtype)
        compile_free_runs(dtype)
    return folder(Path(dispatch.__file__)).parent


def main() -> int:
    """`usvlearn warm [float32]`; returns the exit code."""
    arguments = sys.argv[1:]
    if arguments not in ([], ["float32"]):
        wanted = "nothing, or float32 to compile the kernels of float32, too"
        print(f"usage: usvlearn warm [float32]; found {' '.join(arguments)}, expected {wanted}", file=sys.stderr)
        return 0 if arguments in (["-h"], ["--help"]) else 2
    print(f"usvlearn: the kernels are compiled; they are kept in {warm(bool(arguments))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
