"""Batch output error: the physical model of `benchmarks/output_error.py`, whose open-loop simulations fit all runs at
once.

A forecast starts from the speed that was measured at its origin. On later runs the current is the mean of those of the
runs that were learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np
import output_error

from peers.batch import HORIZONS, Fitted, choose, targets
from usvlearn.core.samples import Sample


class Physics:
    """A fit, and its simulations."""

    def __init__(self, fit: output_error.Fit):
        self.fit = fit

    def free_run(self, run: Sample) -> np.ndarray:
        return output_error.free_runs(self.fit, [run])[0]

    def forecast(self, run: Sample, horizons: Sequence[int] = HORIZONS) -> np.ndarray:
        aim, rows = targets(run, horizons), output_error.rows_of([run], restart=False)
        ahead = aim.origins[:, None] + np.arange(max(horizons) + 1)
        parts = rows[ahead.clip(max=len(rows) - 1)]  # one for each origin
        parts[..., output_error.STARTS] = 0.0
        parts[:, 0, output_error.STARTS] = 1.0
        parts[..., output_error.RUN] = np.arange(len(parts))[:, None]
        speeds = np.empty(parts.shape[:2])
        theta = np.array([*self.fit.parameters.values(), self.fit.lag])
        current = np.tile(self.fit.current.mean(0), (len(parts), 1))
        output_error.simulate(parts.reshape(-1, parts.shape[-1]), theta, current, speeds.reshape(-1), np.empty((0, 0)))
        return np.where(aim.reached, speeds[:, list(horizons)], np.nan)


def one(runs: Sequence[Sample], top: float, cubic: bool, current: bool, lag: bool) -> Physics:
    """The model of one setting."""
    return Physics(output_error.fit(runs, top, cubic, current, lag))


def fit(runs: Sequence[Sample], top: float) -> Fitted:
    """The best of the settings."""
    names = ("cubic", "current", "lag")
    settings = {
        ", ".join(["nine parameters", *(name for name in names if given[name])]): partial(one, top=top, **given)
        for given in (dict(zip(names, each, strict=True)) for each in product((False, True), repeat=3))
    }
    return choose(settings, runs)
