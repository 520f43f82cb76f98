"""Errors of predictions: MAE, median, RMSE, fit, skill against persistence, coverage of intervals, worst minutes.

The fit is equation (1) of `docs/theory/ensemble.md#scores`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, tree_map
from usvlearn.evaluation.season import measured

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
MINUTE, HALF = 60.0, 0.5  # s, what is enlarged; of the known steps of the fullest minute: fewer are not compared


def worst_minute(time: np.ndarray, error: np.ndarray) -> tuple[int, int] | None:
    """The first step and the end of the minute with the largest mean |error|; all of a mission that is shorter.

    Minutes with less than `HALF` of the known steps of the fullest one are left out; None without a known step.
    """
    known = np.isfinite(error)
    if not known.any():
        return None
    sums, counts = (np.append(0.0, np.cumsum(x)) for x in (np.abs(np.nan_to_num(error)), known))
    begins, ends = np.arange(len(time)), np.searchsorted(time, time + MINUTE - 1e-6)
    whole = begins == 0 if time[-1] - time[0] < MINUTE else time + MINUTE <= time[-1] + 1e-6
    number = np.where(whole, counts[ends] - counts[begins], 0)
    enough = number >= max(HALF * number.max(), 1)
    if not enough.any():
        return None
    mean = np.where(enough, (sums[ends] - sums[begins]) / np.maximum(number, 1), -1.0)
    k = int(mean.argmax())
    return k, int(ends[k])
