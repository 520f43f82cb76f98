"""Finds copies of a measured speed, as of a sensor that is logged faster than it measures.

The rule and its reasons are in `docs/theory/model.md#repeated-samples`. Copies of a coarse sensor are not found:
declare its `period`, where it is known.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from usvlearn.logs.channels.channel import AUTO, Channel, Recording

LEAST = 50  # changes of the speed, below which nothing is concluded
SHARE = 0.25  # of the speeds that repeat, at least
REGULAR = 0.5  # share of the variance of repeats by chance, at most
COMMON = 0.25  # share of the most common size of change, at most
RESOLUTION = 6  # decimals of m/s, to which sizes of change are compared


def settle_period(boat: str, recordings: list[Recording]) -> list[Recording]:
    """The recordings of one boat, with a period in place of "auto"; warns of copies, which 0 keeps."""
    surges = [recording.channels["surge"] for recording in recordings]
    given = surges[0].period
    if given not in (AUTO, 0):
        return recordings
    period, share = find_period(surges)
    if period:
        what = (
            f"{boat}: {share:.0%} of the speeds repeat the one before, in the pattern of a sensor that measures every "
        )
        key = "data.channels.surge.period"
        done = (
            f"the copies are dropped ({key}={period:g}; 0 keeps them)"
            if given == AUTO
            else f"set {key}={period:g} to drop the copies: a command logged beside one tells the speed"
        )
        warnings.warn(f"{what}{period:g} s: {done}", stacklevel=3)
    if given != AUTO:
        return recordings
    return [
        one._replace(channels={**one.channels, "surge": one.channels["surge"]._replace(period=period)})
        for one in recordings
    ]


def find_period(logs: Sequence[Channel]) -> tuple[float, float]:
    """The time between two measurements, s, rounded to two digits, and the share of copies; zeros if there are none."""
    with np.errstate(over="ignore"):  # of numbers that are no speeds, and are rejected later
        lengths, changes = (np.concatenate(parts) for parts in zip(*map(_repeats, logs), strict=True))
        if len(lengths) < LEAST:
            return 0.0, 0.0
        mean, (_, counts) = lengths.mean(), np.unique(changes.round(RESOLUTION), return_counts=True)
    copied = mean >= 1 / (1 - SHARE) and lengths.var() < REGULAR * mean * (mean - 1)
    if not copied or counts.max() >= COMMON * len(changes):
        return 0.0, 0.0
    interval = np.median(np.concatenate([np.diff(log.time) for log in logs]))
    return float(f"{mean * interval:.2g}"), float(1 - 1 / mean)


def _repeats(log: Channel) -> tuple[np.ndarray, np.ndarray]:
    """How often each speed other than 0 comes in a row, and the size of each change, m/s; the ends are left out."""
    begins = np.flatnonzero(log.value[1:] != log.value[:-1]) + 1
    lengths, changes = np.diff(begins), np.abs(log.value[begins] - log.value[begins - 1])
    return lengths[log.value[begins[:-1]] != 0], changes
