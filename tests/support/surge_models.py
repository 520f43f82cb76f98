"""Boats as models, what they are asked, and what the joint EKF answers."""

import numpy as np
import torch

from usvlearn import Inputs, JointEKF
from usvlearn.estimators.joint.state import THETA
from usvlearn.model.surge import WITH_EVEN, WITHOUT_EVEN, SurgeModel


def drawn(rng: np.random.Generator, even: bool) -> SurgeModel:
    names = WITH_EVEN if even else WITHOUT_EVEN
    values = {
        name: -abs(rng.normal(0, 10)) if name.startswith("drag_") and "even" not in name else rng.normal(0, 10)
        for name in names
    }
    return SurgeModel(28.0, values)


def some(rng: np.random.Generator, count: int) -> np.ndarray:
    """Speeds, commands, yaw rates and steps, with zeros among them, `(count, 5)`."""
    low, high = [-3, -1, -1, -0.5, 0], [3, 1, 1, 0.5, 2]
    rows = rng.uniform(low, high, (count, 5))
    rows[rng.random(rows.shape) < 0.05] = 0.0
    return rows


def by_filter(model: SurgeModel, rows: torch.Tensor) -> torch.Tensor:
    """One free step of a joint EKF with these parameters, without current and disturbance."""
    joint = JointEKF(surge_max=2.7, mass=model.mass, even=0.2 if model.even else None)
    zero = torch.zeros(len(rows), dtype=torch.float64)
    parameters = torch.tensor(model.per_mass).expand(len(rows), -1)
    mean = torch.cat([rows[:, :1], torch.zeros(len(rows), THETA - 1, dtype=torch.float64), parameters], -1)
    state = joint.init((len(rows),))._replace(mean=mean, commands=rows[:, 1:3])
    return joint.predict(state, Inputs(rows[:, 1], rows[:, 2], zero, rows[:, 3], rows[:, 4]))[1]
