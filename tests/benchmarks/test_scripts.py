"""Each script of `benchmarks/` does on little data what its page says."""

import itertools
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support import few
from usvlearn.core.samples import Inputs, Sample

STEPS, TOP, NOISE = 400, 2.0, 0.01


@pytest.fixture
def without_gradients():
    with torch.no_grad():
        yield


def test_the_overview_compares_with_its_history(monkeypatch, tmp_path, capsys):
    import history
    import overview

    took, days, real = [2.0], itertools.count(1), overview.this_run

    def section(amount, logs):
        figures = [history.timed("speed: aid", [took[0] * each for each in (0.99, 1.0, 1.01)], "C")]
        return [*figures, history.Figure("accuracy: heron", 0.6, "MAE of persistence")]

    monkeypatch.setattr(overview, "SECTIONS", {"speed": section})
    monkeypatch.setattr(overview, "FOLDER", tmp_path)
    monkeypatch.setattr(overview, "this_run", lambda effort: real(effort)._replace(date=f"2026-01-0{next(days)}"))
    assert overview.main(["--check"]) == 0 and "Nothing to compare with." in capsys.readouterr().out
    took[0] = 2.1
    assert overview.main(["--check"]) == 0 and "No figure is worse, of 2" in capsys.readouterr().out
    took[0] = 2.6
    assert overview.main(["--check"]) == 1
    assert "| speed: aid | 2.60 | C | 1 % | 2 | +24 % | +27 % | 10 % | **worse** |" in capsys.readouterr().out
    (tmp_path / "history.csv").write_text("<html>\n")
    with pytest.raises(SystemExit):
        overview.main([])
    assert "history.csv, line 1: expected date," in capsys.readouterr().err


@pytest.mark.slow
def test_a_quick_overview_measures_all(tmp_path):
    import history
    import overview

    assert overview.main(["--quick", "--folder", str(tmp_path)]) == 0
    names = [entry.figure.name for entry in history.read(tmp_path / "history.csv")]
    assert {name.partition(":")[0] for name in names} == set(overview.SECTIONS) and len(names) == len(set(names))


@pytest.mark.thorough
def test_speed_has_its_sections(without_gradients):
    import speed

    tiny = speed.Effort(2, 40, 5, 20, (0.05, 0.1), 3, 2)
    text = speed.page(tiny, ["others", "jobs"])
    assert "| 3 settings of one aid × 0.1 h |" in text and "| ours, RLS |" in text
    assert speed.ratio([1.0, 10.0, 300.0], [1.0, 5.0, 100.0]) == 2.0


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["aid", "sift", "joint, n = 16", "rnn, n = 20"])
def test_the_reference_in_c_is_the_estimator(name, without_gradients):
    import reference
    import speed

    if reference.compiler() is None:
        pytest.skip("the machine has no C compiler, neither gcc nor cc")
    estimator, samples = speed.estimators()[name], speed.samples(1000)
    from usvlearn import rollout

    predictions = rollout(estimator, estimator.init(), samples, backend="torch")[1]
    in_c = torch.from_numpy(reference.reference(estimator, samples)())
    assert float((in_c - predictions).abs().max()) <= 1e-9 * float(predictions.abs().max())


@pytest.mark.thorough
def test_accuracy_and_forecasts_are_of_the_second_half():
    import accuracy
    import forecast

    log = accuracy.simulated(("heron",), "data.hours=0.5")[0]
    scores = accuracy.second_half(log)
    assert scores.ensemble < scores.persistence and scores.free_ensemble < scores.free_squares
    scores = forecast.by_horizon(log)
    assert scores[2]["skill"] > 0.3 and 0.7 < scores[2]["covers"] <= 1 and scores[0]["steps"] > 100


@pytest.mark.thorough
def test_tracks_are_better_than_a_constant_turn():
    import path

    boat = path.boat("simulated", ("data=planar", "data.n=1", "data.hours=0.5"), False)
    assert boat.rows(2)[:, path.ERROR].mean() < boat.rows(2)[:, path.CONSTANT].mean()
    assert "| simulated | 10 s |" in "\n".join(path.coverage([boat]))


@pytest.mark.parametrize("name", few(("outliers", "nan", "thruster", "outage"), ("nan",), "thorough"))
def test_under_stress_ours_stay_finite_and_plain_rls_does_not(name, without_gradients):
    import stress

    case = stress.scenarios(60, elements=2)[name]
    for row, estimator in stress.ours().items():
        assert stress.run_ours(case, estimator).finite, row
    assert stress.run_peer(case, stress.peers(stress.excitation(case))["plain_rls"]).finite == (name != "nan")
    error = stress.true_model(case).error
    assert 0.7 * math.sqrt(2 / math.pi) * stress.NOISE < error < 1.3 * 2 / math.sqrt(math.pi) * stress.NOISE


@pytest.mark.thorough
def test_a_loss_of_thrust_is_answered():
    import faults

    given = {"plants": ("heron",), "peers": {"RLS": faults.plain_rls}, "drives": ("random",)}
    ((_, _, event, reply),) = faults.answers(5, 2, ("left 0%",), **given)
    assert np.isfinite(reply.delay).all() and faults.cells(event, reply)["side right"] == "100%"
    assert faults.ratio(reply, "RLS") > faults.ratio(reply, "joint") > 0.8


@pytest.mark.thorough
def test_every_method_fits_a_boat(without_gradients):
    import fit
    import identify

    one = next(fit.study("heron", 7001, n=1, hours=0.5, later=0.2))
    for method in (fit.FIT, fit.BATCH):
        assert all(abs(fit.wrong(one, method, name)) < 0.25 for name in fit.AIMS), method
    assert one.free[fit.FIT] < 1.15 * one.free[fit.BATCH] < one.free[fit.SQUARES]
    assert f"| {fit.FIT} |" in "\n".join(fit.accuracy_table([one]))
    assert len(one.noted) == len(fit.AFTER) and f"| {fit.ADAPTIVE} |" in identify.page([one], 7001)


def linear_boat(seed: int) -> Sample:
    """v' = −v/2 + ξ_L/2 + ξ_R/2, whose speed is measured with noise."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(0, 1, (STEPS // 8, 2)), 8, axis=0)
    speed, keep = np.zeros(STEPS), np.exp(-0.5 * 0.4)
    for k in range(1, STEPS):
        speed[k] = keep * speed[k - 1] + (1 - keep) * commands[k].sum()
    dt, yes = np.where(np.arange(STEPS) == 0, 0.0, 0.4), np.ones(STEPS, bool)
    inputs = Inputs(*commands.T.copy(), 0.1 * rng.standard_normal(STEPS).cumsum(), np.zeros(STEPS), dt)
    return Sample(inputs, speed + NOISE * rng.standard_normal(STEPS), yes, yes.copy())


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")  # of other libraries
@pytest.mark.parametrize("name", ["physics", "narmax", "state_space", "gru", "echo_state"])
def test_a_batch_peer_learns_a_linear_boat(name):
    from peers import echo_state, gru, narmax, physics, state_space
    from peers.batch import free_run_errors, targets

    learned = [linear_boat(0), linear_boat(1)]
    try:
        model = {
            "narmax": lambda: narmax.one(learned, lags=1, degree=1, terms=4, heading=False, noise=True),
            "state_space": lambda: state_space.one(learned, top=TOP, hidden=1, penalty=1e-5, heading=False, adam=100,
                                                   lbfgs=60),
            "gru": lambda: gru.one(learned, top=TOP, units=8, heading=False, updates=100),
            "echo_state": lambda: echo_state.one(learned, TOP, radius=0.5, leak=0.5, penalty=1e-6, heading=False),
            "physics": lambda: physics.one(learned, top=TOP, cubic=False, current=False, lag=False),
        }[name]()  # fmt: skip
    except ModuleNotFoundError:
        pytest.skip("needs the extra bench")
    error, held = free_run_errors(model, [linear_boat(2)])
    assert error < (12 if name == "gru" else 4) * NOISE < held
    before, after = linear_boat(2), linear_boat(2)
    after.surge[201:] += 0.5  # no forecast is told a speed after its origin
    differs = model.forecast(before) != model.forecast(after)
    assert not differs[targets(before).origins <= 200].any()


@pytest.mark.slow
def test_a_day_over_moos_loses_nothing():
    code = "import live_soak as soak; day, *_ = soak.sail(0.2, 2); print(day.values.tolist() == soak.alone(0.2))"
    folder = Path(__file__).parents[2] / "benchmarks"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "True"


def test_the_gates_find_their_record():
    import gates

    assert gates.RECORD == Path(gates.__file__).with_suffix(".json") and gates.read().cases
