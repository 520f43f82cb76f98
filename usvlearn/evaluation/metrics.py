"""What is measured of predictions: MAE, median, RMSE, and skill against persistence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.signals import Fleet

PERSISTENCE = "persistence"  # the estimator that skill refers to


def scores(
    predictions: np.ndarray, surge: np.ndarray, names: Sequence[str]
) -> dict[str, dict[str, float | int | None]]:
    """Errors of each estimator over the steps that were made and measured, the same steps for all.

    Args:
        predictions: m/s, `(time, estimators)`; NaN where no step was made.
        surge: m/s, `(time,)`; NaN where it was not measured.
        names: of the estimators.

    Returns:
        Per estimator `mae`, `median`, `rmse` (m/s), `skill` = 1 − MAE/MAE(persistence) (None where persistence was
        not run or is perfect), `steps`, and `diverged`, the number of predictions that are not finite. An estimator
        that diverged even once, or had no step, has no errors (None): it must not win by the steps it survived.

    >>> table = scores(np.array([[1.0, 2.0], [2.0, 2.0]]), np.array([1.5, 2.0]), ["aid", "persistence"])
    >>> table["aid"]["mae"], table["aid"]["skill"]
    (0.25, 0.0)
    """
    counted = np.isfinite(surge) & ~np.isnan(predictions).all(-1)
    error = np.abs(predictions[counted] - surge[counted, None])
    finite = np.isfinite(error)
    table = {}
    for k, name in enumerate(names):
        e = error[finite[:, k], k]
        row: dict[str, float | int | None] = dict.fromkeys(("mae", "median", "rmse", "skill"))
        if len(e) and finite[:, k].all():
            row |= {"mae": float(e.mean()), "median": float(np.median(e)), "rmse": float(np.sqrt((e * e).mean()))}
        table[name] = row | {"steps": len(e), "diverged": int((~finite[:, k]).sum())}
    if base := table.get(PERSISTENCE, {}).get("mae"):
        for row in table.values():
            row["skill"] = None if row["mae"] is None else 1 - row["mae"] / base
    return table


def fleet_scores(fleet: Fleet, predictions: Sequence[np.ndarray], names: Sequence[str]) -> dict[str, dict]:
    """`scores` per boat over all its runs; `predictions` is `(time, boats, estimators)` per run."""
    together = np.concatenate(predictions)
    surge = np.concatenate([np.where(run.samples.measured, run.samples.surge, np.nan) for run in fleet.runs])
    return {boat: scores(together[:, lane], surge[:, lane], names) for lane, boat in enumerate(fleet.boats)}


def mean_mae(boats: Mapping[str, Mapping[str, Mapping]]) -> dict[str, float]:
    """MAE of each estimator, m/s, mean over boats; NaN where a boat has none.

    >>> mean_mae({"a": {"aid": {"mae": 0.1}}, "b": {"aid": {"mae": 0.3}}})
    {'aid': 0.2}
    """
    names = dict.fromkeys(name for rows in boats.values() for name in rows)
    means = {}
    for name in names:
        maes = [rows[name]["mae"] for rows in boats.values() if name in rows]
        means[name] = float("nan") if None in maes else sum(maes) / len(maes)
    return means
