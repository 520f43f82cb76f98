"""Shows a replay in TensorBoard while it runs, at a bounded cost.

A tag is the same for all boats and estimators, each of which is a TensorBoard run (see
`usvlearn.display.tensorboard`). What concerns the boat is in the run of the ensemble's output:

    1 overview/…       over the last WINDOW steps: MAE, skill and coverage of the 90 % intervals one step ahead, skill
                       of forecasts and position error of tracks at the horizons SHOWN; alarms so far
    2 identified/…     quantities of MAIN, with their units
    3 weights/…        of the ensemble; the run is the member that is weighed
    4 contraction/…    the rate K of RNNs
    7 figures/…        of a boat: its runs, identified curves, forecasts, thrusters where one lost thrust
    8 results/…        of the whole run, for the HPARAMS page
    9 all/…            with `log: all`: the other horizons and quantities, and every number of `Ensemble.monitor`;
                       equilibrium_class counts from 0 in the order of certify.proofs.equilibria.CLASSES
    run/…              text: settings, configuration, data, networks, the command that repeats the run

A job of a sweep writes nothing, unless `log: all`: the page of the sweep compares the jobs.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from usvlearn.core.activity import doing
from usvlearn.core.samples import Fleet
from usvlearn.display.figures import SEVEN, attempted
from usvlearn.display.tensorboard import TensorBoardWriter, folder_name, folder_names
from usvlearn.engine.rollouts import stack
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.planar.state import CONSTANT, DUE, ERROR, HEADING_ERROR, HELD_RATE, RADIUS, RHO
from usvlearn.evaluation.diagnostics import Truth, identified_boats
from usvlearn.evaluation.horizons import FEWEST, LEAST
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.runs.compared import MAE, WINDOW, data_text, label, number, result_tag, results_of
from usvlearn.runs.figures import Replayed, figures
from usvlearn.runs.prediction_files import BEGIN, Position, Published
from usvlearn.runs.replay import Chunk

STEPS_PER_POINT = 100  # and boat: one point of all curves costs about as much as 100 compiled steps
MOST_POINTS = 200  # of a curve
MOST_IDENTIFIED, IDENTIFIED = 60, 300  # points of what is identified, and least s between two
FAR = 4.0  # times the value: ends of intervals beyond it would hide everything else in a chart
BATCH, PATIENCE = 32, 2.0  # points, or s, after which points are written together: monitoring many states is cheap
LOGS = MAIN_LOG, ALL = "main", "all"

IDENTIFIED_RUNS = {"identified": "value", "identified low": "low", "identified high": "high"}
FLEET, RESULTS, TRUE = "fleet", "results", "truth"
MAIN = ("steady_speed_full", "thrust_full_left", "thrust_full_right", "drag_half_speed", "time_constant",
        "stopping_distance", "mass")  # fmt: skip
SHOWN = ("2 s", "10 s", "30 s")  # horizons of forecasts; of tracks the second
ABOUT = {  # of a tag: what TensorBoard shows beside it
    "1 overview/": f"Over the last {WINDOW} steps, or those since the point before. Skill: 1 - MAE/MAE(persistence) "
    "over the same steps. Coverage: share of the measurements in the 90 % intervals. Position error: mean distance "
    "between forecast and measured position; the run persistence has that of a constant turn.",
    "2 identified/": "Value, 90 % interval and, of simulated boats, truth are runs beside each other. An end of the "
    f"interval that is farther from the value than {FAR:g} times the value is left out.",
    "3 weights/": "The run is the member that is weighed.",
    "4 contraction/": "Of the network of the run, which is contracting where K < 1.",
    "8 results/": "Of the whole run.",
    "9 all/": "What the estimator of the run reports about itself.",
}
Sums = dict[str, tuple[Sequence[str], np.ndarray]]  # tag -> its runs; sums and counts, (2, boats, runs)


class Point(NamedTuple):
    """What is drawn of one moment."""

    clock: np.ndarray  # (boats,) s of run time
    numbers: dict[tuple[str, str], np.ndarray]  # run and tag -> (boats,)
    state: EnsembleState


class TensorBoardLogger:
    """Draws a replay's chunks in TensorBoard: of `log="main"` what people read, of "all" every number and figure.

    `differs` are the settings that are not the default's, `texts` Markdown by title, `tracks` their horizons, s;
    `alone` tells a run of its own from a job of a sweep.
    """

    def __init__(
        self,
        folder: str | Path,
        fleet: Fleet,
        ensemble: Ensemble,
        begin: Position = BEGIN,
        differs: Mapping[str, str] | None = None,
        truth: Truth | None = None,
        log: str = MAIN_LOG,
        texts: Mapping[str, str] | None = None,
        alone: bool = True,
        tracks: Sequence[float] = (),
    ):
        check_log(log)
        self.fleet, self.ensemble, self.truth, self.tracks = fleet, ensemble, truth or {}, tuple(tracks)
        self.everything, self.silent, self.differs = log == ALL, not alone and log != ALL, differs or {}
        self.every = max(STEPS_PER_POINT * len(fleet.boats), -(-fleet.steps // MOST_POINTS))  # steps between points
        self.seasons: list[tuple[np.ndarray, Mapping[str, Identified]]] = []  # clock, and what was identified then
        self.clocks = _clocks(fleet)
        self._points: list[Point] = []
        self._written, self._steps = time.monotonic(), 0  # steps since the last point
        self._window: deque[tuple[int, Sums]] = deque()  # steps of each chunk; at least the last WINDOW steps
        self._last = np.full(len(fleet.boats), -1 if begin == BEGIN else 0) + self._clock(begin)
        self.folders = dict(zip(fleet.boats, folder_names(fleet.boats), strict=True))
        self._names = dict(zip(ensemble.names, folder_names(ensemble.names), strict=True))
        self.fleet_run, self.results_run = (
            next(free for k in range(9) if (free := name + "_" * k) not in self.folders.values())
            for name in (FLEET, RESULTS)
        )
        if self.silent:
            return
        first = {self.folders[boat]: int(clock) + 1 for boat, clock in zip(fleet.boats, self._last, strict=True)}
        first |= {self.fleet_run: max(first.values()), self.results_run: 0}
        runs = self._runs()
        marks = {run: first[run.partition("/")[0]] for run in runs}  # earlier files may hold points from there on
        where = Path(folder) / folder_name(label(self.differs)) if self.differs else Path(folder)
        self.board = TensorBoardWriter(where, runs, marks, _about)
        for title, text in {**(texts or {}), "data": data_text(fleet, self.clocks[-1])}.items():
            self.board.text(f"run/{title}", text, run=self.results_run)

    def _runs(self) -> list[str]:
        """All runs, in the order of their colours: the seven of each boat, then the others."""
        named, every = list(self._names.values()), []
        for boat, folder in self.folders.items():
            read = [*IDENTIFIED_RUNS, *([TRUE] if boat in self.truth else [])] if self.ensemble.averaged else []
            every += [(folder, name) for name in (*named, *read)]
        every += [(self.fleet_run, name) for name in named] if len(self.folders) > 1 else []
        places = {name: k for k, names in enumerate(SEVEN) for name in names}
        boats = [*self.folders.values(), self.fleet_run]
        every.sort(key=lambda run: (run[1] not in places, boats.index(run[0]), places.get(run[1], 0)))
        return [*map("/".join, every), self.results_run]

    def __enter__(self) -> TensorBoardLogger:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.silent:
            self._write()
            self.board.close()

    def show(self, chunk: Chunk) -> None:
        """Add one point to every curve, unless the last one is near; it is written within PATIENCE or BATCH points."""
        if self.silent:
            return
        self._window.append((len(chunk.surge), self._sums(chunk.published, chunk.surge)))
        while sum(steps for steps, _ in self._window) - self._window[0][0] >= WINDOW:
            self._window.popleft()
        self._steps += len(chunk.surge)
        last = len(self.fleet.runs) - 1
        if 2 * self._steps < self.every and chunk.end != Position(last, len(self.fleet.runs[last].time)):
            return
        self._steps = 0
        self._points.append(Point(self._clock(chunk.end), self._numbers(), chunk.state))
        if len(self._points) == BATCH or time.monotonic() - self._written > PATIENCE:
            self._write()

    def _sums(self, published: Mapping[str, np.ndarray], surge: np.ndarray) -> Sums:
        """Of a stretch by tag the sums of errors, or of what lies in an interval, and the counts."""
        names, output, forecasts = self.ensemble.names, self.ensemble.output, self.ensemble.forecasts
        errors, widths = np.abs(published["predictions"] - surge[..., None]), published["halfwidths"]
        known = np.isfinite(errors)
        sums: Sums = {
            MAE: (names, _sum(errors, known)),
            "coverage of 90 %, next step": (names, _sum(errors <= widths, known & np.isfinite(widths))),
        }
        if forecasts is not None and "forecasts" in published:
            far = (*forecasts.columns[:-1], output)
            values = published["forecasts"].reshape(*surge.shape, -1, len(far))
            errors, widths = np.abs(values - surge[..., None, None]), published["forecast_halfwidths"][..., None]
            due = np.isfinite(values[..., -1:]) & np.isfinite(surge)[..., None, None]
            inside, known = errors[..., -1:] <= widths, due & np.isfinite(widths)
            for k, h in enumerate(forecasts.horizons.tolist()):
                sums[f"MAE, {h:g} s ahead (m/s)"] = far, _sum(errors[:, :, k], due[:, :, k])
                sums[f"coverage of 90 %, {h:g} s ahead"] = [output], _sum(inside[:, :, k], known[:, :, k])
        if self.tracks and "tracks" in published:
            rows = published["tracks"].reshape(*surge.shape, len(self.tracks), DUE)
            for k, h in enumerate(self.tracks):
                track, values = rows[:, :, k], np.isfinite(rows[:, :, k, [ERROR]])
                for title, runs, columns in (
                    (f"position error, {h:g} s ahead (m)", [output, PERSISTENCE], [ERROR, CONSTANT]),
                    (f"position error with held yaw rate, {h:g} s ahead (m)", [output], [HELD_RATE]),
                    (f"heading error, {h:g} s ahead (rad)", [output], [HEADING_ERROR]),
                ):
                    sums[title] = runs, _sum(track[..., columns], values)
                known = values & np.isfinite(track[..., [RADIUS]])
                inside = track[..., [RHO]] <= track[..., [RADIUS]]
                sums[f"coverage of the ellipses of 90 %, {h:g} s ahead"] = [output], _sum(inside, known)
        return sums

    def _numbers(self) -> dict[tuple[str, str], np.ndarray]:
        """The means over the window, and the skills, by run and tag."""
        total: Sums = {}
        for _, sums in self._window:
            for tag, (runs, each) in sums.items():
                total[tag] = runs, each + (total[tag][1] if tag in total else 0)
        points = {}
        for tag, (runs, (values, counts)) in total.items():
            least = LEAST if tag.startswith(("MAE", "coverage of 90")) else FEWEST
            if tag.endswith(("next step", MAE)):
                least = 1
            with np.errstate(invalid="ignore", divide="ignore"):
                mean = np.where(counts >= least, values / counts, np.nan)
                skill = 1 - mean / mean[:, [runs.index(PERSISTENCE)]] if PERSISTENCE in runs else None
            for k, run in enumerate(runs):
                name = run if run in self._names else self.ensemble.output
                points[name, self._tag(tag, run)] = mean[:, k]
                if tag.startswith("MAE") and skill is not None:
                    points[name, self._tag(tag.replace("MAE", "skill").removesuffix(" (m/s)"), run)] = skill[:, k]
        return points

    def _tag(self, title: str, run: str) -> str:
        """The tag of a mean, in the group of what is shown or that of all."""
        ahead = title.partition(", ")[2].partition(" ahead")[0]
        shown = {
            "MAE": title == MAE, "skill": ahead in ("next step", *SHOWN), "position error": ahead == SHOWN[1],
            "coverage of 90 %": ahead == "next step" and run == self.ensemble.output,
        }  # fmt: skip
        return f"{'1 overview' if shown.get(title.partition(',')[0]) else '9 all'}/{title}"

    def _place(self, key: str) -> tuple[str, str]:
        """The run and the tag of a number of `Ensemble.monitor`."""
        name, _, number = key.partition("/")
        if key == "monitors/alarms":
            return self.ensemble.output, "1 overview/thruster alarms so far"
        if name == self.ensemble.output and number.startswith("weight_"):
            return number.removeprefix("weight_"), "3 weights/weight"
        if number == "contraction_rate":
            return name, "4 contraction/rate K (a step)"
        return name if name in self._names else self.ensemble.output, f"9 all/{number}"

    def _write(self) -> None:
        """Write the pending points of all boats."""
        if self._points:
            with torch.no_grad():
                monitored = self.ensemble.monitor(stack([point.state for point in self._points]))
            states = {self._place(key): x.double().numpy() for key, x in monitored.items()}  # (points, boats)
            for k, point in enumerate(self._points):
                self._write_point(point, point.numbers | {place: x[k] for place, x in states.items()})
            self.board.flush()
        self._points.clear()
        self._written = time.monotonic()

    def _write_point(self, point: Point, numbers: Mapping[tuple[str, str], np.ndarray]) -> None:
        later = point.clock > self._last
        rows: dict[str, dict[str, np.ndarray]] = {}
        for (name, tag), values in numbers.items():
            if self.everything or not tag.startswith("9 all/"):
                rows.setdefault(self._names.get(name) or folder_name(name), {})[tag] = values
        if self.ensemble.averaged is not None:
            self._show_identified(point, later)
        for element, folder in enumerate(self.folders.values()):
            for run, row in rows.items() if later[element] else ():
                self._scalars(f"{folder}/{run}", {tag: x[element] for tag, x in row.items()}, point.clock[element])
        for run, row in rows.items() if len(self.folders) > 1 and later.any() else ():
            known = {tag: x[np.isfinite(x)] for tag, x in row.items() if tag.startswith("1 ")}
            means = {tag: x.mean() for tag, x in known.items() if len(x)}
            self._scalars(f"{self.fleet_run}/{run}", means, point.clock.max())
        self._last = np.maximum(self._last, point.clock)

    def _scalars(self, run: str, values: Mapping[str, float], step: Any) -> None:
        """Write those that are numbers."""
        if row := {tag: float(x) for tag, x in values.items() if math.isfinite(x)}:
            self.board.scalars(row, int(step), run)

    def _show_identified(self, point: Point, later: np.ndarray) -> None:
        """Write one point of every quantity, with the ends of its interval, and the truth, if it is time for one."""
        apart = max(self.clocks[-1].max() / MOST_IDENTIFIED, IDENTIFIED)
        if self.seasons and (point.clock - self.seasons[-1][0]).max() < apart:
            return
        identified = identified_boats(self.ensemble, point.state, self.fleet.boats)
        self.seasons.append((point.clock, identified))
        for element, (boat, quantities) in enumerate(identified.items()):
            tags = {
                name: f"{'2 identified' if name in MAIN else '9 all'}/{name} ({(QUANTITIES | TURNING)[name]})"
                for name in quantities if self.everything or name in MAIN
            }  # fmt: skip
            for run, field in IDENTIFIED_RUNS.items() if later[element] else ():
                ends = {name: (getattr(quantities[name], field), quantities[name].value) for name in tags}
                near = {tags[name]: x for name, (x, value) in ends.items() if abs(x - value) <= FAR * abs(value)}
                self._scalars(f"{self.folders[boat]}/{run}", near, point.clock[element])
            if later[element]:
                true = {tags[name]: x for name, x in self.truth.get(boat, {}).items() if name in tags}
                self._scalars(f"{self.folders[boat]}/{TRUE}", true, point.clock[element])

    def finish(
        self,
        settings: Mapping[str, Any],
        results: Mapping[str, Any],
        published: Published,
        networks: Sequence[str] = (),
    ) -> None:
        """Write the run's results, and figures; a short run of a large fleet gets those of its first boats only."""
        if self.silent:
            return
        self._write()
        if networks:
            self.board.text("run/networks", "\n".join(f"- {sentence}" for sentence in networks), run=self.results_run)
        row = results_of(results, self.ensemble.output)
        self.board.scalars({result_tag(title): x for title, x in row.items()}, 0, self.results_run)
        hours = round(float(self.clocks[-1].sum() / 3600), 2)
        compared = {"boats": len(self.fleet.boats), "hours": hours, **self.differs}
        shown = {key: number(value) for key, value in compared.items()}
        self.board.session(shown, self.results_run, results.get("seconds"))
        try:
            replayed = Replayed(
                self.fleet, self.ensemble, self.seasons, self.truth, settings["data"], results, published
            )
            for boat, title, index, draw in figures(replayed, self.everything):
                doing(f"drawing {title} of {boat}")
                if (drawn := attempted(draw, f"{title} of {boat}")) is not None:
                    step = int(self.clocks[-1, self.fleet.boats.index(boat)]) + index  # after all points
                    run = f"{self.folders[boat]}/{self._names[self.ensemble.output]}"
                    self.board.figure(f"7 figures/{title}", drawn, step, run)
        except MissingExtraError as error:
            warnings.warn(f"no figure of the predictions: {error}", stacklevel=3)

    def _clock(self, place: Position) -> np.ndarray:
        """Whole seconds of run time of each boat at a place, `(boats,)`."""
        run = self.fleet.runs[place.run]
        steps = np.minimum(place.step, run.lengths)
        inside = run.time[np.maximum(steps, 1) - 1, np.arange(len(steps))]
        return self.clocks[place.run] + np.where(steps > 0, np.nan_to_num(inside), 0.0).astype(int)


def check_log(log: Any) -> None:
    """Raise a ConfigError unless this is one of LOGS."""
    if log not in LOGS:
        raise ConfigError(f"log: found {log!r}, expected one of {', '.join(LOGS)}")


def _clocks(fleet: Fleet) -> np.ndarray:
    """Whole seconds of run time before each run, and at the end, `(runs + 1, boats)`; runs never share a second."""
    lengths = [
        [int(run.time[n - 1, element]) + 1 if n else 0 for element, n in enumerate(run.lengths)] for run in fleet.runs
    ]
    return np.concatenate([np.zeros((1, len(fleet.boats)), int), np.cumsum(lengths, axis=0)])


def _about(tag: str) -> str:
    """The description of a tag."""
    return next((text for head, text in ABOUT.items() if tag.startswith(head)), "")


def _sum(values: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """The sums over time of those that count, and how many these are, `(2, boats, columns)`."""
    counted = np.broadcast_to(counted, values.shape)
    return np.stack([np.where(counted, values, 0.0).sum(0), counted.sum(0)])
