"""Curves of an identified boat with their 90 % bands: drag over speed, thrust and steady speed over the command."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from usvlearn.estimators.joint.quantities import SIDES, Ahead, kilograms_of
from usvlearn.estimators.joint.reading import DEVIATIONS, Identified

POINTS = 41
STEP = 1e-4  # of the central differences, relative to each parameter's deviation


class Curve(NamedTuple):
    """A curve with its band; all `(points,)`."""

    at: np.ndarray  # m/s or share of full command
    value: np.ndarray  # N or m/s
    low: np.ndarray
    high: np.ndarray


def curves(found: Identified) -> dict[str, Curve]:
    """`drag`, N over m/s up to the steady speed at full command; `thrust_left` and `thrust_right`, N at standstill, and
    `steady_speed`, m/s, over the command. {} if nothing is identified.
    """
    top = abs(found["steady_speed_full"].value)
    if not (np.isfinite(found.theta).all() and np.isfinite(found.covariance).all() and np.isfinite(top)):
        return {}
    speeds, commands = np.linspace(0.0, top, POINTS), np.linspace(0.0, 1.0, POINTS)

    def force(of: Callable[[Ahead], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        return lambda theta: (
            kilograms_of(theta, found.mass, found.inverse_mass)[..., None] * of(Ahead(theta[..., None, :]))
        )

    def pull(side: str) -> Callable[[Ahead], np.ndarray]:
        return lambda boat: boat.thrust(commands, side)

    return {
        "drag": _banded(found, speeds, force(lambda boat: boat.drag(speeds))),
        **{f"thrust_{side}": _banded(found, commands, force(pull(side))) for side in SIDES},
        "steady_speed": _banded(found, commands, lambda theta: Ahead(theta[..., None, :]).steady_speed(commands)),
    }


def _banded(found: Identified, at: np.ndarray, f: Callable[[np.ndarray], np.ndarray]) -> Curve:
    """A curve of the parameters, `(..., m)` to `(..., points)`, with its band."""
    steps = STEP * np.sqrt(np.diag(found.covariance).clip(min=1e-12))
    shifts = np.diag(steps)
    value = f(found.theta)
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = (f(found.theta + shifts) - f(found.theta - shifts)) / (2 * steps[:, None])  # (m, points)
        half = DEVIATIONS * np.sqrt(np.einsum("ik,ij,jk->k", slopes, found.covariance, slopes).clip(min=0.0))
    return Curve(at, value, value - half, value + half)
