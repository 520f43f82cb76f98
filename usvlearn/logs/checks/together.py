"""Runs of one boat that lie in the same minutes of absolute time: they are of several boats, or copies.

A log whose stamps count from its own start, as from 0, says nothing about it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from usvlearn.logs.channels.channel import COMMANDS
from usvlearn.logs.checks.evidence import Evidence
from usvlearn.logs.checks.finding import Finding

DATED = 3e8  # s since 1970: stamps before 1979 are of a clock that was not set, or of another start
WITHIN = 0.01, 0.99  # quantiles of the stamps, since some may be wrong
LONG, SHARE = 10.0, 0.05  # s that two runs have in common, and share of the shorter: parts of one log overlap by less


def together(e: Evidence) -> Iterator[Finding]:
    """Two runs in the same minutes, those that have the most in common."""
    spans = []
    for one in e.recordings:
        time, start = one.channels[COMMANDS[0]].time, one.channels[COMMANDS[0]].start
        if start > DATED and len(time):
            spans.append((*(start + np.quantile(time, WITHIN)).tolist(), one.run))
    several = {
        (run, other): both
        for (begin, end, run), (later, last, other) in pairwise(sorted(spans))
        if (both := min(end, last) - later) > max(LONG, SHARE * min(end - begin, last - later))
    }
    if several:
        one, other = pair = max(several, key=lambda each: several[each])
        more = f", and so are {len(several) - 1} more pairs of runs" if len(several) > 1 else ""
        text = f"that {one} and {other} are of the same {several[pair]:.0f} s{more}: of several boats, or copies"
        expected = "runs of one boat, one after the other: of several boats, set data.path to the run of one, or to "
        expected += f"{{{one}: FILE, {other}: FILE}} (of one table, set data.boat_column) and data.boat to null"
        yield Finding(e.boat, "runs", "together", text, expected)
