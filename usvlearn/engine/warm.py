"""Compiling ahead of need, when the computer of a boat is set up: `usvlearn warm [float32]`."""

from __future__ import annotations

import sys
import threading
from functools import cache
from pathlib import Path

import numpy as np
from numba import config

from usvlearn.engine import dispatch
from usvlearn.engine.program import plan_for
from usvlearn.jit import announced, folder
from usvlearn.rows import ROW, prepare_all

COMPILING = threading.RLock()  # a fork waits for it


@cache
def compile_steps(dtype: np.dtype) -> None:
    """Compile what a run and `Online` need, for all estimators, unless that is done or kept on the disk."""
    if config.DISABLE_JIT:  # plain Python, for a debugger
        return
    plan = plan_for({"kind": "persistence", "size": 0, "numbers": {}}, (), dtype)
    lanes, numbers, work = np.zeros((1, plan.size), dtype), np.zeros((1, 1), dtype), np.zeros(plan.work, dtype)
    samples, masks, column = np.zeros((1, 1), dtype), np.zeros((1, 1), bool), np.zeros(1, np.int64)
    rows, picks = np.zeros((1, 1, ROW), dtype), np.zeros((1, 1, 1), dtype)
    with COMPILING, announced(dispatch.__file__, f"kernels of runs and single steps, {dtype}"):
        limit = dispatch.surge_limit(plan.program, numbers[0])
        prepare_all(*[samples] * 6, masks, masks, False, limit, rows)
        dispatch.run(plan.program, lanes, numbers, rows, column, False, column, samples, picks, work, 0, 0)
        dispatch.step_once.disable_compile(False)
        dispatch.step_once(plan.program, lanes[0], numbers[0], work, *[0.0] * 6, False, False)
        dispatch.step_once.disable_compile()  # whole numbers and the like become what it was compiled for


def warm(float32: bool = False) -> Path:
    """Compile the kernels of runs, single steps and free runs, in float64; returns the folder that keeps them.

    What is kept already is only read.

    Args:
        float32: compile them for float32, too.
    """
    from usvlearn.engine.free_runs import compile_free_runs  # which runs by what is compiled above

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
