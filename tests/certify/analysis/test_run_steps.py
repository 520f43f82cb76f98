"""The networks of runs with the steps that the runs saved; foreign and damaged folders."""

import numpy as np
import pytest

from certify.analysis.run_steps import given, step_of
from certify.errors import CertifyError


def run_folder(folder, dt=(0.0, 0.25, 0.25, 0.5), boats=("heron",)):
    """A run of two boats' sets, which tells its steps as `usvlearn train` does."""
    for boat in boats:
        place = folder / "checkpoints" / boat
        place.mkdir(parents=True)
        np.savez(place / "00000_0000004.npz", a=[0.5], w1=[1.0], W2=np.zeros((1, 4)), b=[0.1])
    (folder / "predictions").mkdir()
    steps = np.stack([np.array(dt) * (k + 1) for k in range(len(boats))], -1)
    np.savez(folder / "predictions" / "00000_0000004.npz", dt=steps, boats=np.array(boats))
    return folder


def test_the_networks_of_a_run_have_its_own_steps(tmp_path):
    run = run_folder(tmp_path / "run", boats=("heron", "otter"))
    (family,) = given([run])
    assert family.steps == [0.25, 0.5] and family.notes == [] and family.name == "run"
    one, other = given([run / "checkpoints" / "otter", run_folder(tmp_path / "more" / "run")])
    assert (one.name, one.steps, other.name, other.steps) == ("otter", [0.5], "run", [0.25])
    assert [each.name for each in given([run, tmp_path / "more" / "run"])] == ["run", "run'"]
    (whole,) = given([tmp_path])  # as a sweep: each checkpoint with the step of its own run
    assert sorted(whole.steps) == [0.25, 0.25, 0.5]
    (part,) = given([tmp_path], most=2)
    assert len(part.networks) == 2 and "2 of 3 files, evenly spaced" in part.notes[-1]


@pytest.mark.parametrize(
    "content",
    [b"", b"no zip", {"dt": np.zeros((4, 1))}, {"dt": np.full((4, 1), np.nan)}, {"dt": np.ones((4, 3))},
     {"dt": np.ones(4)}, {"dt": np.array([["a"]])}, {"dt": np.array([[None]], dtype=object)},
     {"dt": np.full((4, 1), 1e9)}],
)  # fmt: skip
def test_damaged_predictions_of_a_run_are_told_and_the_rest_is_used(tmp_path, content):
    run = run_folder(tmp_path / "run")
    beside = run / "predictions" / "00000_0000004.npz"
    if isinstance(content, bytes):
        beside.write_bytes(content)
    else:
        np.savez(beside, boats=np.array(["heron"]), **content)
    (family,) = given([run])
    assert family.steps == [None] and len(family.networks) == 1
    assert str(beside) in family.notes[0] and "expected dt in s" in family.notes[0] and "give --dt" in family.notes[1]
    assert given([run], 0.3)[0].steps == [0.3] and "--dt, 0.3 s, is used" in given([run], 0.3)[0].notes[1]


def test_a_boat_whose_run_ends_sooner_has_the_steps_of_the_file_in_which_it_ends(tmp_path):
    run = run_folder(tmp_path / "run")
    for name, dt in (("00000_0000009", 0.7), ("00001_0000009", 0.8)):
        np.savez(run / "predictions" / f"{name}.npz", dt=np.full((5, 1), dt), boats=np.array(["heron"]))
    place = run / "checkpoints" / "heron"
    steps = {"00000_0000003": 0.25, "00000_0000004": 0.25, "00000_0000005": 0.7, "00000_0000010": None,
             "00001_0000001": 0.8, "00002_0000001": None, "last": None}  # fmt: skip
    assert {name: step_of(place / f"{name}.npz") for name in steps} == steps


def test_folders_that_are_no_run_have_no_steps(tmp_path):
    run = run_folder(tmp_path / "run")
    (run / "predictions" / "00000_0000004.npz").unlink()
    (family,) = given([run])
    assert family.steps == [None] and "no step is saved beside 1 of 1 files" in family.notes[0]
    np.savez(tmp_path / "old.npz", a=[0.5], w1=[1.0], W2=np.zeros((1, 4)), b=[0.1])
    np.savez(run / "predictions" / "00000_0000004.npz", predictions=np.zeros((4, 1, 1)))  # an older run
    assert given([run])[0].steps == given([tmp_path / "old.npz"])[0].steps == [None]
    (run / "checkpoints" / "heron" / "00000_0000004.npz").write_bytes(b"damaged")
    with pytest.raises(CertifyError, match="cannot be read"):
        given([run])
