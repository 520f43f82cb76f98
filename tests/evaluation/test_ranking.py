"""By what a sweep is ranked: in the terminal, as CSV, on the HPARAMS page, and in what a job hands to Hydra."""

import json
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tests.support import ROOT
from tests.support.commands import hparams, load, never, run, table
from usvlearn.cli.sweep import jobs_of, note_of
from usvlearn.errors import ConfigError
from usvlearn.evaluation.objective import Measure, ranked_by
from usvlearn.sweeps.jobs import SweepNote, run_job
from usvlearn.sweeps.leaderboard import leaderboard


def found_by(**maes: float | None) -> dict:
    """Results of one boat; the output is `ensemble`."""
    return {"boats": {"heron": {name: {"mae": mae} for name, mae in maes.items()}}, "output": "ensemble",
            "measure": "ensemble.mae", "objective": maes["ensemble"], "seconds": 1.0}  # fmt: skip


SIZES = {"10": 0.05, "20": 0.03, "4": 0.11, "40": None}  # neurons -> MAE, m/s; the largest network diverges


def write_sweep(folder: Path, key: str, more: dict[str, str]) -> None:
    """Finished jobs in which the rnn, and `weighted` with it, depend on what is swept, and the ensemble does not."""
    for k, (value, mae) in enumerate(SIZES.items()):
        notes = folder / f"{k}" / ".hydra"
        notes.mkdir(parents=True)
        task = [f"{key}={value}", *(f"{name}={other}" for name, other in more.items())]
        (notes / "overrides.yaml").write_text(json.dumps(task))
        worst = None if mae is None else 0.2 - mae
        content = found_by(rnn=mae, weighted=worst, ensemble=0.02)
        (folder / f"{k}" / "results.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("key", "more", "by", "order"),
    [
        ("estimators.rnn.neurons", {}, "rnn", [1, 0, 2, 3]),
        ("+estimator@estimators.rnn", {"align.dt": "0.4"}, "rnn", [1, 0, 2, 3]),
        ("combiners.weighted.forgetting", {}, "weighted", [2, 0, 1, 3]),
        ("combiner@combiners.weighted", {}, "weighted", [2, 0, 1, 3]),
        ("align.inputs", {}, "ensemble", [0, 1, 2, 3]),
        ("estimators.gone.gain", {}, "ensemble", [0, 1, 2, 3]),
        ("estimators.rnn.neurons", {"output": "weighted"}, "rnn", [1, 0, 2, 3]),
    ],
)
def test_a_sweep_is_ranked_by_the_member_that_its_keys_name(tmp_path, capsys, key, more, by, order):
    write_sweep(tmp_path, key, more)
    assert leaderboard(tmp_path, load)
    text, rows = capsys.readouterr().out, table(tmp_path)
    assert [int(row["job"]) for row in rows] == order and {row["measure"] for row in rows} == {f"{by}.mae"}
    assert text.startswith(f"MAE of {by}, m/s" if by != "ensemble" else "MAE of each job's output, m/s")
    for row in rows:
        assert row["objective"] == row[f"mae/{by}"] and row["unit"] == "m/s"
    pages = hparams(tmp_path / "leaderboard").values()
    shown = np.sort([numbers["8 results/1 objective"] for _, numbers in pages if "8 results/1 objective" in numbers])
    known = [float(row["objective"]) for row in rows if row["objective"]]
    np.testing.assert_allclose(shown, np.sort(known), rtol=1e-6)
    for row in rows:  # what a job hands to Hydra is what ranks it
        folder = tmp_path / row["job"]
        saved, task = (folder / "results.json").read_text(), load(folder / ".hydra" / "overrides.yaml")
        (folder / "results.json").unlink()
        for work in (lambda _, folder=folder, saved=saved: (folder / "results.json").write_text(saved), never):
            handed = run_job(folder, {"all": row["job"]}, task, work, SweepNote(swept=(key,)))
            assert handed == pytest.approx(float(row["objective"] or "nan"), nan_ok=True)


def test_keys_of_several_members_rank_by_the_ensemble():
    assert ranked_by(None, ["estimators.rnn.neurons", "align.dt"], [found_by(rnn=0.1, ensemble=0.1)]) == Measure("rnn")
    assert ranked_by(None, ["estimators.rnn.neurons", "estimators.aid.gain"], []) is None
    removed = [found_by(rnn=0.1, ensemble=0.1), found_by(ensemble=0.2), {"error": "bad"}]
    assert ranked_by(None, ["~estimators.rnn"], removed) is None
    assert ranked_by(None, ["estimators.rnn.neurons"], removed[::2]) == Measure("rnn")  # whoever failed has no say
    assert ranked_by("average.free", ["estimators.rnn.neurons"], removed) == Measure("average", "free")


def test_another_objective_ranks_a_finished_sweep_anew(tmp_path, capsys):
    write_sweep(tmp_path, "estimators.rnn.neurons", {})
    assert leaderboard(tmp_path, load, "weighted")
    assert [int(row["job"]) for row in table(tmp_path)] == [2, 0, 1, 3]
    assert capsys.readouterr().out.startswith("MAE of weighted, m/s")
    with pytest.raises(ConfigError, match=r"objective: found rnn.free, which no finished job of .* has measured"):
        leaderboard(tmp_path, load, "rnn.free")


def test_the_swept_keys_are_those_with_several_values():
    """As Hydra notes a command: the keys of a file of configs/sweep, unless the command gives one value."""
    params = {"estimators.rnn.neurons": "4,10", "estimators.rnn.unroll": "1,2", "align.inputs": "mean"}
    task = ["estimators.rnn.unroll=1", "data.hours=0.3", "+estimator@estimators.x=aid,rls", "align.dt=range(1,3)",
            "~estimators.aid", "data.path={a: x, b: y}", "combiners.average.members=[aid,rnn]"]  # fmt: skip
    hydra = OmegaConf.create({"sweeper": {"params": params}, "overrides": {"task": task}})
    swept, sets = jobs_of(hydra)
    assert swept == ["estimators.rnn.neurons", "+estimator@estimators.x", "align.dt"]
    assert len(sets) == 8 and sets[0]["estimators.rnn.neurons"] == "4" and sets[-1]["align.dt"] == "2"
    assert {job["data.hours"] for job in sets} == {"0.3"} and {job["estimators.rnn.unroll"] for job in sets} == {"1"}


def test_the_default_of_a_swept_group_is_its_choice():
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        config = compose("train", [], return_hydra_config=True)
    keys = ["combiner@combiners.ensemble", "align.inputs", "combiners.ensemble.members", "output", "+new", "data"]
    note = note_of(config, keys)
    assert note.defaults["combiner@combiners.ensemble"] == "boa" and note.defaults["data"] == "simulated"
    assert note.defaults["align.inputs"] == "mean" and "+new" not in note.defaults
    assert note.defaults["combiners.ensemble.members"] == "[joint,joint_quick,arx,joint_averaged]"


@pytest.mark.thorough
@pytest.mark.parametrize("objective", ["rnn.loud", "[aid,rnn]", "aid,rnn"])
def test_a_bad_objective_ends_a_sweep_before_its_jobs(objective, tmp_path):
    done = run("-m", "align.inputs=mean,last", f"objective={objective}", "hydra.sweep.dir=sweep", folder=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: objective: found"), done.stderr
    assert len(done.stderr.splitlines()) == 1 and not (tmp_path / "sweep" / "0").exists()


def test_single_runs_are_ranked_by_their_own_objective(tmp_path, capsys):
    """As a sweep whose note is gone."""
    write_sweep(tmp_path, "estimators.rnn.neurons", {})
    for path in tmp_path.glob("*/results.json"):
        content = json.loads(path.read_text())
        path.write_text(json.dumps(content | {"measure": "weighted.mae"}))
    assert leaderboard(tmp_path, load)
    assert capsys.readouterr().out.startswith("MAE of weighted, m/s")
