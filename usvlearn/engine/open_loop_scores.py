"""Scores of open-loop simulations, piece by piece, without storing all predictions.

The steps are those of `dispatch.run`. A loop of its own over the same steps would be compiled for half a minute more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np

from usvlearn.core.family import WIDTH, Row
from usvlearn.core.jit import NUMBA, announce, jit
from usvlearn.core.prepared_samples import DT, LEARN, MODE, ROW, START, SURGE
from usvlearn.core.samples import Sample
from usvlearn.engine.dispatch import mask_diverged, run, surge_max
from usvlearn.engine.first_use import compile_runs
from usvlearn.engine.parts import Description
from usvlearn.engine.program import program_for
from usvlearn.engine.run import in_parallel, prepared
from usvlearn.estimators.ensemble.combiners.kernel import combine, fill_inactive, learn_rule

CHUNK = 4096  # steps of a piece


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
def assess(program, other, q, rows, predictions, learning, total, work):
    """Score one batch element's predictions of an open-loop simulation, `(steps, names)`.

    The combiners `learning` run once more with the state `other`, which goes on learning. `total` is
    `(names + learning, 3)`, and is added to.
    """
    n, names, limit = program[0, Row.ESTIMATORS], predictions.shape[1], surge_max(program, q)
    active, x, rest = work[:n], work[n : 2 * n], work[2 * n :]
    for k in range(len(rows)):
        row = rows[k]
        if row[MODE] <= START:
            continue
        learns = row[MODE] == LEARN
        for i in range(names):
            add_up(predictions[k, i], row[SURGE], limit, learns, total[i])
        mask_diverged(predictions[k], limit, active)
        for i in range(len(learning)):
            rule = program[1 + n + learning[i]]
            inactive = fill_inactive(rule, other, q, active, x)
            add_up(combine(rule, other, q, x), row[SURGE], limit, learns, total[names + i])
            if learns:
                learn_rule(rule, other, q, x, inactive, row[SURGE], row[DT], rest)


@cache
def compile_free_runs(dtype: np.dtype) -> None:
    """Compile what open-loop simulations need, unless that is done or cached on the disk."""
    compile_runs(dtype)
    if NUMBA.DISABLE_JIT:
        return
    none, rows, program = np.zeros(0, dtype), np.zeros((0, ROW), dtype), np.zeros((2, WIDTH), np.int64)
    with announce(__file__, f"kernels of open-loop simulations, {dtype}"):
        assess(program, none, np.zeros(1, dtype), rows, rows, np.zeros(0, np.int64), rows, none)


def free_totals(
    description: Description,
    leaves: Mapping[str, np.ndarray],
    samples: Sample,
    learning: Sequence[int],
    threads: int = 1,
    given: np.ndarray | None = None,
) -> np.ndarray:
    """Σ |error|, Σ error² and whether it diverged, `(*batch, methods, 3)`, of free simulations of an ensemble.

    Args:
        description, leaves, samples, threads, given: as of `run.roll`.
        learning: combiners that are scored once more, with weights that go on learning.
    """
    plan = program_for(description, samples.surge.shape[1:], samples.surge.dtype)
    states = plan.pack(leaves)
    others, places = states.copy(), plan.places("predictions").ravel()
    totals = np.zeros((plan.elements, len(places) + len(learning), 3), plan.dtype)
    rules, only = np.asarray(learning, np.int64), np.zeros(1, np.int64)
    none = np.zeros((1, 1, 0), plan.dtype)

    def some(first: int, last: int) -> None:
        work, predicted = np.empty(plan.work, plan.dtype), np.empty((1, CHUNK), plan.dtype)
        recorded = np.empty((1, CHUNK, len(places)), plan.dtype)
        for element in range(first, last):
            one = slice(element, element + 1)
            q = plan.numbers[one] if len(plan.numbers) > 1 else plan.numbers
            for begin in range(0, rows.shape[1], CHUNK):
                part = rows[columns[one], begin : begin + CHUNK]
                n = part.shape[1]
                run(
                    plan.program, plan.head, states[one], q, part, none, only, True, places, predicted[:, :n],
                    recorded[:, :n], work, 0, 1,
                )  # fmt: skip
                assess(plan.program, others[element], q[0], part[0], recorded[0, :n], rules, totals[element], work)

    compile_free_runs(plan.dtype)
    rows, columns = prepared(samples, plan, given)
    in_parallel(some, plan.elements, threads)
    return totals.reshape(*plan.batch, -1, 3)
