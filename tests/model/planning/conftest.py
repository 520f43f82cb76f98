"""A boat that has sailed 15 min of simulated missions, and its saved checkpoint."""

from pathlib import Path

import pytest

import usvlearn
from usvlearn import JointEKF
from usvlearn.model.read_boats import IdentifiedBoat, read_boats


@pytest.fixture(scope="session")
def reader() -> JointEKF:
    """As in configs/estimator/joint_averaged.yaml."""
    return JointEKF(surge_max=2.7, mass=28.0, disturbance=0.05, current=0.15, lag=0.3, cubic=1.0, even=0.2,
                    estimate_every=600.0)  # fmt: skip


@pytest.fixture(scope="session")
def saved(tmp_path_factory, reader) -> Path:
    logs = usvlearn.read(data="simulated", hours=0.25, seed=3)
    return usvlearn.learn(logs, reader).save(tmp_path_factory.mktemp("sets") / "heron.safetensors")


@pytest.fixture(scope="session")
def boat(saved) -> IdentifiedBoat:
    (read,) = read_boats(saved)
    return read
