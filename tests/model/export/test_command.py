"""The command `usvlearn export`."""

import dataclasses
import sys
import warnings

import pytest

from usvlearn import AID, Online
from usvlearn.__main__ import main
from usvlearn.cli import export
from usvlearn.core import checkpoint
from usvlearn.core.checkpoint import checkpoints
from usvlearn.model.export.formats import FORMATS


def test_files_are_written_beside_the_run_and_named(run, capsys):
    assert main(["export", str(run), "--to", "json,c"]) == 0
    paths = capsys.readouterr().out.split()
    ends = (".json", "_surge.h", "_planar.json", "_planar.h")  # its boats learned a yaw rate, too
    assert paths == [str(run / "export" / f"{boat}{end}") for boat in ("heron1", "heron2") for end in ends]


def test_a_set_and_a_folder_of_sets_are_one_boat(run, tmp_path, capsys, monkeypatch):
    folder = run / "checkpoints" / "heron2"
    monkeypatch.chdir(folder)
    for given in (folder, checkpoints(folder)[-1], "."):
        assert main(["export", str(given), "--to", "csv", "--to", "mat", "--out", str(tmp_path)]) == 0
        assert capsys.readouterr().out.split() == [str(tmp_path / f"heron2{end}") for end in (".csv", ".mat")]


def test_all_writes_every_format(run, tmp_path, capsys):
    for name in ("mcap", "onnx"):
        pytest.importorskip(name, reason=f"needs the package {name}")
    assert main(["export", str(run), "--to", "all", "--boat", "heron1", "--out", str(tmp_path)]) == 0
    planar = sum(each.planar is not None for each in FORMATS.values())
    assert len(capsys.readouterr().out.split()) == len(FORMATS) + planar == 10


def test_all_leaves_out_what_is_not_there(run, tmp_path, capsys):
    folder = run / "checkpoints" / "heron1"
    alone = tmp_path / "alone.safetensors"
    alone.write_bytes(checkpoints(folder)[-1].read_bytes())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert main(["export", str(alone), "--to", "all"]) == 0
    said = [str(each.message) for each in caught]
    assert any("csv of heron1 is left out: " in each and "found no predictions" in each for each in said), said
    printed = capsys.readouterr().out.split()
    assert str(tmp_path / "export" / "heron1.json") in printed and not any(each.endswith(".csv") for each in printed)


def test_boats_whose_files_would_have_one_name_are_not_mixed(run, tmp_path, told):
    for name, boat in (("a b", "heron1"), ("A_b", "heron2")):
        leaves, facts = checkpoint.load(checkpoints(run / "checkpoints" / boat)[-1])
        checkpoint.save(
            tmp_path / "checkpoints" / name / "00000_0000001.safetensors", leaves, **{**facts, "boat": name}
        )
    assert "found A_b and a b, whose files would have one name" in told(tmp_path, "--to", "json")
    assert not (tmp_path / "export").exists()


def test_a_long_name_is_cut(run, tmp_path, capsys):
    leaves, facts = checkpoint.load(checkpoints(run / "checkpoints" / "heron1")[-1])
    for k, name in enumerate(("x" * 5000, "\u65e5" * 300)):
        path = checkpoint.save(tmp_path / f"{k}.safetensors", leaves, **{**facts, "boat": name})
        assert main(["export", str(path), "--to", "json,c", "--out", str(tmp_path / f"out{k}")]) == 0
        assert len(list((tmp_path / f"out{k}").iterdir())) == 2


@pytest.mark.parametrize("package", ["mcap", "onnx"])
def test_a_missing_package_names_the_extra_and_leaves_nothing(run, tmp_path, told, monkeypatch, package):
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.setitem(sys.modules, f"{package}.writer", None)
    assert "pip install 'usvlearn[export]'" in told(run, "--to", f"json,{package}", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bad_input_is_told_in_one_sentence(run, tmp_path, told):
    assert "did you mean json?" in told(run, "--to", "jsn")
    assert "there is no such file or folder" in told(tmp_path / "none", "--to", "c")
    assert f"give {run}" in told(run.parent, "--to", "c")
    assert "expected one of heron1, heron2" in told(run, "--to", "c", "--boat", "anna")
    (tmp_path / "text.safetensors").write_text("no checkpoint")
    assert "text.safetensors" in told(tmp_path / "text.safetensors", "--to", "c")
    alone = Online(AID(28.0)).save(tmp_path / "aid.safetensors")
    assert "found no joint EKF with estimate_every" in told(alone, "--to", "c")
    alone.write_bytes(checkpoints(run / "checkpoints" / "heron1")[-1].read_bytes())
    assert "found no predictions of heron1" in told(alone, "--to", "csv")


def test_a_foreign_name_of_a_boat_leads_nowhere_else(run, tmp_path, capsys):
    leaves, facts = checkpoint.load(checkpoints(run / "checkpoints" / "heron1")[-1])
    path = checkpoint.save(tmp_path / "a.safetensors", leaves, **{**facts, "boat": "../../evil */ int x;"})
    assert main(["export", str(path), "--to", "c,json,mat,casadi", "--out", str(tmp_path / "out")]) == 0
    files = [each for each in tmp_path.rglob("*") if each.is_file() and each != path]
    assert len(files) == 4 and all(each.parent == tmp_path / "out" for each in files)


def test_a_filter_that_diverged_is_no_boat(run, tmp_path, told):
    leaves, facts = checkpoint.load(checkpoints(run / "checkpoints" / "heron1")[-1])
    broken = {
        name: leaf * float("nan") if name == "members.joint_averaged.mean" else leaf for name, leaf in leaves.items()
    }
    path = checkpoint.save(tmp_path / "a.safetensors", broken, **facts)
    assert "The filter has diverged" in told(path, "--to", "c")


def test_a_boat_that_is_not_physical_is_written_by_force_only(run, boat, tmp_path, told, monkeypatch):
    wrong = boat._replace(identified=dataclasses.replace(boat.identified, unphysical="It goes astern."))
    monkeypatch.setattr(export, "read_boats", lambda *_: [wrong])
    said = told(run, "--to", "json", "--out", tmp_path)
    assert said == f"error: {boat.name}: It goes astern. To write it all the same, add --force."
    assert not list(tmp_path.iterdir())
    assert main(["export", str(run), "--to", "json", "--out", str(tmp_path), "--force"]) == 0
    assert (tmp_path / f"{boat.name}.json").exists()
