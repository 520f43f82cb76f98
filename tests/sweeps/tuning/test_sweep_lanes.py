"""The jobs of a sweep as lanes: the leaderboard of jobs, up to rounding, and a reason where it is not possible."""

import json

import numpy as np
import pytest

from tests.support.commands import QUICK, load, run, table
from usvlearn.cli.composition import compose_train, plain
from usvlearn.cli.settings import instantiate
from usvlearn.display.terminal import console
from usvlearn.errors import ConfigError
from usvlearn.logs.recordings import align_fleet
from usvlearn.sweeps.jobs import SweepNote
from usvlearn.sweeps.leaderboard import leaderboard
from usvlearn.sweeps.tuning.sweep_lanes import run_lanes, why_not

GAINS = ["-m", "estimators.aid.gain=0.3,1,3", "data.n=2", *QUICK, "data.mission_minutes=1", "hydra.sweep.dir=sweep"]


@pytest.mark.parametrize("objective", [None, pytest.param("aid.free", marks=pytest.mark.slow)])
def test_lanes_have_the_leaderboard_of_jobs(tmp_path, objective):
    more = [] if objective is None else [f"objective={objective}"]
    more += ["seeds=2"] if objective is None else []
    found = {}
    for lanes in ("off", "auto"):
        folder = tmp_path / lanes
        folder.mkdir()
        done = run(*GAINS, *more, f"sweep.lanes={lanes}", folder=folder)
        assert done.returncode == 0, done.stderr
        assert (folder / "sweep" / "lanes.json").exists() == (lanes == "auto")
        found[lanes] = table(folder / "sweep")
    assert len(found["off"]) == 3 and {row["measure"] for row in found["off"]} == {objective or "aid.mae"}
    for ours, theirs in zip(found["auto"], found["off"], strict=True):
        for key in ("rank", "job", "estimators.aid.gain", "measure", "unit", "seeds", "reference", "tie", "error"):
            assert ours[key] == theirs[key], key
        for key in ("objective", "deviation", "difference", "low", "high"):
            numbers = [float(each[key] or "nan") for each in (ours, theirs)]
            assert numbers[0] == pytest.approx(numbers[1], rel=1e-6, abs=1e-12, nan_ok=True), key


def test_a_finished_sweep_of_lanes_is_shown_again_and_evaluated(tmp_path, capsys):
    first, again = (run(*GAINS, "sweep.lanes=auto", folder=tmp_path) for _ in range(2))
    assert first.returncode == again.returncode == 0 and "finished before: sweep" in again.stdout
    assert leaderboard(tmp_path / "sweep", load, "aid.skill")
    assert "skill of aid, mean over boats" in capsys.readouterr().out
    content = json.loads((tmp_path / "sweep" / "lanes.json").read_text())
    content["jobs"][1]["results"]["boats"] = {"heron": 3}
    (tmp_path / "sweep" / "lanes.json").write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=r"lanes\.json: is damaged \(boats: expected numbers"):
        leaderboard(tmp_path / "sweep", load)


REASONS = {
    "align.dt": (["align.dt"], {"align.dt": "0.4"}, {}, "the keys align.dt are not those of one member"),
    "two members": (["estimators.aid.gain", "estimators.rnn.rate"], {}, {}, "are not those of one member"),
    "a choice": (["estimators.aid.feedback"], {}, {}, "estimators.aid.feedback is no number that lanes can differ in"),
    "a size": (["estimators.rnn.neurons"], {"estimators.rnn.neurons": "4"}, {}, "estimators.rnn.neurons is no number"),
    "besides": (["estimators.aid.gain", "align.dt"], {}, {}, "align.dt is no hyperparameter of a member"),
    "a rule": (["combiners.ensemble.rate"], {}, {}, "are not those of one member"),
    "text": (["estimators.aid.gain"], {"estimators.aid.gain": "big"}, {}, "estimators.aid.gain=big is no number"),
    "objective": (["estimators.aid.gain"], {}, {"objective": "ensemble"}, "objective is ensemble.mae, no error of aid"),
    "coverage": (["estimators.aid.gain"], {}, {"objective": "aid.coverage"}, "the objective is aid.coverage"),
    "tuning": (["estimators.aid.gain"], {}, {"grid": "aid"}, "grid is set"),
    "nothing": ([], {}, {}, "are not those of one member"),
}  # fmt: skip


@pytest.mark.parametrize("case", REASONS)
def test_what_cannot_be_lanes(case):
    swept, job, changes, reason = REASONS[case]
    settings = plain(compose_train([], changes))
    note = SweepNote(tuple(swept), {}, changes.get("objective"))
    assert reason in why_not(settings, note, [dict.fromkeys(swept, "1") | job], instantiate)


def test_networks_as_lanes_have_verdicts():
    settings = plain(compose_train(["data.hours=0.05", "estimators.rnn.neurons=4"]))
    jobs = [{"estimators.rnn.contraction_rate": k} for k in ("0.5", "0.99")]
    note = SweepNote(("estimators.rnn.contraction_rate",))
    assert why_not(settings, note, jobs, instantiate) == ""
    made = run_lanes(settings, note, jobs, instantiate, align_fleet, console(quiet=True))
    rates = [each.results["network"]["heron"]["rnn"]["rate"] for each in made]
    assert rates[0] <= 0.5 < rates[1] <= 0.99
    assert [each.overrides for each in made] == [[f"estimators.rnn.contraction_rate={k}"] for k in ("0.5", "0.99")]
    assert len({each.results["boats"]["heron"]["persistence"]["mae"] for each in made}) == 1
    assert np.isfinite([each.results["objective"] for each in made]).all()


def test_an_illegal_value_is_told(tmp_path):
    done = run("-m", "estimators.aid.gain=1,-1", *QUICK, "hydra.sweep.dir=sweep", "sweep.lanes=auto", folder=tmp_path)
    assert done.returncode == 2 and "estimators.aid.gain: found -1.0, expected a positive number" in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "sweep" / "lanes.json").exists()
    done = run("-m", "estimators.aid.gain=1,2", "sweep.lanes=yes", folder=tmp_path)
    assert done.returncode == 2 and "sweep.lanes: found 'yes', expected one of off, auto" in done.stderr
