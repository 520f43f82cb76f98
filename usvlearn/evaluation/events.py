"""Events: a thruster loses thrust or recovers, or the boat changes; what the estimators found and did.

`EventWatch` reads one row of numbers for each step of one boat: the first two of `thrusters` and all of `health` that
`usvlearn.runs.published` describes, each for left and right but for the last:

    share, deviation    effectiveness of the thruster, and its standard deviation
    raised              1 while its alarm is on
    handed              1 once the filters have got the effectiveness
    changes             count of changes that each filter with trials has confirmed
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import Fleet

Stretch = tuple[int, int, Mapping[str, np.ndarray]]  # index of a run, first step, what was published, (time, boats, …)
SIDES = ("left", "right")
FIXED = 8  # columns of a row without those of the changes
SHARE, DEVIATION, RAISED, HANDED = range(0, FIXED, 2)
SETTLES = 120.0  # s after an alarm, up to which its effectiveness is updated
TOGETHER = 30.0  # s within which changes of several filters are one event
NINETY = 1.645  # standard deviations of a 90 % interval
LOSS, RECOVERY, CHANGE = "loss", "recovery", "change"


class Event(NamedTuple):
    """What happened. The effectiveness is a share of the thrust; NaN where it is not known."""

    time: float  # s
    kind: str  # LOSS, RECOVERY, CHANGE
    side: str = ""  # of the thruster; "" of a change
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
    def sentence(self) -> str:
        """The event in words.

        >>> Event(12.0, LOSS, "left", 0.41, 0.3, 0.52, 10.0, ("joint",)).sentence
        'the left thruster gives 41 % of its thrust (30 ... 52 %); joint got this after 10 s'
        >>> Event(80.0, RECOVERY, "left").sentence
        'the left thruster gives its full thrust again'
        >>> Event(30.0, CHANGE, filters=("joint", "joint_averaged")).sentence
        'the boat has changed: joint and joint_averaged have learned other parameters'
        """
        who = " and ".join(self.filters)
        if self.kind == CHANGE:
            return f"the boat has changed: {who} ha{'s' if len(self.filters) == 1 else 've'} learned other parameters"
        if self.kind == RECOVERY:
            return f"the {self.side} thruster gives its full thrust again"
        if math.isnan(self.effectiveness):
            return f"the {self.side} thruster has lost thrust"
        ends = f" ({100 * self.low:.0f} ... {100 * self.high:.0f} %)" if math.isfinite(self.low) else ""
        told = f"; {who} got this after {self.given:.0f} s" if math.isfinite(self.given) and who else ""
        return f"the {self.side} thruster gives {100 * self.effectiveness:.0f} % of its thrust{ends}{told}"


class EventWatch:
    """Finds the events of one boat, step by step.

    Args:
        filters: the names of those with trials, in the order of the columns.
        given: the names of those that get the effectiveness.

    >>> watch = EventWatch(["joint"], ["joint"])
    >>> watch.see(0.0, [1, 1, 0.3, 0.3, 0, 0, 0, 0, 0])
    []
    >>> [event.sentence for event in watch.see(0.4, [0.4, 1, 0.1, 0.3, 1, 0, 0, 0, 0])]
    ['the left thruster gives 40 % of its thrust (24 ... 56 %)']
    """

    def __init__(self, filters: Sequence[str] = (), given: Sequence[str] = ()):
        self.filters, self.given = tuple(filters), tuple(given)
        self.losses: dict[int, Event] = {}  # of the sides whose alarm is on, as far as they are known
        self._row = np.zeros(FIXED + len(self.filters))

    def see(self, time: float, row: Any) -> list[Event]:
        """The events of a step: a loss again when the filters get it; no change of the boat that a loss explains.

        Args:
            time: of the step, s.
            row: of numbers, as above.
        """
        row, before, found = np.asarray(row, float), self._row, []
        self._row = row
        for side, name in enumerate(SIDES):
            on, was = row[RAISED + side] > 0, before[RAISED + side] > 0
            if was and not on and side in self.losses:
                del self.losses[side]
                found.append(Event(time, RECOVERY, name))
            if not on:
                continue
            event = self.losses.get(side, Event(time, LOSS, name))
            late = time - event.time
            new = row[HANDED + side] > 0 and not before[HANDED + side] > 0
            if side in self.losses and not new and not late <= SETTLES:
                continue
            share, spread = row[SHARE + side], NINETY * row[DEVIATION + side]
            ends = (max(share - spread, 0.0), share + spread) if spread > 0 else (math.nan, math.nan)
            event = event._replace(effectiveness=float(max(share, 0.0)), low=float(ends[0]), high=float(ends[1]))
            if new:
                event = event._replace(given=late, filters=self.given)
            if side not in self.losses or new:
                found.append(event)
            self.losses[side] = event
        changed = [name for name, x, y in zip(self.filters, row[FIXED:], before[FIXED:], strict=True) if x > y]
        known = any(time - event.time <= TOGETHER for event in self.losses.values())
        return [*found, Event(time, CHANGE, filters=tuple(changed))] if changed and not known else found


def events(fleet: Fleet, published: Iterable[Stretch], filters: Sequence[str] = ()) -> dict[str, list[dict[str, Any]]]:
    """The events of each boat in order, as JSON values: `run` and what `Event` has; None where nothing is known.

    A loss has the effectiveness of 2 min after its alarm, or of its end. Changes of several filters within 30 s are
    one.

    Args:
        fleet: what was replayed.
        published: stretches in order; none has `thrusters` where nobody watched, and in older runs none has `health`.
        filters: as `Ensemble.accommodated`.
    """
    watches = [EventWatch(filters, filters) for _ in fleet.boats]
    found: list[list[tuple[str, Event]]] = [[] for _ in fleet.boats]
    for index, step, arrays in published:
        if (thrusters := arrays.get("thrusters")) is None:
            continue
        rows, run = _rows(thrusters, arrays.get("health"), len(filters)), fleet.runs[index]
        for element, watch in enumerate(watches):
            time = run.time[step : step + len(rows), element]
            _scan(watch, time, rows[:, element], run.names[element], found[element])
    return {boat: [_json(run, event) for run, event in each] for boat, each in zip(fleet.boats, found, strict=True)}


def _rows(thrusters: np.ndarray, health: np.ndarray | None, filters: int) -> np.ndarray:
    """The rows of `EventWatch`, `(time, boats, …)`; in older runs an alarm is that of the side with more evidence."""
    if health is None:
        right = thrusters[..., 2:3] < thrusters[..., 3:4]
        raised = np.concatenate([~right, right], -1) * thrusters[..., 4:]
        none = np.zeros_like(raised)
        health = np.concatenate([none, raised, none, *[none[..., :1]] * filters], -1)
    return np.concatenate([thrusters[..., :2], health], -1)


def _scan(watch: EventWatch, time: np.ndarray, rows: np.ndarray, run: str, found: list[tuple[str, Event]]) -> None:
    """Add the events of one boat in one stretch. Most rows equal those before in all that matters, and are skipped."""
    for k in np.flatnonzero(~np.isnan(rows[:, RAISED])):
        row = rows[k]
        if not watch.losses and np.array_equal(row[RAISED:], watch._row[RAISED:]):
            continue
        for event in watch.see(float(time[k]), row):
            _add(found, run, event)
        for event in watch.losses.values():
            _update(found, event)


def _add(found: list[tuple[str, Event]], run: str, event: Event) -> None:
    last = found[-1][1] if found and found[-1][0] == run else None
    if event.kind == CHANGE and last and last.kind == CHANGE and event.time - last.time <= TOGETHER:
        filters = tuple(dict.fromkeys((*last.filters, *event.filters)))
        found[-1] = run, last._replace(filters=filters)
    elif event.kind != LOSS or event.is_alarm:
        found.append((run, event))


def _update(found: list[tuple[str, Event]], event: Event) -> None:
    """The loss as it is known now, in the place where it was added."""
    for k in range(len(found) - 1, -1, -1):
        run, other = found[k]
        if other.kind == LOSS and other.side == event.side:
            found[k] = run, event
            return


def _json(run: str, event: Event) -> dict[str, Any]:
    values = {key: None if x != x or x == "" else x for key, x in event._asdict().items()}
    return {"run": run, **values, "filters": list(event.filters)}


def event_of(values: Mapping[str, Any]) -> Event:
    """The event from its JSON values.

    >>> event_of({"run": "7", "time": 1.0, "kind": "recovery", "side": "left"}).sentence
    'the left thruster gives its full thrust again'
    """
    known = {key: x for key, x in values.items() if key in Event._fields and x is not None}
    return Event(**{**known, "filters": tuple(known.get("filters", ()))})
