"""What is left in the errors of predictions: their autocorrelation, within segments.

With the errors e of the steps that count and their mean m,

    r(k) = (Σ (e_i − m) (e_(i+k) − m) / n_k) / (Σ (e_i − m)² / n)                                      (1)

over the n_k pairs of steps i and i + k of one segment of one run that both count. If errors do not depend on each
other, r(k) has the standard deviation 1/√n_k, so that 99 % of it are within ± 2.58/√n_k (Ljung 1999, section 16.6).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import masks
from usvlearn.evaluation.season import SeasonRun

NORMAL_99 = 2.58  # half-width of 99 % of a standard normal distribution


class Autocorrelation(NamedTuple):
    """Of errors at lags of 1, 2, … steps."""

    values: np.ndarray  # (lags,); NaN where there is no pair
    pairs: np.ndarray  # (lags,)

    @property
    def bounds(self) -> np.ndarray:
        """The half-width of the 99 % bounds for errors that do not depend on each other, `(lags,)`."""
        return NORMAL_99 / np.sqrt(np.maximum(self.pairs, 1))


def autocorrelation(errors: Sequence[np.ndarray], segments: Sequence[np.ndarray], lags: int) -> Autocorrelation:
    """Equation (1).

    Args:
        errors: of each run, `(time,)`; NaN where a step does not count.
        segments: of each run, `(time,)`: numbers that are the same for the steps of a segment.
        lags: the largest lag, in steps.

    >>> found = autocorrelation([np.array([1.0, -1.0, np.nan, 1.0, -1.0])], [np.array([0, 0, 0, 1, 1])], 2)
    >>> found.values, found.pairs
    (array([-1., nan]), array([2, 0]))
    """
    every = np.concatenate([e[np.isfinite(e)] for e in errors]) if errors else np.empty(0)
    mean, variance = (float(every.mean()), float(every.var())) if len(every) else (0.0, 0.0)
    sums, pairs = np.zeros(lags), np.zeros(lags, int)
    for e, segment in zip(errors, segments, strict=True):
        for k in range(1, min(lags, len(e) - 1) + 1):
            product = (e[:-k] - mean) * (e[k:] - mean)
            both = np.isfinite(product) & (segment[:-k] == segment[k:])
            sums[k - 1] += product[both].sum()
            pairs[k - 1] += both.sum()
    known = (pairs > 0) & (variance > 0)
    return Autocorrelation(np.where(known, sums / np.maximum(pairs, 1) / (variance or 1.0), np.nan), pairs)


def of_runs(runs: Sequence[SeasonRun], column: int, lags: int) -> Autocorrelation:
    """That of the published errors one step ahead of one estimator.

    Args:
        runs: that were replayed.
        column: of the estimator.
        lags: the largest lag, in steps.
    """
    errors = [np.where(run.steps, run.published["predictions"][:, column] - run.samples.surge, np.nan) for run in runs]
    return autocorrelation(errors, [np.cumsum(masks(run.samples, run.surge_limit).starts) for run in runs], lags)
