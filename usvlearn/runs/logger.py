"""Shows a replay in TensorBoard while it runs, at a bounded cost."""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from usvlearn.errors import MissingExtraError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.monitors.state import THRESHOLD
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.rnn.layer import RNN
from usvlearn.evaluation.identification import identified_boats
from usvlearn.evaluation.metrics import PERSISTENCE, mean_mae
from usvlearn.figures import PAPER, prediction_figure
from usvlearn.rollouts import stack
from usvlearn.runs.fault_figure import fault_figure
from usvlearn.runs.published import Published
from usvlearn.runs.replay import Chunk
from usvlearn.signals import Fleet, masks, tree_map
from usvlearn.tensorboard import TensorBoardWriter

WINDOW = 750  # steps over which errors are averaged
STEPS_PER_POINT = 100  # and boat: one point of all curves costs about as much as 100 compiled steps
MOST_POINTS = 500  # of a curve; over a season, two or three between two parameter sets
MOST_IDENTIFIED = 100  # points of a curve of what is identified: one costs a millisecond a boat
CHARTED = ("thrust_full_left", "thrust_full_right", "steady_speed_full", "time_constant")  # of what is identified
BATCH = 32  # points that are written together: monitoring many states costs little more than monitoring one
PATIENCE = 2.0  # s, after which fewer points are written
STEPS_PER_FIGURE = 2500  # of the run, per figure: a figure costs as much as some hundred steps
FIGURE_STEPS = 450  # shown in the figure of predictions


class TensorBoardLogger:
    """Draws a replay's chunks in TensorBoard.

    Args:
        folder: of the TensorBoard files.
        fleet: the runs that are replayed.
        ensemble: the estimators that learn.
    """

    def __init__(self, folder: str | Path, fleet: Fleet, ensemble: Ensemble):
        self.board, self.fleet, self.ensemble = TensorBoardWriter(folder), fleet, ensemble
        self.every = max(STEPS_PER_POINT * len(fleet.boats), -(-fleet.steps // MOST_POINTS))  # steps between points
        self._points: list[tuple[int, np.ndarray, EnsembleState]] = []  # step, MAE (boats, estimators), state
        self._written, self._identified = time.monotonic(), 0  # step of the last point of what is identified
        self._errors: deque[tuple[int, np.ndarray, np.ndarray]] = deque()  # per chunk: steps, Σ |error| and
        # count, (boats, estimators); covers at least the last WINDOW steps
        charts = {
            boat: {
                f"{number}, {unit}": [f"online/{number}/{boat}/{name}" for name in ensemble.names]
                for number, unit in {"mae": "m/s", "skill": "against persistence"}.items()
            }
            for boat in fleet.boats
        }
        for boat in fleet.boats:
            charts[boat][f"weights of {ensemble.output}"] = [f"state/{boat}/{ensemble.output}/weight_.*"]
            if ensemble.watched:
                charts[boat]["thrusters: evidence of a loss, alarm"] = [f"state/{boat}/monitors/(evidence_.*|alarm)"]
            if ensemble.reader is not None:
                for name in CHARTED:
                    charts[boat][f"{name}, {QUANTITIES[name]}"] = [f"identified/{boat}/{name}/.*"]
        for name, member in ensemble.members.items():
            if isinstance(member, RNN):
                for boat in fleet.boats:
                    charts[boat][f"{name}: margins, contracting where > 0"] = [f"state/{boat}/{name}/margin_.*"]
                    charts[boat][f"{name}: contraction rate"] = [f"state/{boat}/{name}/contraction_rate"]
        self.board.charts(charts)

    def __enter__(self) -> TensorBoardLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self._write()
        self.board.close()

    def show(self, chunk: Chunk) -> None:
        """Add one point to every curve; it is written within PATIENCE or BATCH points."""
        part = slice(chunk.begin.step, chunk.end.step)
        samples = tree_map(lambda x: x[part], self.fleet.runs[chunk.end.run].samples)
        surge = np.where(masks(samples, self.ensemble.surge_limit).learns, samples.surge, np.nan)
        errors = np.abs(chunk.predictions - surge[..., None])
        seen = np.isfinite(errors)
        self._errors.append((len(errors), errors.sum(0, where=seen), seen.sum(0)))
        while sum(steps for steps, *_ in self._errors) - self._errors[0][0] >= WINDOW:
            self._errors.popleft()
        _, sums, counts = zip(*self._errors, strict=True)
        count = sum(counts)
        mae = sum(sums) / np.where(count, count, np.nan)
        self._points.append((self.fleet.steps_before(*chunk.end), mae, chunk.state))
        if len(self._points) == BATCH or time.monotonic() - self._written > PATIENCE:
            self._write()

    def _write(self) -> None:
        """Write the pending points of all boats whose speed was measured."""
        if self._points:
            names = self.ensemble.names
            with torch.no_grad():
                found = self.ensemble.monitor(stack([state for _, _, state in self._points]))
                state = torch.stack([x.double() for x in found.values()], -1).tolist()  # points, boats, numbers
            for k, (step, mae, at) in enumerate(self._points):
                if step - self._identified >= self.fleet.steps / MOST_IDENTIFIED:
                    self._show_identified(step, at)
                for lane, boat in enumerate(self.fleet.boats):
                    if np.isfinite(mae[lane]).any():
                        row = dict(zip(names, mae[lane].tolist(), strict=True))
                        self.board.scalars(f"online/mae/{boat}", row, step)
                        if base := row.get(PERSISTENCE):
                            skill = {name: 1 - x / base for name, x in row.items()}
                            self.board.scalars(f"online/skill/{boat}", skill, step)
                        self.board.scalars(f"state/{boat}", dict(zip(found, state[k][lane], strict=True)), step)
        self._points.clear()
        self._written = time.monotonic()

    def _show_identified(self, step: int, state: EnsembleState) -> None:
        """Write one point of every quantity, with the ends of its interval."""
        self._identified = step
        for boat, found in identified_boats(self.ensemble, state, self.fleet.boats).items():
            for name, (value, low, high, _) in found.items():
                if value == value:
                    self.board.scalars(f"identified/{boat}/{name}", {"value": value, "low": low, "high": high}, step)

    def finish(
        self,
        settings: Mapping,
        boats: Mapping[str, Mapping[str, Mapping]],
        published: Published,
        alarms: Mapping[str, Sequence[Mapping]],
    ) -> None:
        """Write the run's record, the counts of rejected messages, and a figure of the end of each boat's last run.

        A boat that raised an alarm gets a figure of that run, too. A short run of a large fleet gets figures of its
        first boats only. Without matplotlib no figure is drawn, and a warning is raised.

        Args:
            settings: the run's configuration.
            boats: scores of the estimators; see `usvlearn.evaluation.metrics.fleet_scores`.
            published: of the run.
            alarms: per boat; see `usvlearn.evaluation.metrics.alarms`.
        """
        self._write()
        step = self.fleet.steps
        tuned = {**settings["estimators"], **settings["combiners"], "align": settings["align"]}
        self.board.hparams(tuned, {f"total/mae/{name}": mae for name, mae in mean_mae(boats).items()})
        for boat, channels in self.fleet.rejected.items():
            for channel, causes in channels.items():
                self.board.scalars(f"rejected/{boat}/{channel}", causes, step)
        try:
            for lane in range(min(len(self.fleet.boats), max(1, step // STEPS_PER_FIGURE))):
                self._draw(lane, published, step)
            for lane, boat in enumerate(self.fleet.boats):
                if alarms[boat]:
                    self._draw_alarm(lane, published, alarms[boat], settings["data"], step)
        except MissingExtraError as error:
            warnings.warn(f"no figure of the predictions: {error}", stacklevel=2)

    def _draw_alarm(self, lane: int, published: Published, alarms: Sequence[Mapping], data: Mapping, step: int) -> None:
        """Draw the run of the first alarm; if the log is simulated, also the fault."""
        boat = self.fleet.boats[lane]
        index = next(k for k, run in enumerate(self.fleet.runs) if run.names[lane] == alarms[0]["run"])
        run, found = self.fleet.runs[index], published.lane(index, lane)
        part = slice(0, run.lengths[lane])
        shown = [name for name in (self.ensemble.output, "aid") if name in self.ensemble.names]
        predictions, health = found["predictions"][part], found["thrusters"][part]
        fault = data.get("fault")
        figure = fault_figure(
            run.time[part, lane],
            health[:, :2],
            np.where(run.samples.measured[part, lane], run.samples.surge[part, lane], np.nan),
            {name: predictions[:, self.ensemble.names.index(name)] for name in shown},
            health[:, 2:4],
            THRESHOLD,
            None if fault is None else 60 * (fault["minute"] - index * data["mission_minutes"]),
            [each["time"] for each in alarms if each["run"] == run.names[lane]],
            f"{boat}, {run.names[lane]}",
        )
        self.board.figure(f"thrusters/{boat}", figure, step)

    def _draw(self, lane: int, published: Published, step: int) -> None:
        """Draw the ensemble's prediction and interval, and three members: the paper's, or else the first ones."""
        index = max(k for k, run in enumerate(self.fleet.runs) if run.lengths[lane])
        run, boat = self.fleet.runs[index], self.fleet.boats[lane]
        part = slice(max(0, run.lengths[lane] - FIGURE_STEPS), run.lengths[lane])
        surge = np.where(run.samples.measured[part, lane], run.samples.surge[part, lane], np.nan)
        title = f"{boat}, {run.names[lane]}"
        names = self.ensemble.names
        shown = [name for name in (*PAPER, *names) if name in names and name != self.ensemble.output]
        shown = [*list(dict.fromkeys(shown))[:3], self.ensemble.output]
        places = [names.index(name) for name in shown]
        found, steps = published.lane(index, lane, part.start), part.stop - part.start
        predictions, halfwidths = found["predictions"][:steps], found["halfwidths"][:steps]
        time, own = run.time[part, lane], halfwidths[:, places[-1]]
        figure = prediction_figure(time, surge, predictions[:, places], shown, title, own)
        self.board.figure(f"prediction/{boat}", figure, step)
