"""Which figures of a finished replay are drawn, the most important first, and how many.

    runs                measured and predicted speed of every run, and its worst minute, RUNS in a figure
    identified curves   with bands, over the season
    forecast            some forecasts of the last run
    open-loop simulation            the last run, simulated with the parameters before it
    prediction          a run, with intervals and some members
    thrusters           a run with an event

A figure takes as long as ten thousand compiled steps. A replay gets LEAST_FIGURES, or one for each boat; one more for
each STEPS_PER_FIGURE steps of its boats; and that of the first event of each boat. `log: all` draws all, of every run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from usvlearn.core.samples import Fleet, Run, masks, tree_map
from usvlearn.display.event_figure import course_of, event_figure
from usvlearn.display.figures import main_estimators, prediction_figure
from usvlearn.engine.rollouts import simulate, tensors
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.monitors.state import THRESHOLD
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.reading import Identified
from usvlearn.evaluation.identification import Truth
from usvlearn.runs.published import PUBLISHED, Published, joined
from usvlearn.runs.tensorboard.run_figures import Traces, forecast_figure, free_figure, identified_figure, runs_figure

LEAST_FIGURES, STEPS_PER_FIGURE = 4, 100_000
RUNS = 24  # in a figure
SEASONS = 4  # bands of identified curves


class Figure(NamedTuple):
    """A figure that is not drawn yet."""

    boat: str
    tag: str
    step: int  # s of run time at the end, and the number of the run
    draw: Callable[[], Any]


class Replayed(NamedTuple):
    """What is drawn of a replay, beside what it published."""

    fleet: Fleet
    ensemble: Ensemble
    clocks: np.ndarray  # (runs + 1, boats) whole seconds of run time before each run, and at the end
    seasons: Sequence[tuple[np.ndarray, Mapping[str, Identified]]]  # clock of the boats, and what was identified then
    before_last: EnsembleState | None  # the state before the last run
    truth: Truth  # quantities of simulated boats
    everything: bool  # whether all figures are drawn


def figures(
    replayed: Replayed, data: Mapping[str, Any], events: Mapping[str, Sequence[Mapping]], published: Published
) -> Iterator[Figure]:
    """The figures of a replay, the most important first.

    Args:
        replayed: the replay.
        data: section of the configuration, which says when a simulated thruster fails.
        events: per boat; see `usvlearn.evaluation.events.events`.
        published: of the run.

    Raises:
        MissingExtraError: matplotlib is not installed; while it is gone through.
    """
    drawing = _Drawing(replayed, data, events, published)
    for element, boat in enumerate(replayed.fleet.boats):
        if events.get(boat):
            yield drawing.thrusters(drawing.index_of(element, events[boat][0]["run"]), element)
    allowed = (
        max(LEAST_FIGURES, len(replayed.fleet.boats))
        + replayed.fleet.steps * len(replayed.fleet.boats) // STEPS_PER_FIGURE
    )
    wanted = list(drawing.every())
    chosen = wanted if replayed.everything else wanted[:allowed]
    yield from sorted(chosen, key=lambda figure: (replayed.fleet.boats.index(figure.boat), figure.step))


class _Drawing:
    """Makes the figures of a replay."""

    def __init__(self, replayed: Replayed, data: Mapping, events: Mapping, published: Published):
        self.replayed, self.data, self.events, self.published = replayed, data, events, published
        self.fleet, self.ensemble = replayed.fleet, replayed.ensemble
        self._held: tuple[Any, dict[str, np.ndarray]] = None, {}  # what was read last
        self._places: dict[int, list[tuple[int, int, int]]] = {}  # of the stretches of each run
        for place in published.places():
            self._places.setdefault(place[0], []).append(place)
        self._free: dict[int, np.ndarray] = {}

    def every(self) -> Iterator[Figure]:
        """All figures but those of events."""
        elements = range(len(self.fleet.boats))
        ends = [max(k for k, run in enumerate(self.fleet.runs) if run.lengths[element]) for element in elements]
        *earlier, last = range(len(self.fleet.runs) % RUNS or RUNS, len(self.fleet.runs) + 1, RUNS)
        yield from (self.runs(last, element) for element in elements if any(self._lengths(last, element)))
        if self.replayed.seasons:
            yield from (self.identified(ends[element], element) for element in elements)
        if self.ensemble.forecasts is not None:
            yield from (self.forecast(ends[element], element) for element in elements)
        if self.replayed.before_last is not None:
            final = len(self.fleet.runs) - 1
            yield from (self.free(final, element) for element in elements if ends[element] == final)
        for stop in reversed(earlier):
            yield from (self.runs(stop, element) for element in elements if any(self._lengths(stop, element)))
        yield from (self.prediction(ends[element], element) for element in elements)
        if self.replayed.everything:
            for index, run in enumerate(self.fleet.runs):
                yield from (
                    self.prediction(index, element)
                    for element in elements
                    if run.lengths[element] and index < ends[element]
                )
            if self.ensemble.watched:
                yield from (self.thrusters(ends[element], element) for element in elements)

    def _lengths(self, stop: int, element: int) -> list[int]:
        """Of a boat's last RUNS runs before a number."""
        return [run.lengths[element] for run in self.fleet.runs[max(0, stop - RUNS) : stop]]

    def index_of(self, element: int, name: str) -> int:
        return next(k for k, run in enumerate(self.fleet.runs) if run.names[element] == name)

    def runs(self, stop: int, element: int) -> Figure:
        """The ensemble's prediction of RUNS runs, those before a number."""
        indices = [max(0, stop - RUNS) + k for k, length in enumerate(self._lengths(stop, element)) if length]

        def draw():
            column, name = self.ensemble.names.index(self.ensemble.output), self.ensemble.output
            shown = []
            for index in indices:
                time, surge, found = self._of(index, element, ("predictions",))
                shown.append(
                    Traces(self.fleet.runs[index].names[element], time, surge, found["predictions"][:, column])
                )
            return runs_figure(shown, name, f"{self.fleet.boats[element]}: {len(shown)} runs")

        return self._figure(indices[-1], element, "runs", draw)

    def prediction(self, index: int, element: int) -> Figure:
        """The ensemble's prediction and interval, and three members: the paper's, or else the first ones."""

        def draw():
            time, surge, found = self._of(index, element)
            names, places = self._shown()
            own = found["halfwidths"][:, places[-1]]
            title = self._title(index, element)
            return prediction_figure(time, surge, found["predictions"][:, places], names, title, own)

        return self._figure(index, element, "prediction", draw)

    def free(self, index: int, element: int) -> Figure:
        """The last run, simulated from the parameters before it."""

        def draw():
            time, surge, _ = self._of(index, element)
            names, places = self._shown()
            if index not in self._free:
                run, state = self.fleet.runs[index], self.replayed.before_last
                assert state is not None
                samples = tensors(run.samples, state.predictions.dtype)
                with torch.no_grad():
                    _, _, kept = simulate(self.ensemble, state, samples, record=["predictions"])
                self._free[index] = kept["predictions"].double().numpy()
            predictions = self._free[index][: len(time), element][:, places]
            title = f"{self._title(index, element)}: open-loop simulation, parameters as before it"
            return free_figure(time, surge, predictions, names, title)

        return self._figure(index, element, "open-loop simulation", draw)

    def forecast(self, index: int, element: int) -> Figure:
        """Forecasts of some origins."""

        def draw():
            time, surge, found = self._of(index, element)
            made = self.ensemble.forecasts
            if made is None or "forecasts" not in found:
                return None
            horizons = made.horizons.tolist()
            own = found["forecasts"].reshape(len(time), len(horizons), -1)[..., -1]
            title = f"{self._title(index, element)}: forecasts up to {max(horizons):g} s ahead"
            return forecast_figure(
                time, surge, own, found["forecast_halfwidths"], horizons, self.ensemble.output, title
            )

        return self._figure(index, element, "forecast", draw)

    def identified(self, index: int, element: int) -> Figure:
        """Curves of forces at some times of the season."""
        boat, seasons = self.fleet.boats[element], self.replayed.seasons

        def draw():
            chosen = np.unique(np.linspace(0, len(seasons) - 1, SEASONS + 1).astype(int)[1:])
            shown = [each for k in chosen if (each := curves(seasons[k][1][boat]))]
            if not shown:
                return None
            hours = seasons[-1][0][element] / 3600
            title = f"{boat} after {hours:.2g} h" + (" (fainter: earlier)" if len(shown) > 1 else "")
            return identified_figure(shown, seasons[-1][1][boat], self.replayed.truth.get(boat, {}), title)

        return self._figure(index, element, "identified curves", draw)

    def thrusters(self, index: int, element: int) -> Figure:
        """Health of the thrusters; if the log is simulated, also the fault."""

        def draw():
            time, surge, found = self._of(index, element)
            run, fault = self.fleet.runs[index], self.data.get("fault")
            began = None if fault is None else 60 * (fault["minute"] - index * self.data["mission_minutes"])
            inputs = tree_map(lambda x: x[: len(time), element], run.samples.inputs)
            course = course_of(self.ensemble.names, self.ensemble.output, time, inputs, surge, found)
            happened = self.events[self.fleet.boats[element]]
            marks = [(each["time"], each["kind"]) for each in happened if each["run"] == run.names[element]]
            seen = began if began is not None and time[0] <= began <= time[-1] else None
            return event_figure(course, THRESHOLD, marks, seen, self._title(index, element))

        return self._figure(index, element, "thrusters", draw)

    def _figure(self, index: int, element: int, tag: str, draw: Callable[[], Any]) -> Figure:
        step = int(self.replayed.clocks[-1, element]) + index  # after all points, so that a resumed run replaces it
        return Figure(self.fleet.boats[element], f"7 figures/{tag}", step, draw)

    def _title(self, index: int, element: int) -> str:
        return f"{self.fleet.boats[element]}, {self.fleet.runs[index].names[element]}"

    def _shown(self) -> tuple[list[str], list[int]]:
        """The estimators in figures, and their columns: the ensemble last."""
        shown = main_estimators(self.ensemble.weighed, self.ensemble.output)
        return shown, [self.ensemble.names.index(name) for name in shown]

    def _of(
        self, index: int, element: int, names: Sequence[str] = PUBLISHED
    ) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Time, measured speed, and what was published of a boat's run; all `(time, …)`."""
        if self._held[0] != (index, names):
            places = self._places.get(index, [])
            self._held = (index, names), joined([self.published.read(*place, names).arrays for place in places])
        run: Run = self.fleet.runs[index]
        part = slice(0, run.lengths[element])
        surge = np.where(masks(run.samples, self.ensemble.surge_limit).learns, run.samples.surge, np.nan)[part, element]
        return run.time[part, element], surge, {name: array[part, element] for name, array in self._held[1].items()}
