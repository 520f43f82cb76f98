"""Errors of forecasts and of tracks by horizon, and what their intervals and ellipses cover.

They are judged in three groups, too, by how far the commands moved within the horizon. The baselines of tracks are

constant turn            the measured speed and yaw rate of the origin go on
held yaw rate            the forecast speed, and the yaw rate of the origin
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, Sample, masks, tree_map
from usvlearn.estimators.ensemble.forecasts.state import PERSISTENCE
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import LITTLE, MUCH
from usvlearn.estimators.planar.state import CONSTANT, DUE, ERROR, GROUP, HEADING_ERROR, HELD_RATE, RADIUS, RHO
from usvlearn.evaluation.metrics import MISSING, Stretch
from usvlearn.evaluation.season import measured

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble

GROUPS = ("stay", "move", "move_much")


def groups_of(samples: Sample, horizons: Sequence[float], surge_limit: float = PLAUSIBLE) -> np.ndarray:
    """The group of a forecast that is due at each step: 0, 1 or 2, `(time, boats, horizons)`."""
    steps, inputs = masks(samples, surge_limit).steps, samples.inputs
    time = np.where(steps, inputs.dt, 0.0).cumsum(0)
    mean = (inputs.command_left + inputs.command_right) / 2
    groups = np.zeros((*mean.shape, len(horizons)), np.int8)
    for element in range(mean.shape[1]):
        mask = steps[:, element]
        least = _doubled(np.where(mask, mean[:, element], np.inf), np.minimum)
        most = _doubled(np.where(mask, mean[:, element], -np.inf), np.maximum)
        for j, horizon in enumerate(horizons):
            half = np.where(mask, samples.inputs.dt[:, element], 0.0) / 2
            origin = np.searchsorted(time[:, element], time[:, element] - horizon - half)
            origin = np.minimum(origin, np.arange(len(time)))
            low, high = _over(least, origin, np.minimum), _over(most, origin, np.maximum)
            moved = np.where(np.isfinite(high - low), high - low, 0.0)
            groups[:, element, j] = (moved >= LITTLE).astype(np.int8) + (moved > MUCH)
    return groups


def _doubled(x: np.ndarray, f: np.ufunc) -> list[np.ndarray]:
    """The extreme values of the 2ʲ numbers that end at each place, for each j; of fewer at the beginning."""
    tables, length = [x], 1
    while length < len(x):
        last = tables[-1]
        tables.append(np.concatenate([last[:length], f(last[length:], last[:-length])]))
        length *= 2
    return tables


def _over(doubled: Sequence[np.ndarray], first: np.ndarray, f: np.ufunc) -> np.ndarray:
    """The extreme values from the places `first` to each place, both included."""
    last = np.arange(len(first))
    level = np.frexp(last - first + 1)[1] - 1  # the largest power of two that fits
    table = np.stack(doubled)
    return f(table[level, last], table[level, np.minimum(first + (1 << level) - 1, last)])


LEAST = 8  # forecasts, below which no score is stated
Scores = dict[str, dict[str, dict[str, dict[str, float | int | None]]]]  # boat -> estimator -> horizon -> number


class HorizonSums(NamedTuple):
    """Sums over forecasts that became due at a step with a measured speed, the same steps for all estimators."""

    horizons: tuple[float, ...]  # s
    names: tuple[str, ...]  # of the estimators; the last is the ensemble
    errors: np.ndarray  # (runs, boats, horizons, estimators) of |forecast − measured|, m/s, of those that are finite
    steps: np.ndarray  # (runs, boats, horizons) forecasts
    known: np.ndarray  # (runs, boats, horizons) those with a finite interval of the ensemble
    inside: np.ndarray  # (runs, boats, horizons) those whose interval contains the measurement
    width: np.ndarray  # (runs, boats, horizons) of half-widths that are finite, m/s
    interval: np.ndarray  # (runs, boats, horizons) of the interval scores of these, m/s
    group_known: np.ndarray  # (runs, boats, horizons, 3) `known` by how far the commands moved
    group_inside: np.ndarray  # (runs, boats, horizons, 3) `inside` likewise
    missing: np.ndarray  # (runs, boats, horizons, estimators) forecasts that were no speed: a member was inactive


def horizon_sums(
    fleet: Fleet,
    published: Iterable[Stretch],
    horizons: Sequence[float],
    names: Sequence[str],
    surge_limit: float = PLAUSIBLE,
    coverage: float = 0.9,
) -> HorizonSums:
    """The sums of each run from forecasts and their half-widths; horizons in s, the ensemble's column is last."""
    H, K = len(horizons), len(names)
    shape = (len(fleet.runs), len(fleet.boats), H)
    sums = HorizonSums(
        tuple(horizons), tuple(names), np.zeros((*shape, K)), np.zeros(shape, int),
        *(np.zeros(shape) for _ in range(4)), *(np.zeros((*shape, n)) for n in (len(GROUPS), len(GROUPS), K)),
    )  # fmt: skip
    moved: dict[int, np.ndarray] = {}  # of each run, which may come in several stretches
    for run, step, arrays in published:
        if "forecasts" not in arrays:
            continue
        forecasts, widths = arrays["forecasts"], arrays["forecast_halfwidths"]
        part = slice(step, step + len(forecasts))
        samples = tree_map(lambda x, part=part: x[part], fleet.runs[run].samples)
        surge = measured(samples, surge_limit)[..., None]
        forecasts = forecasts.reshape(*forecasts.shape[:2], H, K)
        due = np.isfinite(forecasts[..., -1]) & np.isfinite(surge)
        errors = np.where(due[..., None], np.abs(forecasts - surge[..., None]), 0.0)
        sums.errors[run] += np.where(np.isfinite(errors), errors, 0.0).sum(0)
        sums.missing[run] += (~np.isfinite(errors)).sum(0)
        sums.steps[run] += due.sum(0)
        finite = due & np.isfinite(widths)
        sums.known[run] += finite.sum(0)
        sums.inside[run] += (finite & (errors[..., -1] <= widths)).sum(0)
        sums.width[run] += np.where(finite, widths, 0.0).sum(0)
        beyond = np.where(finite, np.maximum(errors[..., -1] - widths, 0.0), 0.0)
        sums.interval[run] += (np.where(finite, 2 * widths, 0.0) + 2 / (1 - coverage) * beyond).sum(0)
        if run not in moved:
            moved[run] = groups_of(fleet.runs[run].samples, horizons, surge_limit)
        within = moved[run][part][..., None] == np.arange(len(GROUPS))
        sums.group_known[run] += (finite[..., None] & within).sum(0)
        sums.group_inside[run] += ((finite & (errors[..., -1] <= widths))[..., None] & within).sum(0)
    return sums


def horizon_scores(sums: HorizonSums, boats: Sequence[str]) -> Scores:
    """Scores of forecasts, over all runs.

    Returns:
        By boat, estimator and horizon (as `"10"`, s): `mae`, m/s; `skill` = 1 − MAE/MAE(persistence), the last speed
        measured at the origin; `steps`, how many forecasts; of the ensemble also `covers`, the share of measurements in
        its intervals, `halfwidth`, their mean, m/s, over those that are finite, and `interval`, their mean interval
        score, m/s: the whole width, and 2/α times what a measurement is outside (α = 0.1). Less is better.
        `covers_stay`, `covers_move`, `covers_move_much` are `covers` where the mean command moved by less than 0.05 of
        full scale within the horizon, by up to 0.25, or more; `steps_stay` … their numbers. None where there are fewer
        than LEAST forecasts, or where more than MISSING of the estimator's left ± `surge_max`: so it cannot win by the
        others.
    """
    total, count, known, inside, width, interval, some_known, some_inside, missing = (x.sum(0) for x in sums[2:])
    names, K = sums.names, len(sums.names)
    scores: Scores = {}
    for element, boat in enumerate(boats):
        scores[boat] = {name: {} for name in names}
        for j, horizon in enumerate(sums.horizons):
            steps = int(count[element, j])
            maes = means(total[element, j], steps, missing[element, j]) if steps >= LEAST else np.full(K, np.nan)
            base = maes[names.index(PERSISTENCE)]
            for k, name in enumerate(names):
                row: dict[str, float | int | None] = {"mae": _known(maes[k]), "skill": None}
                row["steps"] = steps - int(missing[element, j, k])
                if np.isfinite(maes[k]) and base > 0:
                    row["skill"] = float(1 - maes[k] / base)
                if k == K - 1:
                    some = known[element, j] if known[element, j] >= LEAST else 0
                    row["covers"] = float(inside[element, j] / some) if some else None
                    row["halfwidth"] = float(width[element, j] / some) if some else None
                    row["interval"] = float(interval[element, j] / some) if some else None
                    for group, name_of in enumerate(GROUPS):
                        here = int(some_known[element, j, group])
                        share = float(some_inside[element, j, group] / here) if here >= LEAST else None
                        row |= {f"covers_{name_of}": share, f"steps_{name_of}": here}
                scores[boat][name][f"{horizon:g}"] = row
    return scores


def means(total: np.ndarray, steps: int, missing: np.ndarray) -> np.ndarray:
    """Sums over those of so many steps that are not missing, as means; NaN where more than MISSING of them are."""
    return np.divide(total, steps - missing, out=np.full(total.shape, np.nan), where=missing <= MISSING * steps)


def ensemble_sums(ensemble: Ensemble, fleet: Fleet, published: Iterable[Stretch]) -> HorizonSums | None:
    """`horizon_sums` of what an ensemble published; None if it makes no forecasts."""
    if (forecasts := ensemble.forecasts) is None:
        return None
    columns = (*forecasts.columns[:-1], ensemble.output)
    return horizon_sums(fleet, published, forecasts.horizons.tolist(), columns, ensemble.surge_limit, ensemble.coverage)


def ensemble_scores(ensemble: Ensemble, fleet: Fleet, published: Iterable[Stretch]) -> Scores:
    """`horizon_scores` of what an ensemble published; {} if it makes no forecasts."""
    sums = ensemble_sums(ensemble, fleet, published)
    return {} if sums is None else horizon_scores(sums, fleet.boats)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


FEWEST = 10  # ellipses of a group, below which no share is stated


def track_scores(
    parts: Iterable[np.ndarray], horizons: Sequence[float], boats: Sequence[str]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Mean errors and shares inside from published `tracks` `(time, boats, horizons · 8)`, by boat and horizon (such as
    "10", s).

    Position and those of a constant turn and a held rate, m; heading, rad; inside, and by how the commands moved;
    radius, m, the median; count. None where nothing was due.
    """
    pieces = [part.reshape(*part.shape[:2], len(horizons), DUE) for part in parts]
    whole = np.concatenate(pieces) if pieces else np.empty((0, len(boats), len(horizons), DUE))
    return {
        boat: {f"{h:g}": _score(whole[:, element, k]) for k, h in enumerate(horizons)}
        for element, boat in enumerate(boats)
    }


def _score(rows: np.ndarray) -> dict[str, Any]:
    """Of one boat and horizon, `(time, 8)`."""
    rows = rows[np.isfinite(rows[:, ERROR])]
    known = np.isfinite(rows[:, RADIUS])
    inside, group = rows[known, RHO] <= rows[known, RADIUS], rows[known, GROUP]

    def mean(values: np.ndarray, fewest: int = 1) -> float | None:
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) >= fewest else None

    shares = {f"inside_{name}": mean(inside[group == k].astype(float), FEWEST) for k, name in enumerate(GROUPS)}
    return {
        "position": mean(rows[:, ERROR]),
        "position_constant_turn": mean(rows[:, CONSTANT]),
        "position_held_rate": mean(rows[:, HELD_RATE]),
        "heading": mean(rows[:, HEADING_ERROR]),
        "inside": mean(inside.astype(float), FEWEST),
        **shares,
        "radius": float(np.median(rows[known, RADIUS])) if known.any() else None,
        "count": len(rows),
    }
