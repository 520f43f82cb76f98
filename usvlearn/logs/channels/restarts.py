"""Where a log's clock jumps for good: the logger started anew, or its clock was set.

A jump counts if the median of the five stamps after it is more than `JUMP` before, or `AHEAD` after, that of the five
before it, in most series of the log: no single wrong stamp, and no clock of one sensor alone, divides a log.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from typing import TypeVar

import numpy as np

from usvlearn.logs.channels.channel import Channel
from usvlearn.logs.channels.series import Series

JUMP, AHEAD = 5.0, 1e6  # s, that a clock is set back, or ahead, at least
AROUND = 5  # stamps at each side of a jump
MOST = 50  # jumps, beyond which the rows are in no order of time

T = TypeVar("T", Channel, Series)


def segments(series: Collection[T]) -> tuple[list[list[T]], list[tuple[int, float]]]:
    """The series between the jumps of their clock, and each jump: its place in the log, and how far back it goes, s.

    If there are jumps, times count from the first stamp of each part.
    """
    jumps: list[tuple[int, float]] = _jumps(series)
    parts: list[list[T]] = [] if jumps else [list(series)]
    for begin, end in pairwise([-np.inf, *(place for place, _ in jumps), np.inf]) if jumps else ():
        rows = [(each.order >= begin) & (each.order < end) for each in series]
        start = min(each.time[inside].min() for each, inside in zip(series, rows, strict=True) if inside.any())
        cut = zip(series, rows, strict=True)
        moved = [x._replace(time=x.time[k] - start, value=x.value[k], order=x.order[k]) for x, k in cut]
        parts.append([x._replace(start=x.start + start) for x in moved])
    return parts, jumps


@np.errstate(all="ignore")
def _jumps(series: Collection[T]) -> list[tuple[int, float]]:
    spans: list[tuple[int, int, float]] = []  # places in the log between which a series jumps, and how far
    for each in series:
        steps = np.diff(each.time)
        places = np.flatnonzero((steps < -JUMP) | (steps > AHEAD))
        for k in places.tolist() if len(places) <= AROUND * MOST else ():
            before, after = each.time[max(0, k + 1 - AROUND) : k + 1], each.time[k + 1 : k + 1 + AROUND]
            ahead = np.median(after) - np.median(before)
            if min(len(before), len(after)) > 2 and (ahead < -JUMP or ahead > AHEAD):
                spans.append((int(each.order[k]), int(each.order[k + 1]), float(each.time[k] - each.time[k + 1])))
    found: list[tuple[int, float]] = []
    while spans:  # the fewest places that divide all jumps
        end = min(spans, key=lambda span: span[1])
        together = [span for span in spans if span[0] < end[1] <= span[1]]
        if 2 * len(together) > sum(len(each.order) > 0 and each.order[0] < end[1] <= each.order[-1] for each in series):
            found.append((end[1], end[2]))
        spans = [span for span in spans if span[0] >= end[1]]
    return found if len(found) <= MOST else []
