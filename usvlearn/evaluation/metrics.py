"""Errors of predictions: MAE, median, RMSE, fit, skill against persistence, and the coverage of the intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, masks, tree_map

PERSISTENCE = "persistence"  # the estimator that skill refers to
MISSING = 0.01  # share of the steps, the most without a prediction of an estimator that has errors
AT_ONCE = 2**25  # numbers of predictions and half-widths that are held at a time
Stretch = tuple[int, int, Mapping[str, np.ndarray]]  # index of a run, first step, what was published, (time, boats, …)


def scores(
    predictions: np.ndarray, surge: np.ndarray, names: Sequence[str], halfwidths: np.ndarray | None = None
) -> dict[str, dict[str, float | int | None]]:
    """Errors of each estimator over the steps that count, the same steps for all.

    Args:
        predictions: m/s, `(time, estimators)`.
        surge: m/s, `(time,)`; NaN where the step does not count (`usvlearn.core.samples.masks`).
        names: of the estimators.
        halfwidths: of the predictions' intervals, m/s, `(time, estimators)`.

    Returns:
        Per estimator `mae`, `median`, `rmse` (m/s), `fit` (percent, see `fit`), `skill` = 1 − MAE/MAE(persistence)
        (None where persistence was not run or is perfect), `steps`, and `diverged`, the number of predictions that are
        not finite. An estimator with more than MISSING of such steps, or without a step, has no errors (None). So it
        cannot win by its remaining steps. With half-widths also `coverage`, the share of the measurements inside the
        intervals, and `halfwidth`, their mean, m/s, over the intervals that are finite.

    >>> table = scores(np.array([[1.0, 2.0], [2.0, 2.0]]), np.array([1.5, 2.0]), ["aid", "persistence"])
    >>> table["aid"]["mae"], table["aid"]["skill"]
    (0.25, 0.0)
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
    """100 (1 − NRMSE), percent, as MATLAB's `compare` has it: 100 is perfect, 0 is as good as the mean measured speed.

        100 (1 − √(Σ (v̂ − v)² / Σ (v − mean v)²))                                                     (1)

    Args:
        errors: Σ (v̂ − v)², m²/s².
        spread: Σ (v − mean v)², m²/s².

    Returns:
        None if the speed never changed.

    >>> fit(1.0, 16.0), fit(1.0, 0.0)
    (75.0, None)
    """
    return 100 * (1 - float(np.sqrt(errors / spread))) if spread > 0 else None


def fleet_scores(
    fleet: Fleet, published: Iterable[Stretch], names: Sequence[str], surge_limit: float = PLAUSIBLE
) -> dict[str, dict]:
    """`scores` per boat over what was published of its runs.

    Args:
        fleet: what was replayed.
        published: stretches in order, which are gone through again and again: medians need all errors of a boat, so
            that so many boats are judged at a time as have AT_ONCE numbers.
        names: of the estimators.
        surge_limit: m/s, of the ensemble that made the predictions.
    """
    found, at_once = {}, max(1, AT_ONCE // max(1, 2 * fleet.steps * len(names)))
    nothing = np.empty((0, len(names)))
    for first in range(0, len(fleet.boats), at_once):
        elements = range(len(fleet.boats))[first : first + at_once]
        parts: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]] = {element: [] for element in elements}
        for run, step, arrays in published:
            predictions, widths = arrays["predictions"], arrays.get("halfwidths")
            part = slice(step, step + len(predictions))
            samples = tree_map(lambda x, part=part: x[part], fleet.runs[run].samples)
            surge = np.where(masks(samples, surge_limit).learns, samples.surge, np.nan)
            for element in elements:
                width = None if widths is None else widths[:, element].copy()
                parts[element].append((predictions[:, element].copy(), surge[:, element], width))
        for element in elements:
            predictions, surge, widths = zip(*parts.pop(element) or [(nothing, nothing[:, 0], nothing)], strict=True)
            widths = None if widths[0] is None else np.concatenate(widths)
            found[fleet.boats[element]] = scores(np.concatenate(predictions), np.concatenate(surge), names, widths)
    return found


def by_error(errors: Mapping[str, float | None]) -> list[str]:
    """Names by their error, the least first; those without one (None, NaN) come last, in their order.

    >>> by_error({"a": None, "b": 0.3, "c": float("nan"), "d": 0.1})
    ['d', 'b', 'a', 'c']
    """

    def key(name: str) -> float:
        error = errors[name]
        return np.inf if error is None or error != error else error

    return sorted(errors, key=key)


def mean(values: Iterable[float | None]) -> float | None:
    """The mean over boats; None where there is none, or where one is unknown (None, NaN).

    >>> mean([0.25, 0.75]), mean([0.1, None]), mean([])
    (0.5, None, None)
    """
    found = list(values)
    known = [x for x in found if x is not None and x == x]
    return sum(known) / len(known) if known and len(known) == len(found) else None


def mean_mae(boats: Mapping[str, Mapping[str, Mapping]]) -> dict[str, float]:
    """MAE of each estimator, m/s, mean over boats; NaN where a boat has none.

    >>> mean_mae({"a": {"aid": {"mae": 0.25}}, "b": {"aid": {"mae": 0.75}}})
    {'aid': 0.5}
    """
    names = dict.fromkeys(name for rows in boats.values() for name in rows)
    means = {name: mean(rows[name]["mae"] for rows in boats.values() if name in rows) for name in names}
    return {name: float("nan") if x is None else x for name, x in means.items()}
