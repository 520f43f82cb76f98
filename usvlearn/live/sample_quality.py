"""How many of the last steps a node could use, and if many were lost: by which channel, and what to change."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from usvlearn.logs.channels.channel import AUTO, MOST_WINDOW, SURGE, Source
from usvlearn.logs.channels.derived_surge import pair_of

if TYPE_CHECKING:
    from usvlearn.live.node import Node

SPAN, LEAST = 30.0, 15  # s of steps that are judged, and as many steps at least
SILENCES, MINUTE = 3, 60  # silences of a channel within as many looks, from which on it comes too seldom
FRESH, MEASURED = 0.75, 0.5  # shares of the steps, and of the speeds that come, below which many are lost


class Cause(NamedTuple):
    """Why many steps are lost."""

    sentence: str  # of the state
    warning: str  # with the key to change


class _Count(NamedTuple):
    steps: int
    fresh: int
    measured: int
    stale: Counter[str]  # channel -> steps without a recent value of it
    ages: dict[str, float]  # channel -> s since its last message


class Usable:
    """Counts the steps of a node. It is asked once a second.

    Args:
        sources: part -> what is received.
    """

    def __init__(self, sources: Mapping[str, Source]):
        self._names: dict[str, str] = {}  # channel -> its name in the middleware
        self._auto: set[str] = set()  # channels whose window follows their rate
        for part, source in sources.items():
            channel = part.partition("[")[0]
            self._names.setdefault(channel, f"{channel} ({source.name})")
            self._auto |= {channel} if source.window == AUTO else set()
        self._counts: deque[_Count] = deque()
        self._cause: tuple[str, str, Cause] | None = None  # channel, kind, and what is told as long as they stay
        self._looks = 0
        self._silent: set[str] = set()  # parts that are silent now
        self._silences: dict[str, deque[int]] = {}  # part -> looks at which its last silences began

    def judged(self, node: Node, ages: Mapping[str, float]) -> Cause | None:
        """Why many of the last steps were lost; None if they were not, or if the node has made too few to tell.

        Args:
            node: which counts.
            ages: part -> s since its last message. While one is silent for long, or never came, nothing is concluded.
        """
        stale = Counter({name: causes.get("stale", 0) for name, causes in node.counts.items()})
        if "yaw_rate" not in self._names:  # it is the slope of the heading
            stale["heading"] = max(stale["heading"], stale.pop("yaw_rate", 0))
        oldest: dict[str, float] = {}
        for part, age in ages.items():
            channel = part.partition("[")[0]
            oldest[channel] = max(age, oldest.get(channel, 0.0))
        now = _Count(node.grid, node.fresh, node.measured, stale, oldest)
        longest = {part: math.inf if source.held else MOST_WINDOW for part, source in node.parts.items()}
        silent = {part for part, age in ages.items() if age > longest[part] or math.isinf(age)}
        seldom = self._seldom(silent)
        if silent or (self._counts and now.steps < self._counts[-1].steps):
            self._counts.clear()
        self._counts.append(now)
        wanted = max(round(SPAN / node.dt), LEAST)
        while len(self._counts) > 1 and now.steps - self._counts[1].steps >= wanted:
            self._counts.popleft()
        found = self._lost(node, self._counts[0], now) if now.steps - self._counts[0].steps >= wanted else None
        if found is None or self._cause is None or self._cause[:2] != found[:2]:
            self._cause = found
        return seldom or (None if self._cause is None else self._cause[2])

    def _seldom(self, silent: set[str]) -> Cause | None:
        """Why steps are lost if a part falls silent again and again: no window spans its interval."""
        self._looks += 1
        for part in silent - self._silent:
            self._silences.setdefault(part, deque(maxlen=SILENCES)).append(self._looks)
        self._silent = silent
        for part, began in self._silences.items():
            if len(began) == SILENCES and self._looks - began[0] <= MINUTE:
                name = self._names[part.partition("[")[0]]
                return Cause(
                    f"many steps are lost, because of {name}",
                    f"{name} fell silent {SILENCES} times within a minute: its messages come less often than every "
                    f"{MOST_WINDOW:g} s, the longest window: send it more often",
                )
        return None

    def _lost(self, node: Node, before: _Count, now: _Count) -> tuple[str, str, Cause] | None:
        steps, fresh, measured = (b - a for a, b in zip(before[:3], now[:3], strict=True))
        windows = node.windows
        few, late = fresh < FRESH * steps, now.stale - before.stale
        channel = max((name for name in windows if name != SURGE), key=lambda name: late[name])
        if few and late[channel] >= (steps - fresh) / 2:  # else steps lacked the speed from which they depart
            return self._told(channel, *windows[channel], f"{fresh} of the last {steps} steps had all inputs")
        every = windows[SURGE][0]
        possible = fresh * min(1.0, node.dt / (every if every > 0 else 2 * MOST_WINDOW))
        if few or measured < MEASURED * possible:
            return self._told(SURGE, *windows[SURGE], f"{measured} of the last {steps} steps had a measured speed")
        return None

    def _told(self, channel: str, interval: float, window: float, share: str) -> tuple[str, str, Cause] | None:
        if math.isnan(interval):  # none of its messages is used: `Listening` says so
            return None
        channel = channel if channel in self._names else (pair_of(self._names) or (channel,))[0]
        name = self._names.get(channel, channel)
        if window < 2 * interval - 1e-9 and channel not in self._auto:
            kind = "short"
            why = f"{name} comes every {interval:.2g} s, and its window is {window:.2g} s: set {channel}.window=auto"
        else:
            kind = "late"
            silence = max(count.ages.get(channel, 0.0) for count in self._counts)  # was longer than any that is seen
            wider = max(2 * window, min(1.5 * silence, MOST_WINDOW))
            why = (
                f"{name} is often older than its window of {window:.2g} s, though it comes every {interval:.2g} s: its "
                "messages are lost, stamped late, or their rate changes again and again: set "
                f"{channel}.window={float(f'{wider:.2g}'):g}"
            )
        return channel, kind, Cause(f"many steps are lost, because of {name}", f"only {share}: {why}")
