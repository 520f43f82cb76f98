"""Errors of forecasts by horizon: MAE, skill against persistence, and the coverage of the ensemble's intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from usvlearn.estimators.ensemble.forecasts.state import PERSISTENCE
from usvlearn.evaluation.metrics import Stretch
from usvlearn.signals import PLAUSIBLE, Fleet, masks, tree_map

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble

LEAST = 8  # forecasts, below which no score is stated
Scores = dict[str, dict[str, dict[str, dict[str, float | int | None]]]]  # boat -> estimator -> horizon -> number


def horizon_scores(
    fleet: Fleet,
    published: Iterable[Stretch],
    horizons: Sequence[float],
    names: Sequence[str],
    surge_limit: float = PLAUSIBLE,
) -> Scores:
    """Scores of forecasts that became due at a step with a measured speed, the same steps for all estimators.

    Args:
        fleet: what was replayed.
        published: stretches with `forecasts` and `forecast_halfwidths`, as `usvlearn.runs.published` says.
        horizons: s.
        names: of the columns of forecasts; the last is the ensemble's.
        surge_limit: m/s, of the ensemble.

    Returns:
        By boat, estimator and horizon (as `"10"`, s): `mae`, m/s; `skill` = 1 − MAE/MAE(persistence), the last speed
        measured at the origin; `steps`, how many forecasts; of the ensemble also `covers`, the share of measurements in
        its intervals, and `halfwidth`, their mean, m/s, over those that are finite. None where there are fewer than
        LEAST forecasts, or where one of the estimator's left ± `surge_max`: so it cannot win by the others.

    >>> horizon_scores(Fleet((), (), {}), [], (0.4,), ("aid", "persistence", "ensemble"))
    {}
    """
    H, K = len(horizons), len(names)
    total = np.zeros((len(fleet.boats), H, K))
    count = np.zeros((len(fleet.boats), H))
    inside, known, width = (np.zeros((len(fleet.boats), H)) for _ in range(3))
    for run, step, arrays in published:
        if "forecasts" not in arrays:
            continue
        made, widths = arrays["forecasts"], arrays["forecast_halfwidths"]
        part = slice(step, step + len(made))
        samples = tree_map(lambda x, part=part: x[part], fleet.runs[run].samples)
        surge = np.where(masks(samples, surge_limit).learns, samples.surge, np.nan)[..., None]
        made = made.reshape(*made.shape[:2], H, K)
        due = np.isfinite(made[..., -1]) & np.isfinite(surge)
        errors = np.where(due[..., None], np.abs(made - surge[..., None]), 0.0)
        total += errors.sum(0)  # NaN where a member sleeps: it has no errors then
        count += due.sum(0)
        finite = due & np.isfinite(widths)
        known += finite.sum(0)
        inside += (finite & (errors[..., -1] <= widths)).sum(0)
        width += np.where(finite, widths, 0.0).sum(0)
    found: Scores = {}
    for lane, boat in enumerate(fleet.boats):
        found[boat] = {name: {} for name in names}
        for j, horizon in enumerate(horizons):
            steps = int(count[lane, j])
            maes = total[lane, j] / steps if steps >= LEAST else np.full(K, np.nan)
            base = maes[list(names).index(PERSISTENCE)]
            for k, name in enumerate(names):
                row: dict[str, float | int | None] = {"mae": _known(maes[k]), "skill": None, "steps": steps}
                if np.isfinite(maes[k]) and base > 0:
                    row["skill"] = float(1 - maes[k] / base)
                if k == K - 1:
                    some = known[lane, j] if known[lane, j] >= LEAST else 0
                    row["covers"] = float(inside[lane, j] / some) if some else None
                    row["halfwidth"] = float(width[lane, j] / some) if some else None
                found[boat][name][f"{horizon:g}"] = row
    return found


def ensemble_scores(ensemble: Ensemble, fleet: Fleet, published: Iterable[Stretch]) -> Scores:
    """`horizon_scores` of what an ensemble published; {} if it makes no forecasts."""
    if (made := ensemble.forecasts) is None:
        return {}
    columns = (*made.columns[:-1], ensemble.output)
    return horizon_scores(fleet, published, made.horizons.tolist(), columns, ensemble.surge_limit)


def mean_forecast_mae(scores: Mapping[str, Any], estimator: str, horizon: str) -> float:
    """MAE of an estimator over a horizon, m/s, mean over boats; NaN where a boat has none.

    >>> mean_forecast_mae({"a": {"x": {"10": {"mae": 0.1}}}, "b": {"x": {"10": {"mae": 0.3}}}}, "x", "10")
    0.2
    """
    maes = [rows[estimator][horizon]["mae"] for rows in scores.values()]
    return float("nan") if not maes or None in maes else sum(maes) / len(maes)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
