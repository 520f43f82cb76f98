"""The autocorrelation of a simulation's errors, and their correlation with the commands.

Equations (1) and (2): `docs/theory/identification.md#batch-fit-residuals`; r is ρ there, R a sum in place of a mean.
The grid of the fit is uniform, so a lag is a time, also across a gap. 99 % are within 2.58 deviations. Lags with few
pairs, as those near the length of short missions, are left out: r is no correlation there, and large.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.evaluation.metrics import NORMAL_99

REACH = 60.0  # s, the largest lag
BEFORE = 20.0  # s, the largest time by which an error is ahead of a command
EVERY = 0.5  # s, between two lags that are kept
ENOUGH = 0.25  # of the pairs of the lag that has most: a lag with fewer is unknown
LEAST = 1e-9  # of the largest value: a smaller deviation is rounding


class Correlation(NamedTuple):
    """Of errors with themselves, or with a command."""

    lags: np.ndarray  # (lags,) s
    values: np.ndarray  # (lags,); NaN where there is no pair, or nothing varies
    bounds: np.ndarray  # (lags,) half-width of the 99 % bounds


def autocorrelation(errors: Sequence[np.ndarray], dt: float) -> Correlation:
    """r_e of (1) of missions, `(time,)` each, NaN where a step does not count, in means over `EVERY` s of lags."""
    reach = round(REACH / dt)
    centred = [_centred(each) for each in errors]
    sums, pairs = lagged_sums(centred, centred, reach)
    places = np.round(np.arange(reach + 1) * dt / EVERY).astype(int)
    count = round(REACH / EVERY) + 1
    binned, number = (np.bincount(places, x, count)[1:count] for x in (sums, pairs))
    variance, known = sums[0] / max(pairs[0], 1.0), (number > ENOUGH * number.max()) & _varies(errors)
    with np.errstate(all="ignore"):
        values = np.where(known, binned / number / variance, np.nan)
        bounds = np.where(known, NORMAL_99 / np.sqrt(number), np.nan)
    return Correlation(EVERY * np.arange(1, count), values, bounds)


def cross_correlation(errors: Sequence[np.ndarray], commands: Sequence[np.ndarray], dt: float) -> Correlation:
    """r_eu of (1), and bounds by (2), at lags from −`BEFORE` to `REACH`, of missions, `(time,)`; NaN where unknown."""
    reach, before = round(REACH / dt), round(BEFORE / dt)
    e, u = [_centred(each) for each in errors], [_centred(each) for each in commands]
    (own, n), (driven, m) = lagged_sums(e, e, reach), lagged_sums(u, u, reach)
    after, later = lagged_sums(u, e, reach)
    ahead, sooner = lagged_sums(e, u, before)
    lags = np.arange(-round(BEFORE / EVERY), round(REACH / EVERY) + 1) * EVERY
    steps = np.round(lags / dt).astype(int)
    size = np.abs(steps)
    sums = np.where(steps < 0, ahead[np.minimum(size, before)], after[size])
    pairs = np.where(steps < 0, sooner[np.minimum(size, before)], later[size])
    powers = own[0] / max(n[0], 1.0), driven[0] / max(m[0], 1.0)
    known = (pairs > ENOUGH * pairs.max()) & _varies(errors) & _varies(commands)
    with np.errstate(all="ignore"):
        scale = np.sqrt(powers[0] * powers[1])
        values = np.where(known, sums / pairs / scale, np.nan)
        r_u = np.where(m > 0, driven / m, 0.0) / powers[1]
        products = own / powers[0] * r_u  # n_l r_e(l) r_u(l), since own = n_l R_e(l)
        total = max(products[0] + 2 * products[1:].sum(), n[0])
        bounds = np.where(known, NORMAL_99 * np.sqrt(total / (n[0] * pairs)), np.nan)
    return Correlation(lags, values, bounds)


def _varies(every: Sequence[np.ndarray]) -> bool:
    """Whether a series varies within a mission by more than rounding."""
    some = [x[np.isfinite(x)] for x in every]
    return any(len(x) > 0 and float(x.std()) > LEAST * float(np.abs(x).max()) for x in some)


def _centred(x: np.ndarray) -> np.ndarray:
    """Less its mean."""
    known = np.isfinite(x)
    return x - x[known].mean() if known.any() else x


def lagged_sums(first: Sequence[np.ndarray], second: Sequence[np.ndarray], reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Σ first[t] second[t + k] over the missions, and the number of pairs, of k = 0 … reach: `(reach + 1,)` each."""
    sums, pairs = np.zeros(reach + 1), np.zeros(reach + 1)
    for x, y in zip(first, second, strict=True):
        count = min(reach + 1, len(x))
        length = 1 << (len(x) + count).bit_length()

        def lagged(a: np.ndarray, b: np.ndarray, length: Any = length, count: int = count) -> np.ndarray:
            return np.fft.irfft(np.conj(np.fft.rfft(a, length)) * np.fft.rfft(b, length), length)[:count]

        sums[:count] += lagged(np.nan_to_num(x), np.nan_to_num(y))
        pairs[:count] += np.round(lagged(np.isfinite(x).astype(float), np.isfinite(y).astype(float)))
    return sums, pairs
