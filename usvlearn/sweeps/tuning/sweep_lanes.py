"""The jobs of a sweep as lanes of one batch, in place of a replay each: numeric hyperparameters of one member.

A member learns alone, whatever the ensemble is, so that its errors are those of a job, up to rounding. A lane saves no
parameters and no predictions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from usvlearn.core.samples import Fleet
from usvlearn.display.activity_bar import Activity
from usvlearn.errors import under
from usvlearn.estimators.baselines.persistence.layer import Persistence
from usvlearn.estimators.rnn.layer import RNN, lane_weights
from usvlearn.evaluation.by_run import FREE as FREE_RUNS
from usvlearn.evaluation.by_run import STEP, RunError
from usvlearn.evaluation.free_simulation import check_halves
from usvlearn.evaluation.measure import COVERAGE, FORECAST, FREE, Measure, measure_of
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.evaluation.networks import verdict
from usvlearn.evaluation.ranking import named
from usvlearn.sweeps.jobs import Lane, SweepNote
from usvlearn.sweeps.launchers import set_threads
from usvlearn.sweeps.seeds import SEED, seeded
from usvlearn.sweeps.tuning.lanes import LANES, LaneErrors, check_one_estimator, hyperparameters, lane_errors
from usvlearn.sweeps.tuning.tune import WAYS, builder

Jobs = Sequence[Mapping[str, str]]  # the settings of each, by key


def member_of(note: SweepNote) -> str | None:
    """The member whose settings a sweep varies, beside the seed; None if there is not exactly one."""
    names = {name for key in note.swept if (name := named(key)) is not None}
    return names.pop() if len(names) == 1 else None


def paths_of(note: SweepNote, member: str) -> dict[str, str]:
    """The swept keys of a member, and their paths in it."""
    prefix = f"estimators.{member}."
    return {key: key.removeprefix(prefix) for key in note.swept if key.startswith(prefix)}


def why_not(configuration: Mapping[str, Any], note: SweepNote, jobs: Jobs, instantiate: Callable[[Any], Any]) -> str:
    """Why the jobs of a sweep cannot be lanes, in words; "" if they can.

    Args:
        configuration: without the swept values.
        note: of the sweep.
        jobs: their settings.
        instantiate: makes the object that a node of the configuration describes.

    Raises:
        ConfigError: a value is not legal.
    """
    member = member_of(note)
    if not jobs or member is None or member not in configuration["estimators"]:
        return f"the keys {', '.join(note.swept) or '(none)'} are not those of one member"
    paths = paths_of(note, member)
    if other := [key for key in note.swept if key not in paths and key != SEED]:
        return f"{other[0]} is no hyperparameter of a member"
    if ways := [way for way in WAYS if configuration.get(way) is not None]:
        return f"{ways[0]} is set"
    measure = measure_of(note.objective, member)
    if measure.estimator != member or measure.kind == COVERAGE:
        return f"the objective is {measure}, no error of {member} alone"
    build = builder(configuration["estimators"], member, instantiate)
    known = hyperparameters(check_one_estimator(member, build({})))
    known = {path: part for path, part in known.items() if not isinstance(part, RNN)}
    for key, path in paths.items():
        if path not in known:
            return f"{key} is no number that lanes can differ in; those of {member} are {', '.join(known)}"
        for text in dict.fromkeys(job[key] for job in jobs):
            try:
                value = float(text)
            except ValueError:
                return f"{key}={text} is no number"
            build({path: value})  # an illegal one is told alone
    return ""


def run_lanes(
    configuration: Mapping[str, Any],
    note: SweepNote,
    jobs: Jobs,
    instantiate: Callable[[Any], Any],
    align: Callable[..., Fleet],
    console: Console,
) -> list[Lane]:
    """Run all jobs, those of a seed together; returns them in their order.

    Args:
        configuration, note, jobs, instantiate: as of `why_not`, which has found no reason.
        align: makes a fleet of recordings, with the options of `align`.
        console: shows the progress.

    Raises:
        ConfigError: a value is not legal, or the logs are too few for the objective.
    """
    set_threads(configuration["threads"])
    member = member_of(note) or ""
    measure, paths = measure_of(note.objective, member), paths_of(note, member)
    found: dict[int, Lane] = {}
    with Activity(console) as activity:
        activity.begin(what := f"{len(jobs)} settings of {member} as lanes", total=len(jobs))
        for seed in dict.fromkeys(job.get(SEED) for job in jobs):
            own = seeded(configuration if seed is None else {**configuration, SEED: _whole(seed)})
            with under("data", own["data"]):
                fleet = align(instantiate(own["data"]), **own["align"])
            activity.tell(what)
            if measure.kind == FREE:
                check_halves(fleet)
            build = builder(own["estimators"], member, instantiate)
            base = lane_errors(Persistence(), fleet, measure=measure)
            places = [k for k, job in enumerate(jobs) if job.get(SEED) == seed]
            most = max(1, LANES // len(fleet.boats))
            for begin in range(0, len(places), most):
                part, began = places[begin : begin + most], time.perf_counter()
                estimator = build({path: [[float(jobs[k][key])] for k in part] for key, path in paths.items()})
                made = lane_errors(estimator, fleet, (len(part),), _advance(activity, len(part)), measure=measure)
                seconds = (time.perf_counter() - began) / len(part)
                for k, (results, errors) in zip(part, _judged(fleet, made, base, member, measure), strict=True):
                    found[k] = Lane(
                        [f"{key}={x}" for key, x in jobs[k].items()], results | {"seconds": seconds}, errors
                    )
                if isinstance(estimator, RNN):
                    for place, k in enumerate(part):
                        found[k].results["network"] = {
                            boat: {member: verdict(lane_weights(made.state, (place, lane))).json()}
                            for lane, boat in enumerate(fleet.boats)
                        }
    return [found[k] for k in range(len(jobs))]


def _advance(activity: Activity, settings: int) -> Callable[[float], None]:
    return lambda share: activity.advance(share * settings)


def _whole(text: str) -> Any:
    return int(text) if text.isdecimal() else text


def _judged(
    fleet: Fleet, made: LaneErrors, base: LaneErrors, member: str, measure: Measure
) -> Iterator[tuple[dict[str, Any], list[RunError]]]:
    """The results of each lane, in the form of a replay, as far as they were measured; and its errors by run.

    Args:
        fleet: what was run.
        made: of the member, `(runs, settings, boats)`.
        base: of persistence, `(runs, boats)`.
        member: its name.
        measure: what was measured.
    """
    ahead = {FORECAST: f"{measure.horizon:g}", FREE: FREE_RUNS}.get(measure.kind, STEP)
    steps = made.steps.numpy().astype(int)
    sums = {member: made.errors.numpy(), PERSISTENCE: np.broadcast_to(base.errors.numpy()[:, None], steps.shape)}
    with np.errstate(invalid="ignore", divide="ignore"):
        runs = {name: x / steps for name, x in sums.items()}
        whole = {name: x.sum(0) / steps.sum(0) for name, x in sums.items()}
        skill = {name: 1 - x / whole[PERSISTENCE] for name, x in whole.items()}
    for place in range(steps.shape[1]):
        errors = [
            RunError(boat, run.names[lane], ahead, int(steps[index, place, lane]), {
                name: float(x[index, place, lane]) for name, x in runs.items() if np.isfinite(x[index, place, lane])
            })
            for lane, boat in enumerate(fleet.boats)
            for index, run in enumerate(fleet.runs)
            if steps[index, place, lane]
        ]  # fmt: skip
        rows = {
            boat: {
                name: {"mae": _known(whole[name][place, lane]), "skill": _known(skill[name][place, lane])}
                | {"steps": int(steps[:, place, lane].sum())}
                for name in whole
            }
            for lane, boat in enumerate(fleet.boats)
        }
        found: dict[str, Any] = {"boats": rows}
        if measure.kind == FORECAST:
            later = {b: {name: {ahead: row} for name, row in each.items()} for b, each in rows.items()}
            found = {"boats": {}, "forecast": later}
        if measure.kind == FREE:
            free = {b: {name: row["mae"] for name, row in each.items()} for b, each in rows.items()}
            found = {"boats": {}, "free": free}
        yield found | {"output": member, "measure": str(measure), "objective": measure.value(found)}, errors


def _known(x: Any) -> float | None:
    return float(x) if np.isfinite(x) else None
