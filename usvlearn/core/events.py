"""Events: a thruster loses thrust or recovers, or the boat changes; what the estimators found and did.

`EventWatch` reads one row of numbers for each step of one boat: the first two of `thrusters` and all of `health` that
docs/runs.md describes, each for left and right but for the last:

    share, deviation    effectiveness of the thruster, and its standard deviation
    raised              1 while its alarm is on
    handed              1 from when the filters got the effectiveness until the thruster has recovered
    changes             count of changes that each filter with trials has confirmed
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

SIDES, BOTH = ("left", "right"), "both"
FIXED = 8  # columns of a row without those of the changes
SHARE, DEVIATION, RAISED, HANDED = range(0, FIXED, 2)
SETTLES = 120.0  # s after an alarm, up to which its effectiveness is updated
TOGETHER = 30.0  # s within which changes of several filters are one event, and a loss explains a change
NINETY = 1.645  # standard deviations of a 90 % interval
LOSS, RECOVERY, CHANGE = "loss", "recovery", "change"


class Event(NamedTuple):
    """What happened. The effectiveness is a share of the thrust; NaN where it is not known."""

    time: float  # s
    kind: str  # LOSS, RECOVERY, CHANGE
    side: str = ""  # of the thruster, or both: the engine, or one that nothing tells from the other; "" of a change
    effectiveness: float = math.nan
    low: float = math.nan  # ends of its 90 % interval
    high: float = math.nan
    given: float = math.nan  # s after the alarm, when the filters got it
    filters: tuple[str, ...] = ()  # that got it, or that have replaced their parameters

    @property
    def is_alarm(self) -> bool:
        """Whether a thruster has just lost thrust: not that the filters have got its effectiveness."""
        return self.kind == LOSS and not math.isfinite(self.given)

    @property
    def name(self) -> str:
        """What has lost thrust."""
        return "the boat" if self.side == BOTH else f"the {self.side} thruster"

    @property
    def sentence(self) -> str:
        """The event in words."""
        who = " and ".join(self.filters)
        if self.kind == CHANGE:
            return f"the boat has changed: {who} ha{'s' if len(self.filters) == 1 else 've'} learned other parameters"
        both, name = self.side == BOTH, self.name
        if self.kind == RECOVERY:
            return f"{name} gives its full thrust again"
        if math.isnan(self.effectiveness):
            return f"{name} has lost thrust"
        ends = f" ({100 * self.low:.0f} ... {100 * self.high:.0f} %)" if math.isfinite(self.low) else ""
        handed = f"; {who} got this after {self.given:.0f} s" if math.isfinite(self.given) and who else ""
        of = "the thrust of both sides" if both else "its thrust"
        untold = "; speed and turns do not tell which side" if both else ""
        return f"{name} gives {100 * self.effectiveness:.0f} % of {of}{ends}{untold}{handed}"


class EventWatch:
    """Finds the events of one boat, step by step; `filters` are named in the order of their columns."""

    def __init__(self, filters: Sequence[str] = ()):
        self.filters = tuple(filters)
        self.losses: dict[int, Event] = {}  # of the sides that have lost thrust, as far as they are known
        self._row: np.ndarray | None = None
        self._time = -math.inf

    def differs(self, row: np.ndarray) -> bool:
        """Whether a row says something else than the last one that was seen, but for shares."""
        return self._row is None or not np.array_equal(row[RAISED:], self._row[RAISED:])

    def settles(self, time: float) -> bool:
        """Whether a loss is so young at `time`, s, that its effectiveness is still updated."""
        return any(time - event.time <= SETTLES for event in self.losses.values())

    def see(self, time: float, row: Any) -> list[Event]:
        """The events of a step: a loss again when the filters get it; no change of the boat that a loss explains.

        What is on already at the first step is an alarm, and counts begin there: the model may be that of a checkpoint.
        Where the time, s, goes back, because a clock began anew, losses count from there.
        """
        row, events = np.asarray(row, float), list[Event]()
        before = self._row
        if before is None:
            before = row.copy()
            before[RAISED:HANDED] = 0.0
            before[HANDED:FIXED] = row[HANDED:FIXED]
        if time < self._time:
            self.losses = {side: event._replace(time=time) for side, event in self.losses.items()}
        self._row, self._time = row, time
        on = [bool(row[RAISED + side] > 0 or row[HANDED + side] > 0) for side in range(2)]
        both = all(on) and all(event.side == BOTH for event in self.losses.values())
        for side, name in enumerate(SIDES):
            if not on[side]:
                if (ended := self.losses.pop(side, None)) is not None:
                    events.append(Event(time, RECOVERY, name if any(on) else ended.side))
                continue
            first, new = side not in self.losses, row[HANDED + side] > before[HANDED + side]
            event = self.losses.get(side, Event(time, LOSS))._replace(side=BOTH if both else name)
            late = time - event.time
            if not (first or new or late <= SETTLES):
                self.losses[side] = event
                continue
            share, spread = max(row[SHARE + side], 0.0), NINETY * row[DEVIATION + side]
            known = 0 < spread < math.inf
            low, high = (max(share - spread, 0.0), share + spread) if known else (math.nan, math.nan)
            event = event._replace(effectiveness=float(share), low=float(low), high=float(high))
            if new and not first:
                event = event._replace(given=late, filters=self.filters)
            if first or new:
                events.append(event)
            self.losses[side] = event
        if [event.side for event in events] == [BOTH, BOTH]:
            del events[1]
        changed = tuple(name for name, x, y in zip(self.filters, row[FIXED:], before[FIXED:], strict=True) if x > y)
        if changed and not any(time - event.time <= TOGETHER for event in self.losses.values()):
            events.append(Event(time, CHANGE, filters=changed))
        return events


def event_of(values: Mapping[str, Any]) -> Event:
    """The event from its JSON values."""
    known = {key: x for key, x in values.items() if key in Event._fields and x is not None}
    return Event(**{**known, "filters": tuple(known.get("filters", ()))})
