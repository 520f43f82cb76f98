"""Files of runs and sweeps from somebody else: each is refused or passed over, and no link is followed."""

import json
import os
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.support.runs import forge, tools
from usvlearn.cli.sweep import load
from usvlearn.composition.configuration import instantiate
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.report.build import read
from usvlearn.runs.files import begun
from usvlearn.runs.saved import results, run_folders
from usvlearn.sweeps.leaderboard import leaderboard


@pytest.fixture
def copy(saved, tmp_path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "run"))


def sets(copy: Path) -> list[Path]:
    return sorted(copy.glob("checkpoints/*/*.safetensors"))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["00099_0000010", "00000_9999999", "00000_" + "9" * 200])
def test_a_set_of_no_step_of_the_runs_is_passed_over(copy, name):
    shutil.copy(sets(copy)[-1], sets(copy)[-1].with_stem(name))
    with pytest.warns(UserWarning, match="belongs to no step of the runs"):
        _, seasons = read([copy], tools())
    assert len(seasons[0].paths) == len(sets(copy)) - 1


@pytest.mark.parametrize("what", ["pipe", "device", "huge"])
def test_a_set_that_is_no_file_or_larger_than_the_memory_is_unreadable(tmp_path, what):
    path = tmp_path / "a.safetensors"
    match what:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case _:
            with path.open("wb") as file:
                file.truncate(1 << 43)  # takes no room
    with pytest.raises(CheckpointError, match="cannot be read"):
        checkpoint.load(path)


def change(path: Path, edit) -> None:
    with np.load(path) as archive:
        arrays = dict(archive)
    edit(arrays)
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    "edit",
    [
        lambda x: x.update(predictions=x["predictions"].astype("U8")),
        lambda x: x.update(predictions=x["predictions"].astype(complex)),
        lambda x: x.update(predictions=x["predictions"][..., :1]),
        lambda x: x.update(halfwidths=x["halfwidths"][:3]),
        lambda x: x.update(predictions=np.array(1.0)),
        lambda x: x.pop("predictions"),
    ],
)
def test_predictions_of_another_kind_or_shape_are_damage(copy, edit):
    path = next(copy.glob("predictions/*.npz"))
    change(path, edit)
    with pytest.warns(UserWarning, match="is damaged"):
        read([copy], tools())


def test_predictions_that_are_a_pipe_are_damage(copy):
    path = next(copy.glob("predictions/*.npz"))
    path.unlink()
    os.mkfifo(path)
    with pytest.warns(UserWarning, match="is damaged"):
        read([copy], tools())


@pytest.mark.parametrize(
    "text", ["[" * 200_000, '{"boats": {"heron": [["a", Infinity, "k"]]}}', '{"boats": {"heron": [["a", -5, "k"]]}}']
)
def test_a_list_of_runs_that_is_none_is_refused(copy, text):
    (copy / "runs.json").write_text(text)
    with pytest.raises(CheckpointError, match=r"runs\.json: is damaged"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read([copy], tools())
    begun(copy)  # of others that are looked through by resume=latest


def test_results_of_many_levels_are_refused(copy):
    (copy / "results.json").write_text("[" * 200_000)
    with pytest.raises(CheckpointError, match=r"results\.json: is damaged"):
        results(copy)


def test_no_number_of_a_run_is_so_large_that_the_next_cannot_be_written(copy):
    noted = json.loads((copy / "runs.json").read_text())
    noted["began"]["number"] = 10**4299
    (copy / "runs.json").write_text(json.dumps(noted))
    assert begun(run_folders(copy)[0])[0] == 0


@pytest.fixture
def sweep(saved, tmp_path) -> Path:
    """A sweep of two jobs."""
    for job in ("0", "1"):
        shutil.copytree(saved, tmp_path / "sweep" / job)
        (tmp_path / "sweep" / job / ".hydra" / "overrides.yaml").write_text(f"- estimators.aid.gain={job}\n")
    return tmp_path / "sweep"


@pytest.mark.parametrize("row", [False, True])
def test_a_leaderboard_removes_nothing_behind_a_link(sweep, tmp_path, row):
    file = tmp_path / "other" / "run" / "events.out.tfevents.1"
    file.parent.mkdir(parents=True)
    file.touch()
    if row:
        (sweep / "leaderboard").mkdir()
        (sweep / "leaderboard" / "row").symlink_to(file.parent)
        assert leaderboard(sweep, load)
    else:
        (sweep / "leaderboard").symlink_to(tmp_path / "other")
        with pytest.raises(ConfigError, match="is a link to another folder"):
            leaderboard(sweep, load)
    assert file.exists()


def test_a_leaderboard_prints_nothing_that_acts_on_a_terminal(sweep, capsys):
    (sweep / "0" / ".hydra" / "overrides.yaml").write_text('- "estimators.aid.gain=\\e[2J"\n')
    (sweep / "1" / "results.json").write_text('{"error": "\\u001b]0;x\\u0007"}')
    leaderboard(sweep, load)
    printed = capsys.readouterr().out
    assert "\x1b" not in printed and "\x07" not in printed and "\\x1b" in printed


@pytest.mark.parametrize(
    "text", ["a: &a [x, x]\nb: &b [*a, *a]\n", "!!python/object/apply:os.system [true]", "5", "{", "[" * 5000]
)
def test_settings_of_a_job_that_are_damaged_or_unfold_are_refused(tmp_path, text):
    path = tmp_path / "overrides.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"overrides\.yaml: is damaged"):
        load(path)


FORGERIES = {
    "an unknown option": lambda c: c["align"].update(evil=1),
    "an option twice": lambda c: c["align"].update(channels={}),
    "a list for a name": lambda c: c.update(output=["a"]),
    "data that are none": lambda c: c.update(data={"a": 1}),
    "an estimator for data": lambda c: c.update(
        data={"_target_": "usvlearn.estimators.baselines.persistence.layer.Persistence"}
    ),
    "one estimator for all": lambda c: c.update(estimators={"_target_": "usvlearn.estimators.aid.layer.AID"}),
    "a size beyond all measure": lambda c: c["estimators"].update(
        rnn={"_target_": "usvlearn.estimators.rnn.layer.RNN", "neurons": 10**9}
    ),
    "a grid too fine": lambda c: c["align"].update(dt=1e-9),
    "hours without end": lambda c: c["data"].update(hours=1e300),
}


@pytest.mark.parametrize("edit", FORGERIES.values(), ids=FORGERIES)
def test_settings_of_allowed_classes_that_make_no_sense_are_one_sentence(copy, edit):
    forge(copy, edit)
    with pytest.raises((CheckpointError, ConfigError)) as caught:
        read([copy], tools()._replace(instantiate=instantiate))
    assert len(str(caught.value)) < 1000
