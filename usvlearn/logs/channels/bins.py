"""Means of a series over bins of equal length, by which channels with stamps of their own are compared.

A series is a pair (time, value), s and SI units, in any order, with gaps and NaN. Between two stamps a value is
interpolated linearly, or held; a mean is the difference of the integral at the edges of a bin, divided by its length.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Series = tuple[np.ndarray, np.ndarray]  # time, s, and value, SI units; (n,) each

MOST_BINS = 1_000_000  # beyond which long outages are cut out of a log
OUTAGE = 30.0  # s, what is left of one then, and the time between two runs
GAP, INTERVALS = 2.0, 4.0  # s, and median intervals: a longer silence of a channel is a gap
HUGE = 1e12  # s, or any unit: a greater number is none, and its square could overflow
EXTREME = 0.995  # quantile of the sizes to which larger ones are clipped


def cleaned(series: Series) -> Series:
    """Values in the order of their stamps, without those that are no number or `HUGE`."""
    time, value = np.asarray(series[0], dtype=np.float64), np.asarray(series[1])
    known = (np.abs(time) < HUGE) & (np.abs(value) < HUGE)
    if not known.all():
        time, value = time[known], value[known]
    if (np.diff(time) < 0).any():
        place = np.argsort(time, kind="stable")
        time, value = time[place], value[place]
    return time, value


def bin_edges(step: float, *series: Series) -> np.ndarray:
    """Edges of bins over the time in which all series are there; long outages of a huge span are left out."""
    times = [cleaned(each)[0] for each in series]
    if not all(len(time) > 1 for time in times):
        return np.empty(0)
    first, last = max(time[0] for time in times), min(time[-1] for time in times)
    if (last - first) / step <= MOST_BINS:
        return np.arange(first, last + step / 2, step)
    base = times[0][(times[0] >= first) & (times[0] <= last)]
    runs = np.split(base, np.flatnonzero(np.diff(base) > OUTAGE) + 1)
    parts = [np.arange(run[0], run[-1] + step / 2, step) for run in runs if len(run)]
    return np.concatenate([*parts, np.empty(0)])[:MOST_BINS]


def gaps(time: np.ndarray, edges: np.ndarray, share: float = 0.5) -> np.ndarray:
    """Which bins lie in a gap of a channel by more than a share of their length, `(bins,)`."""
    if len(time) < 2 or len(edges) < 2:
        return np.ones(max(len(edges) - 1, 0), dtype=bool)
    passed = np.diff(time)
    limit = max(GAP, INTERVALS * float(np.median(passed)))
    silent = np.append(0.0, np.cumsum(np.where(passed > limit, passed, 0.0)))
    length = np.diff(edges)
    outside = (edges[:-1] < time[0] - length) | (edges[1:] > time[-1] + length)
    return outside | (np.diff(np.interp(edges, time, silent)) > share * length)


def bin_means(series: Series, edges: np.ndarray, held: bool = False) -> np.ndarray:
    """Means over bins, `(bins,)`, NaN in a gap; a held value stays in force until the next one, however long."""
    time, value = cleaned(series)
    if held and len(time) and len(edges) and time[-1] < edges[-1]:
        time, value = np.append(time, edges[-1]), np.append(value, value[-1])
    if len(edges) < 2 or len(time) < 2:
        return np.full(max(len(edges) - 1, 0), np.nan)
    passed = np.diff(time)
    level = value[:-1] if held else (value[:-1] + value[1:]) / 2
    total = np.concatenate([[0.0], np.cumsum(passed * (level - level.mean()))])
    means = np.diff(np.interp(edges, time, total)) / np.diff(edges) + level.mean()
    means[edges[1:] < time[0] if held else gaps(time, edges)] = np.nan
    return means


def clipped(values: np.ndarray) -> np.ndarray:
    """Values whose size is at most its `EXTREME` quantile."""
    known = np.isfinite(values)
    if not known.any():
        return values
    limit = np.quantile(np.abs(values[known]), EXTREME)
    return np.clip(values, -limit, limit)


def bin_directions(series: Series, edges: np.ndarray) -> NDArray[np.complex128]:
    """Means of exp(iψ) over bins, `(bins,)`, of angles ψ, rad; NaN in a gap."""
    time, angle = cleaned(series)
    return bin_means((time, np.cos(angle)), edges) + 1j * bin_means((time, np.sin(angle)), edges)


def bin_rates(series: Series, edges: np.ndarray, wraps: bool = False) -> np.ndarray:
    """Mean rates of change over bins, `(bins,)`, NaN in a gap.

    If it `wraps`, as a heading, a jump by more than half the range of all values counts as no change.
    """
    time, value = cleaned(series)
    if len(edges) < 2 or len(time) < 2:
        return np.full(max(len(edges) - 1, 0), np.nan)
    if wraps:
        change = np.diff(value, prepend=value[0])
        change[np.abs(change) > np.ptp(value) / 2] = 0.0
        value = np.cumsum(change)
    rates = np.diff(np.interp(edges, time, value)) / np.diff(edges)
    rates[gaps(time, edges)] = np.nan
    return rates
