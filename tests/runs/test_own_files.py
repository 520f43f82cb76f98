"""A run leaves the files of others alone: it removes what its index names, and writes through no link."""

import shutil
from pathlib import Path

import pytest

from tests.support.commands import run
from tests.support.recordings import recording
from tests.support.runs import TWO_MEMBERS, assert_same, session
from usvlearn.errors import ConfigError
from usvlearn.logs.recordings import align_fleet


def names(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(
    "name",
    [
        "predictions/mine.npz", "predictions/00000_0000010.npz", "checkpoints/net.pt", "checkpoints/a/best.safetensors",
        "tensorboard/events.out.tfevents.1", "results.json", "errors.csv",
    ],
)  # fmt: skip
def test_a_folder_with_files_of_no_run_is_refused_and_unchanged(tmp_path, fleet, name):
    path = tmp_path / "run" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"mine")
    before = names(tmp_path)
    with pytest.raises(ConfigError, match=rf"{path.name}: found a file of no run.* choose another hydra\.run\.dir"):
        session(tmp_path / "run", fleet)
    assert names(tmp_path) == before and path.read_bytes() == b"mine"


@pytest.mark.parametrize("name", ["predictions", "checkpoints", "checkpoints/a", "tensorboard", "runs.json"])
@pytest.mark.parametrize("target", ["there", "nowhere"])
def test_no_link_is_followed_or_removed(tmp_path, fleet, name, target):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "00000_0000010.npz").write_bytes(b"mine")
    link = tmp_path / "run" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / target)
    before = names(tmp_path)
    with pytest.raises(ConfigError, match=f"{link.name}: found a link"):
        session(tmp_path / "run", fleet)
    assert names(tmp_path) == before and link.is_symlink()


def test_a_link_in_a_folder_of_one_s_own_is_not_followed_either(tmp_path, fleet):
    folder = session(tmp_path / "run", fleet).path
    shutil.move(folder / "predictions", tmp_path / "moved")
    (folder / "predictions").symlink_to(tmp_path / "moved")
    before = names(tmp_path)
    with pytest.raises(ConfigError, match="predictions: found a link"):
        session(folder, fleet, "latest")
    assert names(tmp_path) == before


def test_a_resumed_run_removes_only_what_its_index_names(tmp_path, fleet):
    whole, folder = session(tmp_path / "whole", fleet), session(tmp_path / "run", fleet)
    predictions = folder.path / "predictions"
    mine = [predictions / name for name in ("mine.npz", "7_3.npz", "00099_0000010.npz", "00000_9999999.npz", "b.txt")]
    for path in mine:
        path.write_bytes(b"mine")
    written = set(predictions.glob("*.npz")) - {*mine}
    for boat in "ab":
        for path in (folder.path / "checkpoints" / boat).iterdir():
            path.unlink()  # so that all predictions are made anew
    with pytest.warns(UserWarning, match="resuming from before it"):
        again = session(folder.path, fleet, "latest")
    assert_same(again, whole)
    assert all(path.read_bytes() == b"mine" for path in mine) and written <= set(predictions.glob("*.npz"))


def test_predictions_that_only_a_new_index_would_name_are_refused(tmp_path, fleet):
    """A run that was killed before its first checkpoint left an index; of its predictions none is so far on."""
    folder = session(tmp_path / "run", fleet).path
    shutil.rmtree(folder / "checkpoints")
    longer = align_fleet([recording("a", "one", 60.0)])
    mine = folder / "predictions" / f"00000_{len(longer.runs[0].time):07d}.npz"
    mine.write_bytes(b"mine")
    before = names(folder)
    with pytest.raises(ConfigError, match=f"{mine.name}: found a file of no run"):
        session(folder, longer)
    assert names(folder) == before and mine.read_bytes() == b"mine"


@pytest.mark.parametrize("sweep", [False, True], ids=["run", "sweep"])
def test_the_command_refuses_before_hydra_writes(tmp_path, sweep):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "config.yaml").write_text("mine")
    job = tmp_path / "out" / ("0" if sweep else ".")
    job.mkdir(parents=True)
    (job / ".hydra").symlink_to(tmp_path / "there")
    before = names(tmp_path)
    how = ["-m", "seed=0,1", f"hydra.sweep.dir={tmp_path}/out"] if sweep else [f"hydra.run.dir={tmp_path}/out"]
    done = run(*how, *TWO_MEMBERS, folder=tmp_path)
    assert done.returncode == 2 and ".hydra: found a link" in done.stderr and done.stderr.count("\n") == 1
    assert names(tmp_path) == before and (tmp_path / "there" / "config.yaml").read_text() == "mine"
