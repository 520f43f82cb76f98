"""The events of a replay, boat by boat (`usvlearn.core.events`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.events import CHANGE, LOSS, RAISED, TOGETHER, Event, EventWatch
from usvlearn.core.samples import Fleet

Stretch = tuple[int, int, Mapping[str, np.ndarray]]  # index of a run, first step, what was published, (time, boats, …)
Found = list[tuple[str, float, Event]]  # name of the run, s before it, and the event on the clock of all runs


def events(fleet: Fleet, published: Iterable[Stretch], filters: Sequence[str] = ()) -> dict[str, list[dict[str, Any]]]:
    """The events of each boat in order, as JSON values: `run` and what `Event` has; None where nothing is known.

    A loss has the effectiveness of 2 min after its alarm, or of its end; what goes on in the next run is told once.
    Changes of several filters within 30 s are one.

    Args:
        fleet: what was replayed.
        published: stretches in order; none has `thrusters` and `health` where nobody watched.
        filters: as `Ensemble.accommodated`.
    """
    watches = [EventWatch(filters) for _ in fleet.boats]
    found: list[Found] = [[] for _ in fleet.boats]
    lengths = np.array([[_length(run.time[:, k]) for k in range(len(fleet.boats))] for run in fleet.runs])
    for index, step, arrays in published:
        thrusters, health = arrays.get("thrusters"), arrays.get("health")
        if thrusters is None or health is None:
            continue
        rows, run = np.concatenate([thrusters[..., :2], health], -1), fleet.runs[index]
        for element, watch in enumerate(watches):
            time, sailed = run.time[step : step + len(rows), element], float(lengths[:index, element].sum())
            _scan(watch, time, sailed, rows[:, element], run.names[element], found[element])
    return {boat: [_json(*each) for each in own] for boat, own in zip(fleet.boats, found, strict=True)}


def _length(time: np.ndarray) -> float:
    """The length of a run with its times, s; 0 of a boat without it."""
    return float(np.nanmax(time)) + 1.0 if np.isfinite(time).any() else 0.0


def _scan(watch: EventWatch, time: np.ndarray, sailed: float, rows: np.ndarray, run: str, found: Found) -> None:
    """Add the events of one boat in one stretch. Most rows say what those before say, and are skipped at once."""
    made = np.flatnonzero(~np.isnan(rows[:, RAISED]))
    said = rows[made, RAISED:]
    moves = np.flatnonzero((said[1:] != said[:-1]).any(-1)) + 1  # rows that differ from the one before
    if len(made) and watch.differs(rows[made[0]]):
        moves = np.append(0, moves)
    k = 0
    while k < len(made):
        now, place = sailed + float(time[made[k]]), int(np.searchsorted(moves, k))
        if not watch.settles(now):
            if place == len(moves):
                return
            k = int(moves[place])
            now = sailed + float(time[made[k]])
        for event in watch.see(now, rows[made[k]]):
            _add(found, run, sailed, event)
        for event in watch.losses.values():
            _update(found, event)
        k += 1


def _add(found: Found, run: str, sailed: float, event: Event) -> None:
    last = found[-1][2] if found else None
    if event.kind == CHANGE and last and last.kind == CHANGE and event.time - last.time <= TOGETHER:
        filters = tuple(dict.fromkeys((*last.filters, *event.filters)))
        found[-1] = *found[-1][:2], last._replace(filters=filters)
    elif event.kind != LOSS or event.is_alarm:
        found.append((run, sailed, event))


def _update(found: Found, event: Event) -> None:
    """The loss as it is known now, in the place where it was added."""
    for k in range(len(found) - 1, -1, -1):
        run, sailed, other = found[k]
        if other.kind == LOSS and other.side == event.side:
            found[k] = run, sailed, event
            return


def _json(run: str, sailed: float, event: Event) -> dict[str, Any]:
    values = event._replace(time=round(event.time - sailed, 6))._asdict()
    known = {key: None if x != x or x == "" else x for key, x in values.items()}
    return {"run": run, **known, "filters": list(event.filters)}
