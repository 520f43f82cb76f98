"""Boats in the plane as models, what they are asked, and checkpoints that hold them."""

from pathlib import Path

import numpy as np

from tests.support.surge_models import drawn
from usvlearn import Ensemble, ForecastSettings, JointEKF, Planar, SwayEKF, YawEKF
from usvlearn.core import checkpoint
from usvlearn.estimators.axis.state import THETA
from usvlearn.estimators.planar.layer import axis_ensemble
from usvlearn.model.planar import COEFFICIENTS, Motion, PlanarModel
from usvlearn.model.surge import SurgeModel

TOP = 2.7
DAMPED = {"linear": (-2.0, -0.5), "quadratic": (-1.0, 0.0), "cross": (-0.5, 0.0)}


def drawn_planar(rng: np.random.Generator, sways: bool = True, surge: SurgeModel | None = None) -> PlanarModel:
    """A boat whose drag slows it in every axis; the surge is drawn, too, if it is not given."""
    surge = drawn(rng, True) if surge is None else surge
    axes = [
        {name: float(rng.uniform(*DAMPED.get(name, (-0.3, 0.3)))) for name in COEFFICIENTS[kind]}
        for kind in ("yaw", "sway")
    ]
    return PlanarModel(surge, axes[0], axes[1] if sways else None)


def commanded(rng: np.random.Generator, count: int) -> np.ndarray:
    """Left, right, step and current of some steps, with zeros among the commands, `(5, count)`."""
    steps = rng.uniform([-1, -1, 0.05, -0.5, -0.5], [1, 1, 0.8, 0.5, 0.5], (count, 5)).T
    steps[:2][rng.random((2, count)) < 0.05] = 0.0
    return steps


def moving(rng: np.random.Generator, count: int | None = None) -> Motion:
    """Some motions."""
    size = () if count is None else (count,)
    return Motion(*(rng.uniform(-each, each, size) for each in (2.0, 0.5, 0.5, 10.0, 100.0, 100.0)))


def mean_of(model: PlanarModel, kind: str) -> np.ndarray:
    """x of an axis EKF with these coefficients, at rest and without a lag."""
    return np.array([*[0.0] * THETA, *getattr(model, kind).values(), 0.0])


def lone_filters() -> Planar:
    """One filter for each axis."""
    return Planar(
        Ensemble({"joint": JointEKF(surge_max=TOP)}, forecasts=ForecastSettings()),
        yaw=axis_ensemble({"yaw": YawEKF(surge_max=TOP)}),
        sway=axis_ensemble({"sway": SwayEKF(surge_max=TOP)}),
    )


def save_planar(folder: Path, boat: str, leaves: dict[str, np.ndarray]) -> Path:
    """A checkpoint of `lone_filters` in RUN/planar, with these leaves in place of the first ones; returns its path."""
    path, planar = folder / "planar" / "checkpoints" / boat / "00000_0000001.safetensors", lone_filters()
    checkpoint.save(path, planar.init(), estimator="Planar", kernel=planar.description(), boat=boat)
    first, facts = checkpoint.load(path)
    assert leaves.keys() <= first.keys()
    return checkpoint.save(path, {**first, **leaves}, **facts)


def learned(model: PlanarModel) -> dict[str, np.ndarray]:
    """The leaves of filters that have learned a boat."""
    kinds = ("yaw",) if model.sway is None else ("yaw", "sway")
    leaves = {f"{kind}.members.{kind}.mean": mean_of(model, kind) for kind in kinds}
    return leaves | {f"{kind}.members.{kind}.updates": np.array(100.0) for kind in kinds}
