"""The data of a season for each boat: its runs, and the parameter sets that were saved during them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.signals import PLAUSIBLE, Sample, masks


class SeasonRun(NamedTuple):
    """One run of one boat."""

    name: str
    key: str  # a sha256 of the samples
    samples: Sample  # leaves (time,), NumPy
    published: dict[str, np.ndarray]  # (time, ...) online predictions (`usvlearn.runs.published`), or empty
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
    state: Any  # the parameter sets in the order in which they were saved, leaves (sets, ...)
    paths: tuple[Path, ...]  # of the sets
    own: np.ndarray  # (sets,) index of the run in which each was saved, -1 if it is none of `runs`
    hours: np.ndarray  # (sets,) h on the water until the set was saved

    @property
    def later(self) -> np.ndarray:
        """Which runs a set has not learned from, bool `(sets, runs)`: those after its own, or all if it has none."""
        return self.own[:, None] < np.arange(len(self.runs))

    @property
    def others(self) -> np.ndarray:
        """Which runs a set was not saved in, bool `(sets, runs)`."""
        return self.own[:, None] != np.arange(len(self.runs))
