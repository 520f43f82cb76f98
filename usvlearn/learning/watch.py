"""What is shown of a replay while it runs, at a bounded cost."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.estimators.ensemble import Ensemble
from usvlearn.evaluation.figures import prediction_figure
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.learning.replay import Chunk
from usvlearn.signals import Fleet
from usvlearn.tensorboard import Board

WINDOW = 750  # steps over which errors are averaged
STEPS_PER_POINT = 50  # and boat: a point of all curves costs about what one step costs
MOST_POINTS = 1000  # of a curve
FIGURE_STEPS = 450  # shown in the figure of predictions


def interval(fleet: Fleet) -> int:
    """Steps between two points of the curves, such that drawing them costs a few per cent of a replay."""
    return max(STEPS_PER_POINT * len(fleet.boats), -(-fleet.steps // MOST_POINTS))


class Watch:
    """Draws a replay's chunks on a board."""

    def __init__(self, board: Board, fleet: Fleet, ensemble: Ensemble):
        self.board, self.fleet, self.ensemble = board, fleet, ensemble
        self._errors: deque[np.ndarray] = deque()  # (time, boats, estimators), the last WINDOW steps or a little more

    def show(self, chunk: Chunk) -> None:
        """One point of every curve."""
        samples = self.fleet.runs[chunk.end.run].samples
        part = slice(chunk.begin.step, chunk.end.step)
        surge = np.where(samples.measured[part], samples.surge[part], np.nan)
        self._errors.append(np.abs(chunk.predictions - surge[..., None]))
        while sum(map(len, self._errors)) - len(self._errors[0]) >= WINDOW:
            self._errors.popleft()
        step = self.fleet.steps_before(*chunk.end)
        errors = np.concatenate(self._errors)
        seen = np.isfinite(errors)
        mae = np.where(seen, errors, 0.0).sum(0) / np.maximum(seen.sum(0), 1)  # (boats, estimators)
        names = self.ensemble.names
        numbers = {key: value.tolist() for key, value in self.ensemble.monitor(chunk.state).items()}
        for lane, boat in enumerate(self.fleet.boats):
            if not seen[:, lane].any():
                continue
            row = dict(zip(names, mae[lane].tolist(), strict=True))
            self.board.scalars(f"online/mae/{boat}", row, step)
            if base := row.get(PERSISTENCE):
                self.board.scalars(f"online/skill/{boat}", {name: 1 - x / base for name, x in row.items()}, step)
            self.board.scalars(f"state/{boat}", {key: value[lane] for key, value in numbers.items()}, step)

    def finish(self, settings: Mapping, maes: Mapping[str, float], predictions: Sequence[np.ndarray]) -> None:
        """The record of the run, the counts of what was rejected, a figure of the end of each boat's last run.

        Args:
            settings: the run's configuration.
            maes: of the estimators, m/s.
            predictions: m/s, `(time, boats, estimators)` per run.

        Raises:
            MissingExtraError: there is no matplotlib for the figure; all else is written.
        """
        step = self.fleet.steps
        self.board.hparams(settings, {f"mae/{name}": mae for name, mae in maes.items()})
        for boat, channels in self.fleet.rejected.items():
            for channel, causes in channels.items():
                self.board.scalars(f"rejected/{boat}/{channel}", causes, step)
        for lane, boat in enumerate(self.fleet.boats):
            index = max(k for k, run in enumerate(self.fleet.runs) if run.lengths[lane])
            run = self.fleet.runs[index]
            part = slice(max(0, run.lengths[lane] - FIGURE_STEPS), run.lengths[lane])
            surge = np.where(run.samples.measured[part, lane], run.samples.surge[part, lane], np.nan)
            figure = prediction_figure(
                run.time[part],
                surge,
                predictions[index][part, lane],
                self.ensemble.names,
                f"{boat}, {run.names[lane]}",
            )
            self.board.figure(f"prediction/{boat}", figure, step)
