"""The data of a season for each boat: its runs, and the checkpoints that were saved during them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, Run, Sample, masks, tree_map


class SeasonRun(NamedTuple):
    """One run of one boat."""

    name: str
    key: str  # a sha256 of the samples
    samples: Sample  # leaves (time,), NumPy
    published: dict[str, np.ndarray]  # (time, ...) online predictions (`usvlearn.runs.prediction_files`), or empty
    time: np.ndarray  # (time,) s
    position: np.ndarray | None = None  # (time, 2) m north and east, if the log has it
    surge_limit: float = PLAUSIBLE  # m/s, of the ensemble that is judged

    @property
    def steps(self) -> np.ndarray:
        """Which steps count, `(time,)` bool."""
        return masks(self.samples, self.surge_limit).learns

    @property
    def spacing(self) -> float:
        """The median length of a step, s; 0 of a run without steps."""
        made = self.samples.inputs.dt[self.samples.inputs.dt > 0]
        return float(np.median(made)) if len(made) else 0.0


class Season(NamedTuple):
    """One boat over all its runs."""

    boat: str
    runs: tuple[SeasonRun, ...]
    state: Any  # the checkpoints in the order in which they were saved, leaves (sets, ...)
    paths: tuple[Path, ...]  # of the checkpoints
    own: np.ndarray  # (sets,) index of the run in which each was saved, -1 if it is none of `runs`
    hours: np.ndarray  # (sets,) h on the water until the checkpoint was saved

    @property
    def replayed(self) -> tuple[Fleet, list[tuple[int, int, dict[str, np.ndarray]]]]:
        """The runs with online predictions as a fleet of one boat, and what was published of each."""
        runs = [run for run in self.runs if run.published]
        wide = [tree_map(lambda x: x[:, None], run.samples) for run in runs]
        made = tuple(
            Run(run.time[:, None], samples, (run.name,), (len(run.time),))
            for run, samples in zip(runs, wide, strict=True)
        )
        published = [(k, 0, {key: x[:, None] for key, x in run.published.items()}) for k, run in enumerate(runs)]
        return Fleet((self.boat,), made, {}), published

    @property
    def later(self) -> np.ndarray:
        """Which runs a checkpoint has not learned from, bool `(sets, runs)`: those after its own, or all if it has
        none.
        """
        return self.own[:, None] < np.arange(len(self.runs))

    def set_before(self, run: int) -> tuple[int, bool]:
        """The newest checkpoint that has not learned from a run, and False; else the first saved since, and True.

        Args:
            run: index of the run.
        """
        before = np.flatnonzero(self.own < run)
        return (int(before[-1]), False) if len(before) else (int(np.flatnonzero(self.own >= run)[0]), True)

    @property
    def others(self) -> np.ndarray:
        """Which runs a checkpoint was not saved in, bool `(sets, runs)`."""
        return self.own[:, None] != np.arange(len(self.runs))
