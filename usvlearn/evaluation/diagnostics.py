"""Results of a boat and of an ensemble's members beside errors: quantities, networks, events, remarks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from certify.proofs import exact
from usvlearn.core.checkpoint import as_array
from usvlearn.core.events import BOTH, CHANGE, LOSS, RAISED, TOGETHER, Event, EventWatch
from usvlearn.core.protocol import spec_of
from usvlearn.core.samples import Fleet, named_leaves
from usvlearn.engine.identified import identified
from usvlearn.estimators.ensemble.combiners.layer import Average
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.planar.layer import Planar
from usvlearn.estimators.regressors.layer import QuasiStatic
from usvlearn.estimators.rnn.layer import RNN, element_weights
from usvlearn.evaluation.metrics import PERSISTENCE, Stretch

Truth = Mapping[str, Mapping[str, float]]  # boat -> quantity -> value


def identified_boats(
    model: Ensemble | Planar, state: Any, boats: Sequence[str], required: bool = False
) -> dict[str, Identified]:
    """The quantities of each boat by name, leaves `(boats, …)`; {} or an error without an averaged joint EKF."""
    ensemble = model.surge if isinstance(model, Planar) else model
    name = ensemble.averaged
    if name is None and not required:
        return {}
    if isinstance(model, Planar):
        described, some = model.description(), named_leaves(state)
    else:
        described = {"kind": "ensemble", "members": {} if name is None else {name: spec_of(ensemble.members[name])}}
        some = named_leaves(state.members.get(name, {}), f"members.{name}")
    leaves = {key: as_array(leaf) for key, leaf in some if "members." in key}
    return dict(zip(boats, identified(described, leaves), strict=True))


def as_results(identified: Mapping[str, Identified], truth: Truth) -> dict[str, Any]:
    """The entries `identified` and `lacks` of `results.json`; {} without an averaged joint EKF."""
    if not identified:
        return {}
    values = {boat: each.json() for boat, each in identified.items()}
    for boat, known in truth.items():
        for name in known.keys() & values.get(boat, {}).keys():
            values[boat][name]["truth"] = known[name]
    return {"identified": values, "lacks": {boat: list(each.lacks) for boat, each in identified.items()}}


def unwrapped(estimator: Any, state: Any = None) -> tuple[Any, Any]:
    """The innermost estimator, without wrappers, and its state."""
    while hasattr(estimator, "estimator"):
        estimator, state = estimator.estimator, getattr(state, "inner", state)
    return estimator, state


def remarks(ensemble: Ensemble) -> dict[str, str]:
    """Remarks beside names in a table of errors: the baseline, a quasi-static map, an average that includes one."""
    notes = {PERSISTENCE: "baseline"} if PERSISTENCE in ensemble.names else {}
    notes |= dict.fromkeys(_maps(ensemble), "quasi-static map")
    return notes | {rule: f"with {', '.join(maps)}" for rule, maps in _averages(ensemble).items()}


def explained(ensemble: Ensemble) -> list[str]:
    """A sentence about the quasi-static maps, if there are any."""
    if not (maps := _maps(ensemble)):
        return []
    return [
        f"{', '.join(maps)}: a quasi-static map, which predicts the speed from the commands, the heading and the yaw "
        "rate, and does not use the present speed."
    ]


def _maps(ensemble: Ensemble) -> list[str]:
    """The members that are quasi-static maps."""
    models = {name: getattr(unwrapped(member)[0], "model", None) for name, member in ensemble.members.items()}
    return [name for name, model in models.items() if isinstance(model, QuasiStatic)]


def _averages(ensemble: Ensemble) -> dict[str, list[str]]:
    """The plain averages that include quasi-static maps, each with the names of these maps."""
    averaged = {}
    for name, rule in ensemble.combiners.items():
        if isinstance(rule, Average):
            chosen = set(ensemble.members if rule.members is None else rule.members)
            averaged[name] = [each for each in _maps(ensemble) if each in chosen]
    return {name: maps for name, maps in averaged.items() if maps}


class Judged(NamedTuple):
    """What is proved of one network, and where it comes to rest."""

    proved: exact.Verdict | None  # None if the weights are not finite
    time_constant: float  # s; not positive if there is none
    equilibrium: float  # m/s, at rest, the one that is nearest to the speed; NaN if there is none

    def json(self) -> dict[str, Any]:
        """For `results.json`."""
        return exact.as_json(self.proved)


def verdicts(ensemble: Ensemble, state: EnsembleState, boats: Sequence[str]) -> dict[str, dict[str, Judged]]:
    """The verdict of each RNN, boat -> member -> verdict, of a state with leaves `(boats, …)`; {} without an RNN."""
    members = {name: member for name, member in ensemble.members.items() if isinstance(member, RNN)}
    judged: dict[str, dict[str, Judged]] = {boat: {} for boat in boats} if members else {}
    for name, member in members.items():
        learned = state.members[name]
        monitored = {key: value.tolist() for key, value in member.monitor(learned).items()}
        for element, boat in enumerate(boats):
            numbers = (monitored[key][element] for key in ("time_constant", "equilibrium"))
            judged[boat][name] = Judged(exact.verdict(element_weights(learned, element)), *numbers)
    return judged


Found = list[tuple[str, float, Event]]  # name of the run, s before it, and the event on the clock of all runs


def events(fleet: Fleet, published: Iterable[Stretch], filters: Sequence[str] = ()) -> dict[str, list[dict[str, Any]]]:
    """The events of each boat in order, as JSON values: `run` and what `Event` has; None where nothing is known.

    A loss has the effectiveness of 2 min after its alarm, or of its end; what goes on in the next run is told once.
    Changes of several filters within 30 s are one.
    """
    watches = [EventWatch(filters) for _ in fleet.boats]
    by_boat: list[Found] = [[] for _ in fleet.boats]
    lengths = np.array([[_length(run.time[:, k]) for k in range(len(fleet.boats))] for run in fleet.runs])
    for index, step, arrays in published:
        thrusters, health = arrays.get("thrusters"), arrays.get("health")
        if thrusters is None or health is None:
            continue
        rows, run = np.concatenate([thrusters[..., :2], health], -1), fleet.runs[index]
        for element, watch in enumerate(watches):
            time, sailed = run.time[step : step + len(rows), element], float(lengths[:index, element].sum())
            _scan(watch, time, sailed, rows[:, element], run.names[element], by_boat[element])
    return {boat: [_json(*each) for each in happened] for boat, happened in zip(fleet.boats, by_boat, strict=True)}


def _length(time: np.ndarray) -> float:
    """The length of a run with its times, s; 0 of a boat without it."""
    return float(np.nanmax(time)) + 1.0 if np.isfinite(time).any() else 0.0


def _scan(watch: EventWatch, time: np.ndarray, sailed: float, rows: np.ndarray, run: str, events: Found) -> None:
    """Add the events of one boat in one stretch. Most rows say what those before say, and are skipped at once."""
    steps = np.flatnonzero(~np.isnan(rows[:, RAISED]))
    said = rows[steps, RAISED:]
    moves = np.flatnonzero((said[1:] != said[:-1]).any(-1)) + 1  # rows that differ from the one before
    if len(steps) and watch.differs(rows[steps[0]]):
        moves = np.append(0, moves)
    k = 0
    while k < len(steps):
        now, place = sailed + float(time[steps[k]]), int(np.searchsorted(moves, k))
        if not watch.settles(now):
            if place == len(moves):
                return
            k = int(moves[place])
            now = sailed + float(time[steps[k]])
        for event in watch.see(now, rows[steps[k]]):
            _add(events, run, sailed, event)
        for event in watch.losses.values():
            _update(events, event)
        k += 1


def _add(events: Found, run: str, sailed: float, event: Event) -> None:
    last = events[-1][2] if events else None
    if event.kind == CHANGE and last and last.kind == CHANGE and event.time - last.time <= TOGETHER:
        filters = tuple(dict.fromkeys((*last.filters, *event.filters)))
        events[-1] = *events[-1][:2], last._replace(filters=filters)
    elif event.kind != LOSS or event.is_alarm:
        events.append((run, sailed, event))


def _update(events: Found, event: Event) -> None:
    """The loss as it is known now, in the place where it was added."""
    for k in range(len(events) - 1, -1, -1):
        run, sailed, other = events[k]
        if other.kind == LOSS and other.side in (event.side, BOTH):
            events[k] = run, sailed, event
            return


def _json(run: str, sailed: float, event: Event) -> dict[str, Any]:
    values = event._replace(time=round(event.time - sailed, 6))._asdict()
    known = {key: None if x != x or x == "" else x for key, x in values.items()}
    return {"run": run, **known, "filters": list(event.filters)}
