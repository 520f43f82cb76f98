"""A small run of two boats, from which everything is exported."""

import pytest

from tests.support import commands
from usvlearn.model.read_boats import read_boats


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """The folder of a run in which a joint EKF reads, and a network learns."""
    folder = tmp_path_factory.mktemp("exported")
    done = commands.run(
        "data.hours=0.2", "data.n=2", "data.mission_minutes=4", "hydra.run.dir=run", "estimators.rnn.neurons=6",
        "estimators.joint_averaged.read_every=60", folder=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder / "run"


@pytest.fixture(scope="session")
def boat(run):
    return read_boats(run)[0]
