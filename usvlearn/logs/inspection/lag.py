"""The delay from the commands to the speed that fits best, quickly: by one regression for each delay.

The change of the speed over a step is regressed on the commands of both sides, the speed, and their signed squares,

    (v_k − v_(k−1))/h = a₁ ξ_l + a₂ ξ_r + a₃ ξ_l |ξ_l| + a₄ ξ_r |ξ_r| + a₅ v + a₆ v |v| + a₇,

with the commands as each delay aligns them. The best delay leaves the smallest sum of absolute residuals. It is taken
if it is surely better than none, by the standard error of the means of blocks, since neighbouring residuals depend on
each other.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import Fleet
from usvlearn.errors import UsvlearnError
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.recordings import align_fleet, delayed

DELAYS = tuple(k / 20 for k in range(21))  # s
LONG_DELAYS = tuple(1 + k / 4 for k in range(1, 17))  # s, which are tried if the longest of the others fits best
BLOCK, LEAST_BLOCKS = 25, 4  # steps; blocks
SURE, EQUAL = 3.0, 2.0  # standard errors: to be better than none, and as good as the best
MOST_STEPS = 200_000
COMMON, CUT = 0.99, 2.0  # a change of the speed beyond so many times this quantile is an outlier


class Lag(NamedTuple):
    """What was found."""

    delay: float  # s
    equal: tuple[float, ...]  # s, delays that are as good as the best, within two standard errors
    best: float  # s, even if it is not surely better than none
    sure: bool  # whether the logs tell it
    errors: np.ndarray  # (delays,) mean absolute residual, m/s²; empty where the logs are too short


def find_lag(recordings: Sequence[Recording], surge_max: float = 10.0) -> Lag:
    """The delay of the commands, equal on both sides."""
    rows: list[dict] = []
    for delays in (DELAYS, DELAYS + LONG_DELAYS):
        try:
            with warnings.catch_warnings(action="ignore"):
                for delay in delays[len(rows) :]:
                    rows.append(_rows(align_fleet(delayed(recordings, delay), surge_max=surge_max)))
        except UsvlearnError:
            return Lag(0.0, (), 0.0, False, np.empty(0))
        stamps = set.intersection(*(set(each) for each in rows))
        if len(stamps) < BLOCK * LEAST_BLOCKS:
            return Lag(0.0, (), 0.0, False, np.empty(0))
        common = sorted(stamps)[:MOST_STEPS]
        errors = np.stack([_residuals(np.array([each[key] for key in common])) for each in rows])
        lag = choose(errors, delays)
        if lag.delay < delays[-1]:
            break
    return lag


def choose(errors: np.ndarray, delays: Sequence[float] = DELAYS) -> Lag:
    """The best of all delays by their absolute residuals, `(delays, steps)`; one at the end is not sure."""
    count = errors.shape[1] // BLOCK
    blocks = errors[:, : count * BLOCK].reshape(len(errors), count, BLOCK).mean(2)  # (delays, blocks)
    means = blocks.mean(1)
    best = int(means.argmin())

    def worse(k: int) -> tuple[float, float]:
        less = blocks[k] - blocks[best]
        return float(less.mean()), float(less.std(ddof=1) / math.sqrt(count))

    equal = [k for k in range(len(errors)) if worse(k)[0] <= EQUAL * worse(k)[1] or k == best]
    gain, error = worse(0)
    better = best > 0 and gain > SURE * error
    sure = better or ((best == 0 or 0 in equal) and len(equal) <= 4)
    sure &= len(delays) - 1 not in equal
    return Lag(delays[best] if better else 0.0, tuple(delays[k] for k in equal), delays[best], sure, means)


def _rows(fleet: Fleet) -> dict[tuple[int, int, int], tuple[float, ...]]:
    """The regressors and the change of speed of each step whose speed before is known, by run, boat and step."""
    rows: dict[tuple[int, int, int], tuple[float, ...]] = {}
    for number, run in enumerate(fleet.runs):
        samples = run.samples
        for element in range(len(fleet.boats)):
            inputs = [each[:, element] for each in samples.inputs]
            surge, good = samples.surge[:, element], (samples.measured & samples.fresh)[:, element]
            time, step = run.time[:, element], inputs[4]
            known = good[1:] & samples.measured[:-1, element]
            after = np.flatnonzero(known & (np.abs(np.diff(time) - step[:-1]) < 0.6 * step[:-1])) + 1
            left, right, before = inputs[0][after], inputs[1][after], surge[after - 1]
            table = np.stack(
                [left, right, left * np.abs(left), right * np.abs(right), before, before * np.abs(before),
                 np.ones(len(after)), (surge[after] - before) / step[after]], 1,
            )  # fmt: skip
            finite = np.isfinite(table).all(1)
            keys = [(number, element, round(float(each) * 100)) for each in time[after[finite]]]
            rows.update(zip(keys, map(tuple, table[finite]), strict=True))
    return rows


def _residuals(table: np.ndarray) -> np.ndarray:
    """The absolute residuals of a regression without outliers, `(steps,)`."""
    x, y = table[:, :-1], table[:, -1]
    limit = CUT * float(np.quantile(np.abs(y), COMMON))
    usual = np.abs(y) <= limit
    weights, *_ = np.linalg.lstsq(x[usual], y[usual], rcond=None)
    return np.minimum(np.abs(y - x @ weights), limit)
