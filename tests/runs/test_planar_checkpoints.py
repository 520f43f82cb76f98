"""Checkpoints of what is learned beside a run's ensemble: sway, yaw rate and tracks."""

import shutil

import numpy as np
import pytest

from tests.support.commands import SMALL, ran, results, run
from usvlearn.core.checkpoint import checkpoints, load

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long

ONE = [*SMALL, "hydra.run.dir=run"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run with tracks, and one without."""
    folder = tmp_path_factory.mktemp("beside")
    for name, more in (("run", []), ("without", ["tracks=null"])):
        ran(*SMALL, *more, f"hydra.run.dir={name}", folder=folder)
    return folder


def newest(folder, name="run"):
    return checkpoints(folder / name / "planar" / "checkpoints" / "heron")[-1]


def test_without_tracks_nothing_else_differs(made):
    tracked, without = (results(made / name) for name in ("run", "without"))
    assert "tracks" in tracked and "tracks" not in without and not (made / "without" / "planar").exists()
    assert tracked["boats"] == without["boats"] and tracked["forecast"] == without["forecast"]


def test_a_run_without_tracks_is_resumed_with_them(made, tmp_path):
    shutil.copytree(made / "without", tmp_path / "run")
    done = ran(*ONE, "resume=latest", folder=tmp_path)
    assert "tracks, sway and yaw rate are learned anew" in done.stdout
    assert set(results(tmp_path / "run")["tracks"]["heron"]) == {"2", "5.2", "10", "30"}


def test_a_damaged_checkpoint_gives_way_to_the_one_before(made, tmp_path):
    shutil.copytree(made / "run", tmp_path / "first")
    path = newest(tmp_path, "first")
    path.write_bytes(path.read_bytes()[:1000])
    done = ran(*ONE, "data.seed=5", "resume=first", folder=tmp_path)
    assert "learned anew" not in done.stdout


def test_a_checkpoint_of_the_ensemble_brings_the_one_beside_it(made, tmp_path):
    one = newest(made)
    done = run(*ONE, "data.seed=5", f"resume={made}/run/checkpoints/heron/{one.name}", folder=tmp_path)
    assert done.returncode == 0 and "learned anew" not in done.stdout, done.stderr
    updates = [load(path)[0]["yaw.members.yaw.updates"] for path in (one, newest(tmp_path))]
    assert np.all(updates[1] > updates[0])
