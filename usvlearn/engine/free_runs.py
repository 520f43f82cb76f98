"""Free simulations scored while they run: the sums that `evaluation.crossval` needs, without storing predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from usvlearn.core.family import WIDTH
from usvlearn.core.jit import announced, jit
from usvlearn.core.rows import DT, LEARN, MODE, PREDICT, ROW, START, SURGE
from usvlearn.core.samples import Sample
from usvlearn.engine.dispatch import Whole, mask_diverged, step, surge_max
from usvlearn.engine.first_use import compile_runs
from usvlearn.engine.leaves import Description
from usvlearn.engine.program import plan_for
from usvlearn.engine.run import in_parallel, prepared
from usvlearn.estimators.ensemble.combiners.kernel import combine, fill_sleeping, learn_rule
from usvlearn.estimators.ensemble.state import AT


@jit
def add_up(prediction, surge, limit, learns, total):
    """Add |error| and error², and note whether the simulation diverged."""
    if not abs(prediction) < limit:
        total[2] = 1.0
        prediction = -limit if prediction < 0 else limit
    if learns:
        error = abs(prediction - surge)
        total[0] += error
        total[1] += error * error


@jit(entry=True)
def assess(program, states, others, q, rows, columns, learning, totals, work, first, last):
    """Lanes first … last − 1 run free; the rules `learning` run once more with states `others`, which go on learning.

    `totals` is `(lanes, names + learning, 3)`, and is added to.
    """
    whole = program[0]
    n, names, limit = whole[Whole.ESTIMATORS], whole[Whole.NAMES], surge_max(program, q[0])
    awake, x, rest = work[:n], work[n : 2 * n], work[2 * n :]
    for lane in range(first, last):
        s, other, numbers, total = states[lane], others[lane], q[lane if len(q) > 1 else 0], totals[lane]
        predictions = s[whole[AT.predictions] : whole[AT.predictions] + names]
        for k in range(rows.shape[1]):
            row = rows[columns[lane], k]
            learns = row[MODE] == LEARN
            step(program, s, numbers, row, PREDICT if learns else row[MODE], work)
            if row[MODE] <= START:
                continue
            for i in range(names):
                add_up(predictions[i], row[SURGE], limit, learns, total[i])
            mask_diverged(predictions, limit, awake)
            for i in range(len(learning)):
                rule = program[1 + n + learning[i]]
                asleep = fill_sleeping(rule, other, numbers, awake, x)
                add_up(combine(rule, other, numbers, x), row[SURGE], limit, learns, total[names + i])
                if learns:
                    learn_rule(rule, other, numbers, x, asleep, row[SURGE], row[DT], rest)


@cache
def compile_free_runs(dtype: np.dtype) -> None:
    """Compile what free runs need, unless that is done or cached on the disk."""
    compile_runs(dtype)
    none, rows = np.zeros((1, 1), dtype), np.zeros((1, 1, ROW), dtype)
    column, program = np.zeros(1, np.int64), np.zeros((2, WIDTH), np.int64)
    with announced(__file__, f"kernels of free runs, {dtype}"):
        assess(program, none, none, none, rows, column, column, rows, none[0], 0, 0)


def free_totals(
    description: Description,
    leaves: Mapping[str, np.ndarray],
    samples: Sample,
    learning: Sequence[int],
    threads: int = 1,
) -> np.ndarray:
    """Σ |error|, Σ error² and whether it diverged, `(*batch, methods, 3)`, of free simulations of an ensemble.

    Args:
        description, leaves, samples, threads: as of `run.roll`.
        learning: rules that are scored once more, with weights that go on learning.
    """
    plan = plan_for(description, samples.surge.shape[1:], samples.surge.dtype)
    states = plan.pack(leaves)
    others = states.copy()
    totals = np.zeros((plan.lanes, plan.program[0, Whole.NAMES] + len(learning), 3), plan.dtype)
    numbers, rules = plan.numbers, np.asarray(learning, np.int64)

    def some(first: int, last: int) -> None:
        work = np.empty(plan.work, plan.dtype)
        assess(plan.program, states, others, numbers, rows, columns, rules, totals, work, first, last)

    compile_free_runs(plan.dtype)
    rows, columns = prepared(samples, plan)
    in_parallel(some, plan.lanes, threads)
    return totals.reshape(*plan.batch, -1, 3)
