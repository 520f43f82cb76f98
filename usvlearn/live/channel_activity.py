"""Reports channels without messages. A value held in a MOOSDB does not prove that its sender runs."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping

from usvlearn.live.health import seconds
from usvlearn.logs.channels.channel import AUTO, MOST_WINDOW, Source

SILENT = 1.0  # s without a message, from which on a channel is reported, at least
USELESS = ("not_a_number", "no_time", "out_of_range", "backwards", "ahead", "alone", "wrong_type", "empty", "text")


class Listening:
    """Notes when each part came last, and whether its messages can be used.

    Args:
        sources: part -> what is received.
        warp: how many times faster than a clock the stamps run.

    >>> listening = Listening({"surge": Source("NAV_SPEED")}, warp=1.0)
    >>> listening.judged(listening.ages(0.0), dt=0.4)
    ('waiting', 'waiting for surge (NAV_SPEED)')
    """

    def __init__(self, sources: Mapping[str, Source], warp: float):
        self._sources, self._warp = sources, warp
        self.heard: dict[str, float] = {}  # part -> monotonic time of its last message
        self._pushed: Counter[str] = Counter()  # messages of each channel
        self._before: dict[str, tuple[int, int]] = {}  # channel -> messages and useless ones at the last look
        self._refused: dict[str, str] = {}  # channel -> why none of its last messages could be used

    def take(self, part: str) -> None:
        """A message of a part has come; others than the sources are not waited for."""
        if part not in self._sources:
            return
        self.heard[part] = time.monotonic()
        self._pushed[part.partition("[")[0]] += 1

    def ages(self, clock: float) -> dict[str, float]:
        """Part -> s of the stamps since its last message, infinite if none came; `clock` as `time.monotonic()`."""
        return {
            part: (clock - self.heard[part]) * self._warp if part in self.heard else math.inf for part in self._sources
        }

    def look(self, counts: Mapping[str, Mapping[str, int]]) -> None:
        """Find the channels of which no message since the last look could be used, from the counts of all causes."""
        for channel, pushed in self._pushed.items():
            causes = {cause: n for cause, n in counts.get(channel, {}).items() if cause in USELESS}
            useless = sum(causes.values())
            before, self._before[channel] = self._before.get(channel, (0, 0)), (pushed, useless)
            self._refused.pop(channel, None)
            if pushed > before[0] and useless - before[1] >= pushed - before[0]:
                self._refused[channel] = max(causes, key=lambda cause: causes[cause])

    def judged(
        self, ages: Mapping[str, float], dt: float, windows: Mapping[str, tuple[float, float]] | None = None
    ) -> tuple[str, str]:
        """The state, and a sentence: what is missing and since when.

        Args:
            ages: of `ages`.
            dt: of a step, s.
            windows: of `Node.windows`.
        """
        never = [part for part, age in ages.items() if age == math.inf]
        if never:
            return "waiting", f"waiting for {', '.join(map(self._named, never))}"
        old, rare = [], []
        for part, age in ages.items():
            source = self._sources[part]
            channel = part.partition("[")[0]
            interval, own = (windows or {}).get(channel, (0.0, MOST_WINDOW))
            longest = (own if source.window == AUTO else float(source.window)) + float(source.period) + 2 * dt
            if not source.held and age > max(SILENT * self._warp, longest):
                old.append(f"{self._named(part)} for {seconds(age)}")
            if not source.held and math.isnan(interval) and channel not in self._refused:
                rare.append(self._named(part))
        if rare:
            return "waiting", f"waiting for a second message within {MOST_WINDOW:g} s of {', '.join(rare)}"
        if old:
            return "stale", f"no {', no '.join(old)}"
        refused = [f"{channel} ({cause})" for channel, cause in sorted(self._refused.items())]
        if refused:
            return "stale", f"no message can be used of {', '.join(refused)}"
        return "ok", "ok"

    def _named(self, part: str) -> str:
        return f"{part} ({self._sources[part].name})"
