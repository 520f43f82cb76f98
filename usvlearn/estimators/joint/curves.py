"""Curves of an identified boat with their 90 % bands: drag over speed, thrust and steady speed over the command."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from usvlearn.estimators.joint.periodic_estimates import Identified, IntervalTerms
from usvlearn.estimators.joint.quantities import SIDES, Ahead, kilograms_of, steps_of

POINTS = 41


class Curve(NamedTuple):
    """A curve with its band; all `(points,)`."""

    at: np.ndarray  # m/s or share of full command
    value: np.ndarray  # N or m/s
    low: np.ndarray
    high: np.ndarray


def curves(boat: Identified) -> dict[str, Curve]:
    """`drag`, N over m/s up to the steady speed at full command; `thrust_left` and `thrust_right`, N at standstill, and
    `steady_speed`, m/s, over the command. {} if nothing is identified.
    """
    top = abs(boat["steady_speed_full"].value)
    beside = boat.beside
    if beside is None or not (
        np.isfinite(boat.theta).all() and np.isfinite(boat.covariance).all() and np.isfinite(top)
    ):
        return {}
    speeds, commands = np.linspace(0.0, top, POINTS), np.linspace(0.0, 1.0, POINTS)

    def force(of: Callable[[Ahead], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        return lambda theta: (
            kilograms_of(theta, boat.mass, boat.inverse_mass)[..., None] * of(boat.ahead(theta[..., None, :]))
        )

    def pull(side: str) -> Callable[[Ahead], np.ndarray]:
        return lambda boat: boat.thrust(commands, side)

    functions = {
        "drag": (speeds, force(lambda boat: boat.drag(speeds))),
        **{f"thrust_{side}": (commands, force(pull(side))) for side in SIDES},
        "steady_speed": (commands, lambda theta: boat.ahead(theta[..., None, :]).steady_speed(commands)),
    }
    return {name: banded(boat, beside, name, *function) for name, function in functions.items()}


def banded(
    boat: Identified, beside: IntervalTerms, name: str, at: np.ndarray, f: Callable[[np.ndarray], np.ndarray]
) -> Curve:
    """A curve at points, f of θ per unit mass, `(..., m)` to `(..., points)`, with their 90 % intervals."""
    steps = steps_of(beside.variance)
    shifts = np.diag(steps)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        values = [f(theta) for theta in (boat.theta, beside.now, beside.prior)]
        slopes, of_prior = (
            (f(theta + shifts) - f(theta - shifts)) / (2 * steps[:, None]) for theta in (boat.theta, beside.prior)
        )  # (m, points)
    band = [
        beside.interval(name, each, slope, first, boat.covariance)
        for *each, slope, first in zip(*values, slopes.T, of_prior.T, strict=True)
    ]
    low, high = np.array(band).T
    return Curve(at, values[0], low, high)
