"""The node's health, published once a second, and what tells it: silent channels, and steps that are lost.

A value held in a MOOSDB does not prove that its sender runs, so channels without messages are found here.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.display.json_values import finite
from usvlearn.logs.channels.channel import AUTO, MOST_WINDOW, SURGE, Source
from usvlearn.logs.channels.derived_surge import pair_of

if TYPE_CHECKING:
    from usvlearn.live.node import Node

ONE_COMMAND = (
    "one command drives both sides: nothing tells left from right, so that neither the thrust of a side nor "
    "thrust_ratio can be identified; a loss of thrust is sought by the speed; what a rudder does is not learned"
)


class Refit(NamedTuple):
    """What the last batch fit of a node's missions says."""

    use: bool = False  # whether its values are to be used, and not those learned online
    missions: int = 0
    quantities: Mapping[str, tuple[float, float, float, str]] = {}  # value, low, high, unit
    sentence: str = "use those learned online: no mission has been fitted yet"
    table: tuple[float, ...] = ()  # as a member of forecasts has it


class Health(NamedTuple):
    """The health of a node."""

    state: str  # "compiling", "waiting" (a channel never came), "stale", "sparse" (many steps are lost), "ok"
    sentence: str  # for a person
    counts: dict[str, dict[str, int]]  # channel -> cause -> messages that were not used
    ages: dict[str, float]  # part -> s since its last message, infinite if none came
    steps: int
    learned: int
    alarms: int
    alarm: str | None  # the side whose thruster seems to have failed, while the alarm is on
    uptime: float  # s
    saved: float  # s since the last save; infinite: none yet
    contraction: dict[str, dict[str, Any]]  # network -> see `usvlearn.live.diagnostics.networks`
    identified: dict[str, tuple[float, float, float, str]]  # quantity -> value, low, high, unit
    warnings: tuple[str, ...]  # sentences
    notes: tuple[str, ...] = ()  # sentences about what cannot be known
    loss: str = ""  # what is known of the failed thruster now
    refit: Refit | None = None  # None: missions are not fitted

    @property
    def rejected(self) -> int:
        """Messages that were not used."""
        return sum(count for causes in self.counts.values() for count in causes.values())

    @property
    def known(self) -> Mapping[str, tuple[float, float, float, str]]:
        """The quantities to use: fitted, or learned online."""
        return self.refit.quantities if self.refit is not None and self.refit.use else self.identified

    def json(self) -> dict[str, Any]:
        """As JSON values: a number that is not finite becomes null."""
        content: dict[str, Any] = finite({**self._asdict(), "refit": self.refit and self.refit._asdict()})
        return content


def quantity(value: float, low: float, high: float, unit: str) -> str:
    """An identified quantity with its 90 % interval, in words."""
    return f"{value:.3g} ({low:.3g} ... {high:.3g}) {unit}" if math.isfinite(value) else "not known yet"


COMPILING = Health(
    "compiling", "preparing compiled code, for minutes at the first start", {}, {}, 0, 0, 0, None, 0.0, math.inf, {},
    {}, (),
)  # fmt: skip


def seconds(value: float) -> str:
    """A duration for a person."""
    if not math.isfinite(value):
        return "never"
    if value < 120:
        return f"{value:.0f} s"
    return f"{value / 60:.0f} min" if value < 7200 else f"{value / 3600:.1f} h"


SILENT = 1.0  # s without a message, from which on a channel is reported, at least
USELESS = ("not_a_number", "no_time", "out_of_range", "backwards", "ahead", "alone", "wrong_type", "empty", "text",
           "frozen")  # fmt: skip


class Listening:
    """Notes when each part came last, and whether its messages can be used; stamps run `warp` times as fast."""

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
        """The state, and a sentence: what is missing and since when."""
        never = [part for part, age in ages.items() if age == math.inf]
        if never:
            return "waiting", f"waiting for {', '.join(map(self._named, never))}"
        old, rare = [], []
        for part, age in ages.items():
            source = self._sources[part]
            channel = part.partition("[")[0]
            interval, window = (windows or {}).get(channel, (0.0, MOST_WINDOW))
            longest = (window if source.window == AUTO else float(source.window)) + float(source.period) + 2 * dt
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


SPAN, LEAST = 30.0, 15  # s of steps that are judged, and as many steps at least
SILENCES, MINUTE = 3, 60  # silences of a channel within as many looks, from which on it comes too seldom
FRESH, MEASURED = 0.75, 0.5  # shares of the steps, and of the speeds that come, below which many are lost


class Cause(NamedTuple):
    """Why many steps are lost."""

    sentence: str  # of the state
    warning: str  # with the key to change


PACE, LOST = 0.5, 0.6  # share of the steps that a second should bring; of the speeds that were learned in the best one
IDLE, GAP = 20.0, 5.0  # s of a look, at least; s without a look, after which it begins anew


class Pace:
    """Counts steps and learned speeds in real seconds: stamps that stand still bring none. It is asked each second."""

    def __init__(self, warp: float):
        self._warp, self._best = warp, 0.0  # the most speeds that were learned in a second
        self._counts: deque[tuple[float, int, int]] = deque()  # s of the clock, steps, learned

    def judged(self, node: Node, clock: float) -> Cause | None:
        """Why hardly a step was made, or little learned, in the last 45 s; None if that is not so."""
        if self._counts and (node.grid < self._counts[-1][1] or clock - self._counts[-1][0] > GAP):
            self._counts.clear()
        self._counts.append((clock, node.grid, node.learned))
        while self._counts[0][0] < clock - 1.5 * SPAN:
            self._counts.popleft()
        begin, steps, learned = self._counts[0]
        elapsed, made, new = clock - begin, node.grid - steps, node.learned - learned
        wanted = elapsed * self._warp / node.dt
        if elapsed < IDLE or wanted < LEAST:
            return None
        if made >= PACE * wanted:
            if elapsed < 1.4 * SPAN:  # a channel that is to blame is named first
                return None
            self._best = max(self._best, new / elapsed)
            if not new:
                return Cause("nothing is learned", f"none of the last {made} steps had all inputs and a measured speed")
            if new < LOST * self._best * elapsed:
                why = f"{new} speeds were learned in the last {elapsed:.0f} s, and {self._best * elapsed:.0f} before"
                return Cause("many messages are lost", f"{why}: messages are lost: check their senders and the link")
            return None
        share = f"{made} of {wanted:.0f} steps were made in the last {elapsed:.0f} s"
        return Cause(
            "hardly a step is made, because the stamps of the messages stand still or run slowly",
            f"{share}: the stamps of the messages stand still or run slowly: restart what sends them",
        )


class _Count(NamedTuple):
    steps: int
    fresh: int
    measured: int
    stale: Counter[str]  # channel -> steps without a recent value of it
    ages: dict[str, float]  # channel -> s since its last message


class Usable:
    """Counts the steps of a node. It is asked once a second."""

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

        While a part is silent for long, s by part, or never came, nothing is concluded.
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
        cause = self._lost(node, self._counts[0], now) if now.steps - self._counts[0].steps >= wanted else None
        if cause is None or self._cause is None or self._cause[:2] != cause[:2]:
            self._cause = cause
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
