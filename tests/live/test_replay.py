"""A recorded session that train.py replays gives the same predictions to the last bit."""

import numpy as np
import pytest

from tests.support import commands
from tests.support.live import boat, learned_set, messages, ready


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    return learned_set(tmp_path_factory.mktemp("start"))


def replayed(records, number=1):
    """Times and predictions of a record, replayed as its configuration says."""
    name = f"record_{number:04d}"
    done = commands.run(f"data={name}.yaml", f"resume={name}.safetensors", "hydra.run.dir=again", folder=records)
    assert done.returncode == 0, done.stderr
    arrays = [np.load(path) for path in sorted((records / "again" / "predictions").glob("*.npz"))]
    return np.concatenate([each["predictions"] for each in arrays])[:, 0]


def test_live_is_replay(tmp_path, start):
    steps = []
    with ready(tmp_path / "node", start, record=True) as session:
        names = session._node.online.names
        for part, stamp, value in messages(boat()):
            steps += session.push(part, stamp, value)
        steps += session._node.finish()
    predicted = np.array([[step.members.get(name, np.nan) for name in names] for step in steps])
    found = replayed(tmp_path / "node" / "records")
    np.testing.assert_array_equal(found, predicted)
    assert np.isfinite(predicted).mean() > 0.9
