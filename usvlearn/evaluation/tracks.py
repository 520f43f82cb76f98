"""Position errors of tracks against two baselines, and the coverage of the ellipses.

tracks                   those of `usvlearn.Planar`, with the commands that came
constant turn            the measured speed and yaw rate of the origin go on
held yaw rate            the forecast speed, and the yaw rate of the origin
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.estimators.planar.state import CONSTANT, DUE, ERROR, GROUP, HEADING_ERROR, HELD_RATE, RADIUS, RHO
from usvlearn.evaluation.manoeuvres import GROUPS

FEWEST = 10  # ellipses of a group, below which no share is stated


def track_scores(
    parts: Iterable[np.ndarray], horizons: Sequence[float], boats: Sequence[str]
) -> dict[str, dict[str, dict[str, Any]]]:
    """Mean errors and shares inside, by boat and horizon.

    Args:
        parts: published `tracks` of consecutive stretches, `(time, boats, horizons · 8)`.
        horizons: s.
        boats: names.

    Returns:
        boat -> horizon, such as "10" -> position and position_constant_turn, position_held_rate, m; heading, rad;
        inside; inside_stay, inside_move, inside_move_much; radius, m, the median; count. None where nothing was due.
    """
    found = [part.reshape(*part.shape[:2], len(horizons), DUE) for part in parts]
    whole = np.concatenate(found) if found else np.empty((0, len(boats), len(horizons), DUE))
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


def pooled(scores: Mapping[str, Mapping[str, Mapping[str, Any]]], horizon: str, key: str) -> float | None:
    """The mean of a score over the boats that have it, weighted by their counts."""
    rows = [(each[horizon][key], each[horizon]["count"]) for each in scores.values() if each[horizon][key] is not None]
    total = sum(count for _, count in rows)
    return sum(value * count for value, count in rows) / total if total else None
