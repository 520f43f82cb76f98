"""Chooses the terms that a log supports, by leaving out one mission, or piece of one, at a time.

Equation (1): `docs/theory/identification.md#batch-fit-choice`; g and H are ∇L and Φ there. So a set costs one pass more
over the missions, not one fit for each. Missions, never single steps, are left out: errors of neighbouring steps are
alike. Of one or two the set with the largest evidence is taken, which is a weaker reason.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.model.fit.gauss_newton import Fit, Missions, legal

FEWEST = 3  # missions, of which one can be left out
FEW = 10  # missions, up to which each is left out by a fit of its own: one step of so many is too far
FEWEST_WORN = 6  # stretches, of which wear can be seen: three of them may rise by chance
WEAR = ", wear"  # what the name of a set with wear ends with
Wear = Callable[[Missions, Fit, float], tuple[Fit, np.ndarray]]


class Score(NamedTuple):
    """How a set of terms does on missions that it has not learned."""

    losses: np.ndarray  # (missions,) a measured step, at one deviation for all sets
    gain: float  # mean loss of the used set minus that of this one, positive where this one is better; NaN: one mission
    error: float  # its standard error over the missions; infinite with too few of them


def left_out(missions: Missions, fit: Fit, deviation: float) -> np.ndarray:
    """The loss of each mission, left out, `(missions,)`, a measured step; σ of a speed, m/s, is that of all sets."""
    known, total = fit.known, fit.information.sum(0) + fit.known.information
    losses = np.zeros(len(missions.rows))
    for k in range(len(losses)):
        if FEWEST <= len(losses) <= FEW:
            losses[k] = missions.loss(missions.without(k).settled(fit).theta, deviation, k)
            continue
        theta, covariance = fit.theta.copy(), np.linalg.inv(total - fit.information[k])
        theta[known.active] += covariance @ fit.score[k]  # (1)
        losses[k] = missions.loss(legal(theta, known, covariance), deviation, k)
    return losses / np.maximum(missions.steps, 1)


def choose(
    missions: Missions, fits: dict[str, Fit], terms: str | None = None, wear: Wear | None = None
) -> tuple[str, dict[str, Score]]:
    """The name of the set to use, `terms` if a person has chosen, and the score of each beside it.

    `fits` are from the smallest set to the largest; of those that `wear` makes (`wear.worn`) the best one is added.
    """
    deviation, steps = min(fit.deviation for fit in fits.values()), missions.steps
    losses = {name: left_out(missions, fit, deviation) for name, fit in fits.items()}
    if len(missions.rows) < FEWEST:
        chosen = terms or max(fits, key=lambda name: fits[name].evidence)
    else:
        chosen = terms or _smallest(losses, steps)
        if wear is not None and len(set(missions.stretches)) >= FEWEST_WORN:
            worn = {name: wear(missions, fits[name], deviation) for name in ([terms] if terms else list(fits))}
            of = _smallest({name: each[1] for name, each in worn.items()}, steps)
            fits[f"{of}{WEAR}"], losses[f"{of}{WEAR}"] = worn[of]
            better, error = compared(losses[chosen], losses[f"{of}{WEAR}"], steps)
            chosen = f"{of}{WEAR}" if better > error else chosen
    return chosen, {name: Score(each, *compared(losses[chosen], each, steps)) for name, each in losses.items()}


def _smallest(losses: Mapping[str, np.ndarray], steps: Sequence[int]) -> str:
    """The first set than which the best one is better by at most the standard error."""
    best = min(losses, key=lambda name: float(losses[name] @ np.asarray(steps)))
    for name in losses:
        better, error = compared(losses[name], losses[best], steps)
        if better <= error:
            return name
    return best


def compared(first: np.ndarray, second: np.ndarray, steps: Sequence[int]) -> tuple[float, float]:
    """By how much the second losses are lower, a step, and the standard error of that over the missions."""
    if len(first) < 2:  # without its only mission a fit is the prior
        return math.nan, math.inf
    weight = np.asarray(steps, float) / max(sum(steps), 1)
    gains = first - second
    mean = float(weight @ gains)
    if len(gains) < FEWEST:
        return mean, math.inf
    count = len(gains)
    return mean, math.sqrt(float((weight**2) @ (gains - mean) ** 2) * count / (count - 1))
