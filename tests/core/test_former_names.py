"""Names that have changed are found under those of today, and what versions 0.1 and 0.2 have made is refused."""

import re
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from usvlearn import AID, Inputs, Online, Sample
from usvlearn.composition.configuration import check_settings
from usvlearn.core import checkpoint, former_names
from usvlearn.errors import CheckpointError
from usvlearn.runs.saved import configuration

OLD = [Path(__file__).parent / "data" / f"version_0_{k}.safetensors" for k in (1, 2)]


@pytest.mark.parametrize("path", OLD, ids=lambda path: path.stem)
@pytest.mark.parametrize("opened", [checkpoint.load, Online.open])
def test_a_checkpoint_of_before_is_refused_with_the_way_out(path, opened):
    version = path.stem[-3:].replace("_", ".")
    said = f"was made by usvlearn {version}, .*: open it with `pip install usvlearn=={version}`, or train again"
    with pytest.raises(CheckpointError, match=said):
        opened(path)


def test_a_run_of_before_is_refused(tmp_path):
    folder = tmp_path / "checkpoints" / "heron"
    folder.mkdir(parents=True)
    shutil.copy(OLD[1], folder / "00001_0000120.safetensors")
    with pytest.raises(CheckpointError, match=re.escape("pip install usvlearn==0.2")):
        configuration(tmp_path)


def test_the_number_of_the_format_decides(tmp_path, monkeypatch):
    for number, opens in {1: False, 2: True, 3: True, 4: False}.items():
        with monkeypatch.context() as patch:
            patch.setattr(checkpoint, "SCHEMA", number)
            path = checkpoint.save(tmp_path / "a.safetensors", {"theta": np.ones(2)}, version="0.2.0")
        if opens:
            assert checkpoint.load(path)[1]["schema"] == number
        else:
            with pytest.raises(
                CheckpointError,
                match="made by usvlearn" if number == 1 else "format 4, this version reads 2 and 3",
            ):
                checkpoint.load(path)


@pytest.mark.parametrize("name", former_names.TARGETS.values())
def test_every_name_of_today_is_a_class(name):
    module, _, attribute = name.rpartition(".")
    assert getattr(import_module(module), attribute).__name__ == attribute


def test_a_checkpoint_with_former_names_goes_on(tmp_path, monkeypatch):
    """As if the parameters θ and a setting of AID had been named otherwise."""
    online = Online(AID(mass=28.0))
    samples = [Sample(Inputs(0.5, 0.4, 0.1 * k, 0.01, 0.4), 1 + 0.01 * k, True, True) for k in range(4)]
    for each in samples[:3]:
        online.step(each)
    path = online.save(tmp_path / "a.safetensors")
    leaves, facts = checkpoint.load(path)
    facts["kernel"]["numbers"]["least"] = facts["kernel"]["numbers"].pop("dead_zone")
    checkpoint.save(path, {name.replace("theta", "parameters"): leaf for name, leaf in leaves.items()}, **facts)
    monkeypatch.setattr(former_names, "KEYS", {"parameters": "theta", "least": "dead_zone"})
    assert Online.open(path).step(samples[3]) == online.step(samples[3])


def test_a_configuration_and_a_boat_with_former_names_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(former_names, "KEYS", {"fleet": "data"})
    (old, new), *_ = former_names.TARGETS.items()
    settings = {"data": {"reader": {"_target_": old}}, "estimators": {}, "combiners": {}, "align": {}, "tuning": {}}
    cfg = OmegaConf.create(settings)
    check_settings(cfg)
    assert cfg.data.reader._target_ == new
    assert former_names.today({"fleet": [old]}) == {"data": [new]}
