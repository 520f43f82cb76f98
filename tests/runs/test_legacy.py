"""Runs of versions 0.1 and 0.2, whose settings name what has moved since: they are opened, judged and gone on from.

Both were made with these settings:

    data.hours=0.03 data.mission_minutes=1 data.seed=3 save_minutes=0.5 estimators.rnn.neurons=3

by version 0.1.0, with the addition

    data.hulls=7 ~estimators.memory_aid ~estimators.memory_rls ~estimators.steady_rls ~combiners.weighted
    ~combiners.ensemble.prior.memory_rls

and by version 0.2.0, with

    data.fleet_seed=7 ~estimators.arx ~estimators.joint_quick ~estimators.sift_map ~combiners.average
    ~combiners.weighted combiners.ensemble.members=[aid,reader,joint] forecasts.members=[aid,joint]
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from tests.support import ROOT, few
from tests.support.commands import run
from usvlearn import AID, Inputs, Online, Robust, Sample
from usvlearn.cli.settings import instantiate
from usvlearn.cli.settings import instantiate as instantiate_settings
from usvlearn.cli.train import train
from usvlearn.core import checkpoint
from usvlearn.errors import ConfigError
from usvlearn.runs.legacy import TARGETS, current
from usvlearn.runs.saved import configuration

RUN, RUN_2 = (ROOT / "tests" / "data" / f"run_of_version_0_{k}" for k in (1, 2))
NEWEST = Path("checkpoints", "heron", "00001_0000120.safetensors")
FOUND = {  # by the version that has made the run
    RUN: [0.6336783731641761, 1.2476286769282514, 1.2902282720963953, 1.2279661703830946],
    RUN_2: [0.6503927146062585, 1.1846265088143606, 1.2948220308549834, 1.359218645458605],
}


def samples():
    return [Sample(Inputs(0.5, 0.4, 0.1 * k, 0.01, 0.4), 1 + 0.01 * k, True, True) for k in range(4)]


@pytest.mark.parametrize("run", FOUND, ids=lambda run: run.name)
def test_its_checkpoint_goes_on_aboard(run):
    boat = Online.open(run / NEWEST)
    np.testing.assert_allclose([boat.step(sample) for sample in samples()], FOUND[run], rtol=1e-12)


def test_its_settings_make_the_same_estimators():
    settings = configuration(RUN)
    estimators = instantiate(settings["estimators"])
    assert isinstance(estimators["aid"], AID) and isinstance(estimators["dynamic_rls"], Robust)
    assert settings["data"]["fleet_seed"] == 7 and "hulls" not in settings["data"]


@pytest.mark.parametrize("old, new", TARGETS.items())
def test_every_target_of_before_has_a_name_of_today(old, new):
    module, _, name = new.rpartition(".")
    assert getattr(__import__(module, fromlist=[name]), name).__name__ == name
    assert current([{"_target_": old, "inner": {"_target_": old}}]) == [{"_target_": new, "inner": {"_target_": new}}]


def test_an_old_name_in_a_file_tells_the_new_one():
    with pytest.raises(ConfigError, match=r"found '.*Forecasts', which is named '.*ForecastSettings' now"):
        instantiate_settings({"forecasts": {"_target_": "usvlearn.Forecasts"}})


@pytest.mark.thorough
@pytest.mark.parametrize("made", few(FOUND, [RUN]), ids=lambda run: run.name)
def test_it_is_judged(made, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(made, folder)
    done = run(f"runs={folder}", folder=tmp_path, script="evaluate.py")
    assert done.returncode == 0, done.stderr
    assert (folder / "report" / "index.html").exists()


NEWER = {  # arguments that version 0.1 did not have
    '"ambient": true': '"ambient": true, "cubic": false, "exponential": false',
    '"usvlearn.RNN"': '"usvlearn.RNN", "replay_size": 0, "replay_steps": 8',
}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "made, member", [(RUN, "rls"), (RUN, "sift_map"), (RUN_2, "reader"), (RUN_2, "joint_averaged")]
)
def test_it_continues_where_it_was_killed(made, member, tmp_path, monkeypatch):
    """By its own settings under the names of today, also of its members; it ends as it ended then.

    The last bits of simulated samples depend on the processor, so the samples count as those of then by their names.
    That they are the same to rounding shows at the end, where the learned parameters are.
    """
    (then,) = json.loads((made / "runs.json").read_text())["boats"].values()
    digests = {name: digest for name, _, digest in then}
    monkeypatch.setattr("usvlearn.runs.run_folder.digest", lambda run, element: digests[run.names[element]])
    folder, text = tmp_path / "run", json.dumps(configuration(made))
    for old, new in NEWER.items() if made == RUN else ():
        assert old in text
        text = text.replace(old, new)
    shutil.copytree(made, folder)
    for lost in ("results.json", "predictions/00001_0000120.npz", "checkpoints/heron/00001_0000120.safetensors"):
        (folder / lost).unlink()
    console, before = Console(record=True, width=200), {RUN: "rls", RUN_2: "reader"}[made]
    train(OmegaConf.create(json.loads(text.replace(f'"{before}"', f'"{member}"'))), folder, console, str(folder))
    assert "resuming after step 75 of run 2 of 2" in console.export_text()
    found, expected = (checkpoint.load(each / NEWEST)[0] for each in (folder, made))
    expected = {name.replace(f"members.{before}.", f"members.{member}."): leaf for name, leaf in expected.items()}
    assert found.keys() == expected.keys()
    for name, leaf in expected.items():
        if not name.startswith("monitors.thrusters."):  # the numbers of this monitor are those of this version
            np.testing.assert_allclose(found[name], leaf, rtol=1e-9, atol=1e-12, err_msg=name)
