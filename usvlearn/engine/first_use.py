"""What a run and `Online` need is compiled together, when it is first used."""

from __future__ import annotations

import threading
from functools import cache

import numpy as np

from usvlearn.engine import dispatch, forecasting
from usvlearn.engine.program import plan_for
from usvlearn.family import WIDTH
from usvlearn.jit import NUMBA, announced
from usvlearn.rows import ROW, prepare_all

COMPILING = threading.RLock()  # a fork waits for it


@cache
def compile_steps(dtype: np.dtype) -> None:
    """Compile what a run and `Online` need, for all estimators, unless that is done or cached on the disk."""
    if NUMBA.DISABLE_JIT:  # plain Python, for a debugger
        return
    plan = plan_for({"kind": "persistence", "size": 0, "numbers": {}}, (), dtype)
    lanes, numbers, work = np.zeros((1, plan.size), dtype), np.zeros((1, 1), dtype), np.zeros(plan.work, dtype)
    samples, masks, column = np.zeros((1, 1), dtype), np.zeros((1, 1), bool), np.zeros(1, np.int64)
    rows, picks = np.zeros((1, 1, ROW), dtype), np.zeros((1, 1, 1), dtype)
    with COMPILING, announced(dispatch.__file__, f"kernels of runs and single steps, {dtype}"):
        limit = dispatch.surge_limit(plan.program, numbers[0])
        prepare_all(samples, samples, samples, samples, samples, samples, masks, masks, False, limit, rows)
        dispatch.run(plan.program, lanes, numbers, rows, column, False, column, samples, picks, work, 0, 0)
        dispatch.step_once.disable_compile(False)
        dispatch.step_once(plan.program, lanes[0], numbers[0], work, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, False)
        dispatch.step_once.disable_compile()  # from now on other types, such as int, are converted


@cache
def compile_plans(dtype: np.dtype) -> None:
    """Compile what forecasts of plans need, unless that is done or cached on the disk."""
    compile_steps(dtype)
    if NUMBA.DISABLE_JIT:
        return
    numbers, none, program = np.zeros(2 * ROW, dtype), np.zeros(0, dtype), np.zeros((1, 2 * WIDTH), np.int64)
    with COMPILING, announced(forecasting.__file__, f"kernels of forecasts, {dtype}"):
        found = np.zeros((0, 2), dtype)
        forecasting.forecast_plan(
            program, numbers, numbers, none, none, none, none, none, False, 1.0, numbers, found, numbers
        )
