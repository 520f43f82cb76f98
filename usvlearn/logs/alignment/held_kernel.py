"""A signal that is held between its messages: which message is in force, and means over time. Compiled by numba."""

from __future__ import annotations

import math

from usvlearn.core.jit import jit
from usvlearn.logs.channels.channel import EPSILON


@jit(memory=True)
def at(times, time):
    """Index of the last message stamped at or before `time`; -1 where there is none."""
    return _below(times, time + EPSILON, True)


@jit(memory=True)
def before(times, time):
    """Index of the last message stamped before `time`; -1 where there is none."""
    return _below(times, time - EPSILON, False)


@jit(memory=True)
def _below(times, time, equal):
    low, high = 0, len(times)
    while low < high:
        middle = (low + high) // 2
        if times[middle] < time or (equal and times[middle] == time):
            low = middle + 1
        else:
            high = middle
    return low - 1


@jit(memory=True)
def mean(times, values, start, end):
    """Time-weighted mean of the held signal over [start, end); NaN where it had no value yet."""
    j, last = at(times, start), before(times, end)
    if last < 0:
        return math.nan
    if j < 0:
        j, start = 0, times[0]
    if j == last:
        return values[j]
    total, since = 0.0, start
    for i in range(j, last):
        total += values[i] * (times[i + 1] - since)
        since = times[i + 1]
    return (total + values[last] * (end - since)) / (end - start)
