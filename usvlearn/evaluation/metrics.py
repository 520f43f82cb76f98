"""Errors of predictions: MAE, median, RMSE, fit, skill against persistence, coverage of the intervals, autocorrelation.

With the errors e of the steps that count and their mean m, the autocorrelation within segments is

    r(k) = (Σ (e_i − m) (e_(i+k) − m) / n_k) / (Σ (e_i − m)² / n)                                      (2)

over the n_k pairs of steps i and i + k of one segment of one run that both count. (1) and the bounds of independent
errors: `docs/theory/ensemble.md#scores`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, tree_map
from usvlearn.evaluation.season import SeasonRun, measured

PERSISTENCE = "persistence"  # the estimator that skill refers to
MISSING = 0.01  # share of the steps, the most without a prediction of an estimator that has errors
AT_ONCE = 2**25  # numbers of predictions and half-widths that are held at a time
Stretch = tuple[int, int, Mapping[str, np.ndarray]]  # index of a run, first step, what was published, (time, boats, …)


def scores(
    predictions: np.ndarray, surge: np.ndarray, names: Sequence[str], halfwidths: np.ndarray | None = None
) -> dict[str, dict[str, float | int | None]]:
    """Errors of each estimator over the steps that count, the same steps for all; `(time, estimators)`, m/s.

    `mae`, `median`, `rmse` (m/s), `fit` (percent), `skill` = 1 − MAE/MAE(persistence) (None where persistence was not
    run or is perfect), `steps`, and `diverged`, the number of predictions that are not finite. An estimator with more
    than MISSING of such steps, or without a step, has no errors (None), so it cannot win by its remaining steps. With
    half-widths also `coverage`, the share of the measurements inside, and `halfwidth`, m/s, the mean of the finite
    ones.
    """
    counted = ~np.isnan(surge)
    error = np.abs(predictions[counted] - surge[counted, None])
    finite = np.isfinite(error)
    spread = float(((surge[counted] - surge[counted].mean()) ** 2).sum()) if counted.any() else 0.0
    table = {}
    for k, name in enumerate(names):
        e = error[finite[:, k], k]
        row: dict[str, float | int | None] = dict.fromkeys(("mae", "median", "rmse", "fit", "skill"))
        if len(e) and len(finite) - len(e) <= MISSING * len(finite):
            row |= {"mae": float(e.mean()), "median": float(np.median(e)), "rmse": float(np.sqrt((e * e).mean()))}
            row["fit"] = fit(float((e * e).sum()), spread)
        if halfwidths is not None:
            width = halfwidths[counted][finite[:, k], k]
            known = np.isfinite(width)  # an infinite interval covers all, and tells nothing
            row |= {"coverage": None, "halfwidth": None}
            if known.any():
                row |= {"coverage": float((e <= width)[known].mean()), "halfwidth": float(width[known].mean())}
        table[name] = row | {"steps": len(e), "diverged": int((~finite[:, k]).sum())}
    if base := table.get(PERSISTENCE, {}).get("mae"):
        for row in table.values():
            row["skill"] = None if row["mae"] is None else 1 - row["mae"] / base
    return table


def fit(errors: float, spread: float) -> float | None:
    """100 (1 − √(Σ (v̂ − v)² / Σ (v − mean v)²)), percent, as of MATLAB's `compare`; None if no speed changed."""
    return 100 * (1 - float(np.sqrt(errors / spread))) if spread > 0 else None


def fleet_scores(
    fleet: Fleet, published: Iterable[Stretch], names: Sequence[str], surge_limit: float = PLAUSIBLE
) -> dict[str, dict]:
    """`scores` per boat. A median needs all errors of a boat: as many boats at a time as have AT_ONCE numbers."""
    by_boat, at_once = {}, max(1, AT_ONCE // max(1, 2 * fleet.steps * len(names)))
    nothing = np.empty((0, len(names)))
    for first in range(0, len(fleet.boats), at_once):
        elements = range(len(fleet.boats))[first : first + at_once]
        parts: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]] = {element: [] for element in elements}
        for run, step, arrays in published:
            predictions, widths = arrays["predictions"], arrays.get("halfwidths")
            part = slice(step, step + len(predictions))
            samples = tree_map(lambda x, part=part: x[part], fleet.runs[run].samples)
            surge = measured(samples, surge_limit)
            for element in elements:
                width = None if widths is None else widths[:, element].copy()
                parts[element].append((predictions[:, element].copy(), surge[:, element], width))
        for element in elements:
            predictions, surge, widths = zip(*parts.pop(element) or [(nothing, nothing[:, 0], nothing)], strict=True)
            widths = None if widths[0] is None else np.concatenate(widths)
            by_boat[fleet.boats[element]] = scores(np.concatenate(predictions), np.concatenate(surge), names, widths)
    return by_boat


def by_error(errors: Mapping[str, float | None]) -> list[str]:
    """Names by their error, the least first; those without one (None, NaN) come last, in their order."""

    def key(name: str) -> float:
        error = errors[name]
        return np.inf if error is None or error != error else error

    return sorted(errors, key=key)


def mean(values: Iterable[float | None]) -> float | None:
    """The mean over boats; None where there is none, or where one is unknown (None, NaN)."""
    listed = list(values)
    known = [x for x in listed if x is not None and x == x]
    return sum(known) / len(known) if known and len(known) == len(listed) else None


def mean_mae(boats: Mapping[str, Mapping[str, Mapping]]) -> dict[str, float]:
    """MAE of each estimator, m/s, mean over boats; NaN where a boat has none."""
    names = dict.fromkeys(name for rows in boats.values() for name in rows)
    means = {name: mean(rows[name]["mae"] for rows in boats.values() if name in rows) for name in names}
    return {name: float("nan") if x is None else x for name, x in means.items()}


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
    """Equation (2) within segments of equal numbers, `(time,)`; errors are NaN where a step does not count."""
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


def autocorrelation_of_runs(runs: Sequence[SeasonRun], column: int, lags: int) -> Autocorrelation:
    """That of the published errors one step ahead of one estimator."""
    errors = [run.published["predictions"][:, column] - run.measured for run in runs]
    return autocorrelation(errors, [np.cumsum(run.masks.starts) for run in runs], lags)
