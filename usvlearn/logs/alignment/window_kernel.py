"""How old a value may be where its channel's window is "auto": twice the usual interval of its last messages.

Messages less than TOGETHER apart count as one, because several signals of one sender come in bursts. An interval beyond
MOST_WINDOW is an outage, and does not count. The usual interval is the fourth largest of the last 16, so that lost
messages and short outages do not widen the window. The window is twice that, within LEAST_WINDOW … MOST_WINDOW: one
lost message is bridged.

When the rate falls, four intervals are enough for the new window; when it rises, 13 are needed.

Everything depends only on the stamps of the channel's messages so far, in their order. So a replay finds the windows
that the node had aboard.
"""

from __future__ import annotations

import math

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.logs.channels.channel import LEAST_WINDOW, MOST_WINDOW

RECENT = 16  # intervals that are remembered, a power of two; a quarter of them may be longer than the usual one
TOGETHER = 0.05  # s; a channel of 20 Hz and more has the least window anyway


@jit(entry=True, memory=True)
def follow(counted, seen, intervals, place, time):
    """Take the stamp of a message.

    Args:
        counted: `(channels,)` stamp from which the next interval counts, s; −inf before the first message.
        seen: `(channels,)` intervals so far.
        intervals: `(channels, RECENT)` the last ones, s.
        place: of the channel.
        time: s.
    """
    since = time - counted[place]
    if not 0 <= since < TOGETHER:
        counted[place] = time
        if 0 < since <= MOST_WINDOW:
            intervals[place, seen[place] & (RECENT - 1)] = since
            seen[place] += 1


@jit(entry=True, memory=True)
def usual(seen, intervals, place):
    """The usual interval of a channel, s, NaN while it is not known; arguments as of `follow`.

    >>> counted, seen, intervals = new_followed(1)
    >>> for k in range(3):
    ...     follow(counted, seen, intervals, 0, 0.5 * k)
    >>> usual(seen, intervals, 0)
    0.5
    """
    n = min(seen[place], RECENT)
    if n == 0:
        return math.nan
    a, b, c, d = 0.0, 0.0, 0.0, 0.0  # the largest, in order
    for k in range(n):
        x = intervals[place, k]
        a, x = max(a, x), min(a, x)  # faster than branches, which no processor foresees
        b, x = max(b, x), min(b, x)
        c, x = max(c, x), min(c, x)
        d = max(d, x)
    rank = (n + 3) // 4
    return a if rank == 1 else b if rank == 2 else c if rank == 3 else d


@jit(entry=True, memory=True)
def window_of(seen, intervals, place):
    """The window of a channel, s; arguments as of `follow`.

    >>> window_of(np.array([1]), np.array([[0.25]]), 0)
    0.5
    """
    interval = usual(seen, intervals, place)
    return min(max(2 * interval, LEAST_WINDOW), MOST_WINDOW) if interval > 0 else LEAST_WINDOW


@jit(entry=True, memory=True)
def windows_after(times):
    """The window after each message of one channel, s, `(n,)`, of stamps `(n,)`."""
    counted, seen, intervals = np.full(1, -math.inf), np.zeros(1, np.int64), np.zeros((1, RECENT))
    windows = np.empty(len(times))
    for k in range(len(times)):
        follow(counted, seen, intervals, 0, times[k])
        windows[k] = window_of(seen, intervals, 0)
    return windows


def new_followed(channels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first three arguments of `follow` before the first message."""
    return np.full(channels, -math.inf), np.zeros(channels, np.int64), np.zeros((channels, RECENT))
