"""Paired differences between two settings, with a bootstrap interval over seeds, boats and runs.

The mathematics is in `docs/theory.md`, section 23; equation (1) is from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.evaluation.by_run import FREE as FREE_RUNS
from usvlearn.evaluation.by_run import STEP, RunError
from usvlearn.evaluation.measure import COVERAGE, FORECAST, FREE, SKILL, Measure, own_columns
from usvlearn.evaluation.metrics import PERSISTENCE

DRAWS, LEVEL, SEED = 1000, 0.95, 0
Cell = tuple[str, str, str]  # seed, boat, run


class Difference(NamedTuple):
    """L_a − L_b; negative if a is better."""

    mean: float  # m/s; of skill: in skill
    low: float | None  # of the 95 % interval; None without one
    high: float | None
    share: float  # of L_b
    runs: int  # pairs

    @property
    def tie(self) -> bool | None:
        """Whether the interval contains 0; None without one."""
        return None if self.low is None or self.high is None else self.low <= 0 <= self.high


def cells(errors: Mapping[str, Sequence[RunError]], measure: Measure) -> dict[Cell, tuple[float, float, float]]:
    """Steps, errors and errors of persistence, m/s, of each run of a setting; of a bank those of its best column.

    Args:
        errors: by seed.
        measure: which of them counts; coverage has none.
    """
    if measure.kind == COVERAGE:
        return {}
    ahead = {FORECAST: f"{measure.horizon:g}", FREE: FREE_RUNS}.get(measure.kind, STEP)
    rows = [(seed, each) for seed, found in errors.items() for each in found if each.ahead == ahead]
    names = dict.fromkeys(name for _, each in rows for name in each.mae)
    best: dict[Cell, tuple[float, float, float]] = {}
    least = np.inf
    for column in own_columns(measure.estimator, names):
        made = {
            (seed, each.boat, each.run): (float(each.steps), each.mae[column], each.mae.get(PERSISTENCE, np.nan))
            for seed, each in rows
            if column in each.mae
        }
        total = sum(n * e for n, e, _ in made.values()) / sum(n for n, _, _ in made.values())
        best, least = (made, total) if total < least else (best, least)
    return best


def compare(
    one: Mapping[Cell, tuple[float, float, float]], other: Mapping[Cell, tuple[float, float, float]], measure: Measure
) -> Difference | None:
    """The difference of two settings over the runs that both have; None if they share none, or nothing is known.

    >>> a = {("", "heron", f"{k}"): (10.0, 0.1 + 0.01 * k, 0.2) for k in range(9)}
    >>> b = {cell: (n, e + 0.02, base) for cell, (n, e, base) in a.items()}
    >>> found = compare(a, b, Measure("rnn"))
    >>> round(found.mean, 9), round(found.high, 9), found.tie, compare(a, a, Measure("rnn")).tie
    (-0.02, -0.02, False, True)
    """
    shared = sorted(one.keys() & other.keys())
    if not shared:
        return None
    seeds, boats = (sorted({cell[k] for cell in shared}) for k in (0, 1))
    runs = {boat: sorted({run for _, each, run in shared if each == boat}) for boat in boats}
    shape = (len(seeds), len(boats), max(map(len, runs.values())))
    values = np.zeros((2, 3, *shape))  # settings; steps, sums of errors, sums of persistence's errors
    for seed, boat, run in shared:
        place = (seeds.index(seed), boats.index(boat), runs[boat].index(run))
        for k, found in enumerate((one, other)):
            steps, error, base = found[seed, boat, run]
            values[(k, slice(None), *place)] = steps, steps * error, steps * base
    whole = _losses(values, (np.ones((1, shape[0])), np.ones((1, shape[1])), np.ones((1, *shape[1:]))), measure)[0]
    if not np.isfinite(whole).all():
        return None
    low = high = None
    if len(seeds) > 1 or len(boats) > 1 or max(map(len, runs.values())) > 1:
        rng = np.random.default_rng(SEED)
        drawn = _drawn(rng, len(seeds)), _drawn(rng, len(boats)), np.zeros((DRAWS, *shape[1:]))
        for k, boat in enumerate(boats):
            drawn[2][:, k, : len(runs[boat])] = _drawn(rng, len(runs[boat]))
        ends = np.nanquantile(_losses(values, drawn, measure)[:, 2], [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        low, high = (float(x) for x in ends)
    share = whole[2] / abs(whole[1]) if whole[1] else 0.0
    return Difference(float(whole[2]), low, high, float(share), len(shared))


def _drawn(rng: np.random.Generator, count: int) -> np.ndarray:
    """How often each of `count` was drawn, `(DRAWS, count)`."""
    return rng.multinomial(count, np.full(count, 1 / count), DRAWS).astype(float)


def _losses(values: np.ndarray, weights: tuple[np.ndarray, np.ndarray, np.ndarray], measure: Measure) -> np.ndarray:
    """Equation (1) of both settings, and their difference, for each draw, `(draws, 3)`; NaN if a draw has no step.

    Args:
        values: steps, sums of errors and sums of persistence's errors, `(settings, 3, seeds, boats, runs)`.
        weights: of seeds `(draws, seeds)`, boats `(draws, boats)` and runs `(draws, boats, runs)`.
        measure: what is compared.
    """
    seeds, boats, runs = weights
    sums = np.einsum("ds,dbr,kxsbr->kxdb", seeds, runs, values, optimize=True)  # settings, numbers, draws, boats
    with np.errstate(invalid="ignore", divide="ignore"):
        loss = sums[:, 1] / (sums[:, 2] if measure.kind == SKILL else sums[:, 0])  # settings, draws, boats
        weight = np.where(np.isfinite(loss), boats, 0.0)
        made = (weight * np.nan_to_num(loss)).sum(-1) / weight.sum(-1)  # settings, draws
    return np.stack([*made, made[0] - made[1]], -1)
