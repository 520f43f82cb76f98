"""Compiles what a run, single steps and plans need when they are first used, for all estimators together."""

from __future__ import annotations

import os
import sys
import threading
import time
from functools import cache

import numpy as np

from usvlearn.core.family import WIDTH
from usvlearn.core.jit import NUMBA, announce
from usvlearn.core.prepared_samples import ROW, prepare_all
from usvlearn.engine import dispatch, forecasting, planar
from usvlearn.engine.background_compile import RUNS, STEPS, TRACKS, kernels
from usvlearn.engine.program import Program, program_for
from usvlearn.estimators.planar.state import PLACES

COMPILING = threading.RLock()  # a fork waits for it
PERIOD = 0.2  # s between two looks whether the command still runs


@cache
def compile_steps(dtype: np.dtype) -> None:
    """Compile what `Online` needs, for all estimators, unless that is done or cached on the disk."""
    if NUMBA.DISABLE_JIT:  # plain Python, for a debugger
        return
    plan, numbers, work = _smallest(dtype)
    with COMPILING, announce(dispatch.__file__, kernels(STEPS, dtype)):
        dispatch.surge_limit(plan.program, numbers[0])
        dispatch.step_once.disable_compile(False)
        state = np.zeros(plan.size, dtype)
        dispatch.step_once(plan.program, state, numbers[0], work, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, False)
        dispatch.step_once.disable_compile()  # from now on other types, such as int, are converted


@cache
def compile_runs(dtype: np.dtype) -> None:
    """Compile what a run needs, likewise. A program that makes single steps alone does not load it, to save memory."""
    if NUMBA.DISABLE_JIT:
        return
    plan, numbers, work = _smallest(dtype)
    samples, masks, column = np.zeros((1, 1), dtype), np.zeros((1, 1), bool), np.zeros(1, np.int64)
    rows, picks = np.zeros((1, 1, ROW), dtype), np.zeros((1, 1, 1), dtype)
    with COMPILING, announce(dispatch.__file__, kernels(RUNS, dtype)):
        limit = dispatch.surge_limit(plan.program, numbers[0])
        prepare_all(samples, samples, samples, samples, samples, samples, masks, masks, False, limit, rows)
        states = np.zeros((1, plan.size), dtype)
        none = np.zeros((1, 1, 0), dtype)
        dispatch.run(
            plan.program, plan.head, states, numbers, rows, none, column, False, column, samples, picks, work, 0, 0
        )
    if dispatch.run.stats.cache_misses:  # single steps need the same parts, which only this process has at hand
        compile_steps(dtype)


def _smallest(dtype: np.dtype) -> tuple[Program, np.ndarray, np.ndarray]:
    """The plan of one estimator without numbers, its numbers, and an array to work in."""
    plan = program_for({"kind": "persistence", "size": 0, "numbers": {}}, (), dtype)
    return plan, np.zeros((1, 1), dtype), np.zeros(plan.work, dtype)


@cache
def compile_planar(dtype: np.dtype) -> None:
    """Compile single steps of a boat in the plane, and its tracks, likewise."""
    compile_steps(dtype)
    if NUMBA.DISABLE_JIT:
        return
    plan, numbers, work = _smallest(dtype)
    with COMPILING, announce(dispatch.__file__, kernels(TRACKS, dtype)):
        state, pose, none = np.zeros(plan.size, dtype), np.zeros(5, dtype), np.zeros(0, dtype)
        wide = np.zeros(len(work) + 4 * ROW, dtype)
        dispatch.step_planar.disable_compile(False)
        dispatch.step_planar(
            plan.program, plan.head, state, numbers[0], wide, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, False, pose
        )
        dispatch.step_planar.disable_compile()
        zeros, head, program = (
            np.zeros(1000, dtype),
            np.zeros((4, PLACES), np.int64),
            np.zeros((1, 2 * WIDTH), np.int64),
        )
        planar.track_plan(
            program, head, zeros, zeros, zeros, none, none, none, np.zeros((0, planar.FOUND), dtype), zeros
        )


@cache
def compile_plans(dtype: np.dtype) -> None:
    """Compile what forecasts of plans need, unless that is done or cached on the disk."""
    compile_steps(dtype)
    if NUMBA.DISABLE_JIT:
        return
    numbers, none, program = np.zeros(2 * ROW, dtype), np.zeros(0, dtype), np.zeros((1, 2 * WIDTH), np.int64)
    with COMPILING, announce(forecasting.__file__, kernels("forecasts", dtype)):
        forecasts = np.zeros((0, 2), dtype)
        forecasting.forecast_plan(
            program, numbers, numbers, none, none, none, none, none, False, 1.0, numbers, forecasts, numbers
        )


def compile_all() -> None:
    """What the process of `background_compile` does, until the command that started it has ended."""
    dtype, parent = np.dtype(sys.argv[1]), os.getppid()

    def end_with_the_command() -> None:
        while os.getppid() == parent:
            time.sleep(PERIOD)
        os._exit(1)

    threading.Thread(target=end_with_the_command, daemon=True).start()
    compile_runs(dtype)
    compile_steps(dtype)
    if "tracks" in sys.argv[2:]:
        compile_planar(dtype)
