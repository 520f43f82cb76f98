"""Identified boats whose parameters and covariance a test chooses."""

from pathlib import Path

import numpy as np

from usvlearn.estimators.joint.periodic_estimates import Identified, IntervalTerms
from usvlearn.estimators.joint.state import names
from usvlearn.logs.setup import Setup
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.model.surge import SurgeModel

MASS = 28.0  # kg
HERON = {  # per unit mass, near the project's Heron
    "drag_quadratic": -0.1, "drag_linear": -0.55, "drag_cross": -0.1, "command_lag": 0.25,
    **{f"thrust_{kind}_{side}": value for side in ("left", "right")
       for kind, value in {"linear": 0.2, "quadratic": 1.6, "speed": -0.02, "cubic": -0.6}.items()},
}  # fmt: skip
THETA_ODD = np.array(
    [-0.1, -0.6, -0.3, 0.2, 0.5, -0.05, 0.25, 0.6, -0.02, 0.3, 0.2, 0.1]
)  # without fore-aft asymmetry terms
CHANNELS = {name: {"name": name} for name in ("command_left", "command_right", "heading", "surge")}
SETUP = Setup.of({"channels": CHANNELS, "align": {"dt": 0.4}})


def known_boat(spread: float = 0.04, vague: bool = False, lacks=(), **parameters: float) -> IdentifiedBoat:
    """A boat without fore-aft asymmetry terms."""
    theta = np.array([{**HERON, **parameters}[name] for name in names(even=False)])
    covariance = np.diag((spread * theta) ** 2)
    beside = IntervalTerms(0.0, theta, theta, np.maximum(theta**2, 1e-4), vague)
    identified = Identified({}, "Known.", "", tuple(lacks), MASS, np.zeros(len(theta)), theta, covariance, beside)
    return IdentifiedBoat("heron", Path("known.safetensors"), identified, SurgeModel.of(identified), SETUP, {}, {})
