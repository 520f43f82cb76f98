"""Logs of one boat that differ from its others in the scale of their commands or of their speed.

A gentle run has weak commands and is slow, too. Commands are of another unit if they differ by more than 8, or by 2.55
as 255 from 100, and the speeds by less than the root of that. Speeds are compared by their ratios to the rate of
position, as in `scales`. Without positions, the greatest speeds and how speeds follow commands must both tell it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from usvlearn.logs.channels.channel import COMMANDS, METRES, SURGE
from usvlearn.logs.channels.correlations import speed_on_positions
from usvlearn.logs.checks.evidence import FOLLOWS, Evidence
from usvlearn.logs.checks.finding import Finding
from usvlearn.logs.checks.scales import RESTING, SAME

OTHER, BYTES, CLOSE = 8.0, 2.55, 0.02  # ratios of commands; by which the latter may differ
RATIOS, NEAR = np.log([1852 / 1000, 3600 / 1852, 1 / 0.3048, 3.6]), 0.12  # of speeds in two units; by which they differ
ALIKE = 1.2  # ratio of commands of like size
SHOWN = 3  # names of logs


def runs(e: Evidence) -> Iterator[Finding]:
    """Logs whose commands, or whose speeds, are in another unit than those of the others."""
    alone = [replace(e, recordings=[one]) for one in e.recordings]
    moved = [own for own in alone if own.fastest > RESTING]
    fastest = np.array([own.fastest for own in moved])
    for name in COMMANDS:
        sizes = np.array([_greatest(own.values[name]) for own in moved])
        ratio, faster = _ratios(sizes, fastest)
        if (ratio > OTHER or abs(ratio / BYTES - 1) < CLOSE) and faster < math.sqrt(ratio):
            yield _finding(moved, name, "commands of runs", sizes)
            break
    if e.speeds and e.has_position:
        places = [speed_on_positions(*(own.series.get(x, own.size) for x in METRES), own.size) for own in moved]
        sizes = np.array([each.slope if each.correlation > FOLLOWS else 0.0 for each in places])
        if _ratios(sizes)[0] > SAME:
            yield _finding(moved, SURGE, "speeds of runs", sizes)
    elif e.speeds:
        follows = [own.thrust_on_speed for own in moved]
        sizes = np.array([each.slope if each.correlation > FOLLOWS else 0.0 for each in follows])
        slope, faster, driven = _ratios(sizes, fastest, np.array([_greatest(own.thrust) for own in moved]))
        one_unit = np.abs(np.log([[slope], [faster]]) - RATIOS).max(0).min() < NEAR
        if one_unit and 1 / ALIKE < driven < ALIKE:
            yield _finding(moved, SURGE, "speeds of runs", sizes)


def _greatest(values: np.ndarray) -> float:
    return float(np.quantile(np.abs(known), 0.995)) if len(known := values[np.isfinite(values)]) else 0.0


def _ratios(sizes: np.ndarray, *others: np.ndarray) -> list[float]:
    """The ratios of medians beyond the widest gap between some sizes to those before it; 1 where it has no two sides.

    >>> _ratios(np.array([1, 99, 0.9, 0]), np.array([3.0, 6.0, 3.0, 2.0]))[1:]
    [2.0]
    """
    order = np.sort(sizes[sizes > 0])
    if not len(order) or order[0] == order[-1]:
        return [1.0] * (1 + len(others))
    high = sizes > order[np.argmax(order[1:] / order[:-1])]
    return [float(np.median(each[high]) / max(np.median(each[~high & (sizes > 0)]), 1e-9)) for each in (sizes, *others)]


def _finding(runs: list[Evidence], name: str, kind: str, sizes: np.ndarray) -> Finding:
    typical = np.median(sizes[sizes > 0]) if len(sizes) > 2 else sizes.min()
    off = np.abs(np.log(sizes / typical, where=sizes > 0, out=np.zeros(len(sizes)))) > math.log(SAME)
    listed = ", ".join(f"{runs[k].recordings[0].run} (× {sizes[k] / typical:.3g})" for k in np.flatnonzero(off)[:SHOWN])
    text = f"another scale than in the other logs in {listed}" + ", …" * bool(off.sum() > SHOWN)
    expected = "logs of one boat in one unit: read these by a configuration of their own, or as another boat"
    return Finding(runs[0].boat, name, kind, text, expected)
