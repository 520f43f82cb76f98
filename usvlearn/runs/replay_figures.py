"""Which figures of a finished replay are drawn for TensorBoard, and how many."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import Fleet, masks, tree_map
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.monitors.state import THRESHOLD
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.evaluation.identification import Truth
from usvlearn.runs.figures import Traces, course_of, event_figure, forecast_figure, identified_figure, runs_figure
from usvlearn.runs.prediction_files import Published, joined

LEAST_FIGURES, STEPS_PER_FIGURE = 4, 100_000  # of a replay: a figure takes as long as ten thousand compiled steps
RUNS = 24  # in a figure
SEASONS = 4  # bands of identified curves


class Replayed(NamedTuple):
    """What is drawn of a replay."""

    fleet: Fleet
    ensemble: Ensemble
    seasons: Sequence[tuple[np.ndarray, Mapping[str, Identified]]]  # clock of the boats, and what was identified then
    truth: Truth  # quantities of simulated boats
    data: Mapping[str, Any]  # section of the configuration, which says when a simulated thruster fails
    results: Mapping[str, Any]  # of `results.json`
    published: Published


def figures(replayed: Replayed, everything: bool) -> Iterator[tuple[str, str, int, Callable[[], Any]]]:
    """The boat, the title, the index of the last run, and what draws each figure of a replay.

    The first event of each boat is drawn in any case; of the rest LEAST_FIGURES or one for each boat, and one more for
    each STEPS_PER_FIGURE steps of its boats; with `everything` all, of every run.

    Raises:
        MissingExtraError: matplotlib is not installed; while it is gone through.
    """
    fleet, seasons, results = replayed.fleet, replayed.seasons, replayed.results
    ends = {boat: max(k for k, run in enumerate(fleet.runs) if run.lengths[e]) for e, boat in enumerate(fleet.boats)}
    parts = [range(max(0, stop - RUNS), stop) for stop in range(len(fleet.runs), 0, -RUNS)]
    wanted: list[tuple[str, str, int, Callable[[], Any]]] = []
    for part in parts if everything else parts[:1]:
        for boat, own in ((boat, [k for k in part if fleet.runs[k].lengths[e]]) for e, boat in enumerate(fleet.boats)):
            if own:
                wanted.append((boat, "runs", own[-1], partial(_runs, replayed, boat, own)))
    for boat in fleet.boats if seasons else ():
        wanted.append((boat, "identified curves", ends[boat], partial(_identified, replayed, boat)))
    for boat, found in (results.get("forecast") or {}).items():
        wanted.append((boat, "forecasts", ends[boat], partial(forecast_figure, {boat: found})))
    allowed = max(LEAST_FIGURES, len(fleet.boats)) + fleet.steps * len(fleet.boats) // STEPS_PER_FIGURE
    chosen = wanted if everything else wanted[:allowed]
    for boat, happened in results["events"].items():
        if happened:
            index = next(k for k, r in enumerate(fleet.runs) if r.names[fleet.boats.index(boat)] == happened[0]["run"])
            chosen.append((boat, "thrusters", index, partial(_thrusters, replayed, boat, index)))
    yield from sorted(chosen, key=lambda each: (fleet.boats.index(each[0]), each[2]))


def _of(replayed: Replayed, boat: str, index: int, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, dict]:
    """Time, measured speed, and what was published of a boat's run; all `(time, …)`."""
    places = [place for place in replayed.published.places() if place[0] == index]
    found = joined([replayed.published.read(*place, names).arrays for place in places])
    run, element = replayed.fleet.runs[index], replayed.fleet.boats.index(boat)
    part = slice(0, run.lengths[element])
    surge = np.where(masks(run.samples, replayed.ensemble.surge_limit).learns, run.samples.surge, np.nan)[part, element]
    return run.time[part, element], surge, {name: array[part, element] for name, array in found.items()}


def _runs(replayed: Replayed, boat: str, indices: Sequence[int]) -> Any:
    """The ensemble's prediction of some runs."""
    name, element, shown = replayed.ensemble.output, replayed.fleet.boats.index(boat), []
    for index in indices:
        time, surge, found = _of(replayed, boat, index, ("predictions",))
        made = found["predictions"][:, replayed.ensemble.names.index(name)]
        shown.append(Traces(replayed.fleet.runs[index].names[element], time, surge, made))
    return runs_figure(shown, name, f"{boat}: {len(shown)} runs")


def _identified(replayed: Replayed, boat: str) -> Any:
    """Curves of forces at some times of the season."""
    seasons = replayed.seasons
    chosen = np.unique(np.linspace(0, len(seasons) - 1, SEASONS + 1).astype(int)[1:])
    if not (shown := [each for k in chosen if (each := curves(seasons[k][1][boat]))]):
        return None
    hours = seasons[-1][0][replayed.fleet.boats.index(boat)] / 3600
    title = f"{boat} after {hours:.2g} h" + (" (fainter: earlier)" if len(shown) > 1 else "")
    return identified_figure(shown, seasons[-1][1][boat], replayed.truth.get(boat, {}), title)


def _thrusters(replayed: Replayed, boat: str, index: int) -> Any:
    """Health of the thrusters; if the log is simulated, also the fault."""
    time, surge, found = _of(replayed, boat, index, ("predictions", "thrusters", "health"))
    run, element, fault = replayed.fleet.runs[index], replayed.fleet.boats.index(boat), replayed.data.get("fault")
    began = None if fault is None else 60 * (fault["minute"] - index * replayed.data["mission_minutes"])
    inputs = tree_map(lambda x: x[: len(time), element], run.samples.inputs)
    course = course_of(replayed.ensemble.names, replayed.ensemble.output, time, inputs, surge, found)
    happened = replayed.results["events"][boat]
    marks = [(each["time"], each["kind"]) for each in happened if each["run"] == run.names[element]]
    seen = began if began is not None and time[0] <= began <= time[-1] else None
    return event_figure(course, THRESHOLD, marks, seen, f"{boat}, {run.names[element]}")
