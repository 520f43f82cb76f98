"""The objective, by a run, by batch elements and by the command; and simulations with what was saved before."""

import json
import math

import numpy as np
import pytest
import torch

from tests.support.commands import QUICK, results
from tests.support.commands import run as run_command
from tests.support.configured import request
from tests.support.seasons import boats
from usvlearn import AID, Average, Ensemble, ForecastSettings, Persistence, rollout
from usvlearn.core.samples import masks
from usvlearn.engine.rollouts import simulate, tensors
from usvlearn.errors import ConfigError
from usvlearn.evaluation.comparison import from_csv
from usvlearn.evaluation.free_simulation import free_errors, free_runs, middle
from usvlearn.evaluation.objective import Measure, check_measure, measure_of
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.fleet import fleet as simulated
from usvlearn.sweeps.tuning.batches import Objective, element_errors


@pytest.fixture(scope="module")
def fleet():
    return align_fleet(simulated(n=2, hours=0.15, mission_minutes=3.0, seed=4))


@pytest.mark.parametrize(
    "objective",
    ["rnn.forecast", "rnn.forecast.x", "rnn.forecast.-1", "rnn.forecast.inf", "rnn.loose", "rnn.mae.10", ".free", ""],
)
def test_an_objective_of_another_form(objective):
    with pytest.raises(ConfigError, match=r"objective: found '.*', expected MEMBER or MEMBER\.KIND, KIND one of mae, "):
        measure_of(objective, "ensemble")


@pytest.mark.parametrize("text", ["rnn.mae", "rnn.skill", "rnn.coverage", "rnn.free", "rnn.forecast.5.2"])
def test_an_objective_is_written_as_it_is_read(text):
    assert str(measure_of(text, "ensemble")) == text


RESULTS = {
    "boats": {"a": {"rnn": {"mae": 0.1, "skill": 0.5, "coverage": 0.8}},
              "b": {"rnn": {"mae": 0.3, "skill": 0.1, "coverage": 0.9}}},
    "forecast": {"a": {"rnn": {"10": {"mae": 0.5}}}, "b": {"rnn": {"10": {"mae": 0.7}, "30": {"mae": None}}}},
    "free": {"a": {"rnn": 0.25}, "b": {"rnn": 0.75}},
}  # fmt: skip


@pytest.mark.parametrize(
    ("objective", "value", "loss"),
    [
        ("rnn", 0.2, 0.2), ("rnn.skill", 0.3, -0.3), ("rnn.coverage", 0.85, 0.05), ("rnn.free", 0.5, 0.5),
        ("rnn.forecast.10", 0.6, 0.6), ("rnn.forecast.30", None, math.inf), ("gone", None, math.inf),
        ("gone.free", None, math.inf),
    ],
)  # fmt: skip
def test_the_value_of_an_objective_is_that_of_the_results(objective, value, loss):
    measure = measure_of(objective, "ensemble")
    assert measure.value(RESULTS) == (None if value is None else pytest.approx(value))
    assert measure.loss(measure.value(RESULTS)) == pytest.approx(loss)
    if measure.kind in ("free", "forecast"):  # of an older run
        assert measure.value({"boats": RESULTS["boats"]}) is None


def test_what_is_measured_must_be_made(fleet):
    ensemble = Ensemble(
        {"aid": AID(28.0), "slow": AID(28.0, 0.1)}, forecasts=ForecastSettings((2.0, 10.0), members=["aid"])
    )
    for objective in ("average.forecast.10", "aid.forecast.2", "slow.skill", "average.free", None):
        check_measure(measure_of(objective, "average"), ensemble, fleet)
    wrong = {
        "average.forecast.5": r"a forecast over 5 s, expected one of forecasts.horizons: 2, 10",
        "slow.forecast.2": r"forecasts of slow, which makes none: add it to forecasts.members",
        "slwo": r"found 'slwo', expected one of aid, slow, average: did you mean slow\?",
    }
    for objective, sentence in wrong.items():
        with pytest.raises(ConfigError, match=sentence):
            check_measure(measure_of(objective, "average"), ensemble, fleet)
    with pytest.raises(ConfigError, match="there are none"):
        check_measure(measure_of("average.forecast.5", ""), Ensemble({"aid": AID(28.0)}), fleet)
    with pytest.raises(ConfigError, match="found open-loop simulations, and too few logs of heron1"):
        check_measure(measure_of("average.free", ""), ensemble, fleet._replace(runs=fleet.runs[:1]))


def test_elements_measure_forecasts_as_an_ensemble_makes_them(fleet):
    build = request("grid=aid").build
    evaluated = Objective(build, fleet, measure=Measure("", "forecast", 2.0))([{"gain": 0.1}, {"gain": 3.0}])
    for each in evaluated:
        ensemble = Ensemble({"aid": build(each.setting)}, {"own": Average()}, forecasts=ForecastSettings((2.0,)))
        total, count, state = np.zeros(2), np.zeros(2), ensemble.init((2,))
        for run in fleet.runs:
            with torch.no_grad():
                state, _, record = rollout(
                    ensemble, state, tensors(run.samples, torch.float64), ["forecasts.predictions"]
                )
            forecast = record["forecasts.predictions"][..., 0, 0].numpy()
            due = np.isfinite(forecast) & masks(run.samples).learns
            total += np.where(due, np.abs(forecast - run.samples.surge), 0.0).sum(0)
            count += due.sum(0)
        np.testing.assert_allclose(each.maes, total / count, rtol=1e-9)


def test_free_runs_are_of_later_runs_with_what_was_learned_before(fleet):
    aid, half = AID(28.0), middle(fleet.runs)
    maes = element_errors(aid, fleet, measure=Measure("", "free")).mae
    ensemble = Ensemble({"aid": AID(28.0), "persistence": Persistence()}, {"own": Average(["aid"])})
    state, lone = ensemble.init((2,)), aid.init((2,))
    total, count = np.zeros(2), np.zeros(2)
    by_boat: list[list[np.ndarray]] = [[], []]
    with torch.no_grad():
        for run in fleet.runs[:half]:
            samples = tensors(run.samples, torch.float64)
            state, lone = rollout(ensemble, state, samples)[0], rollout(aid, lone, samples)[0]
        for run in fleet.runs[half:]:
            free = simulate(aid, lone, tensors(run.samples, torch.float64))[1].numpy()
            learns = masks(run.samples).learns
            total += np.where(learns, np.abs(free - run.samples.surge), 0.0).sum(0)
            count += learns.sum(0)
            for element, pairs in enumerate(by_boat):
                pairs.append(np.stack([free[:, element], run.samples.surge[:, element]])[:, learns[:, element]])
    np.testing.assert_allclose(maes, total / count, rtol=1e-9)
    free = free_errors(ensemble, state, fleet, half)
    whole, fits = free.mae(fleet.boats, ensemble.names), free.fit(fleet.boats, ensemble.names)
    assert [row["aid"] for row in whole.values()] == pytest.approx((total / count).tolist())
    for row, pairs in zip(fits.values(), by_boat, strict=True):
        simulated, y = np.concatenate(pairs, 1)
        expected = 100 * (1 - np.linalg.norm(y - simulated) / np.linalg.norm(y - y.mean()))
        assert row["aid"] == pytest.approx(expected, rel=1e-7)


@pytest.mark.thorough
def test_tuning_minimises_an_error_of_its_member():
    with pytest.raises(ConfigError, match=r"objective: found aid.free with learn=aid"):
        request("learn=aid", "objective=aid.free")
    with pytest.raises(ConfigError, match=r"objective: found rnn.mae with grid=aid, expected aid or aid.KIND"):
        request("grid=aid", "objective=rnn")
    with pytest.raises(ConfigError, match=r"objective: found aid.coverage with grid=aid, expected one of its errors"):
        request("grid=aid", "objective=aid.coverage")
    assert request("search=aid", "objective=aid.forecast.10").measure == Measure("aid", "forecast", 10.0)
    assert request("search=aid").measure == Measure("aid")


@pytest.mark.thorough
@pytest.mark.parametrize("objective", ["aid.forecast.2", pytest.param("ensemble.free", marks=pytest.mark.slow)])
def test_a_run_ends_with_what_it_measures(objective, tmp_path):
    arguments = [*QUICK, "data.mission_minutes=1", f"objective={objective}", "hydra.run.dir=run"]
    done = run_command(*arguments, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    saved = results(tmp_path / "run")
    assert saved["output"] == "ensemble" and saved["measure"] == objective
    measure = measure_of(objective, "")
    assert f"{measure.title()} {saved['objective']:.4f} m/s; " in done.stdout
    rows = saved["forecast"]["heron"]["aid"]
    expected = rows["2"]["mae"] if "forecast" in objective else saved["free"]["heron"]["ensemble"]
    assert saved["objective"] == pytest.approx(expected)
    assert set(rows) == {"0.4", "1.2", "2", "5.2", "10", "30"} and json.dumps(saved)
    assert "Forecasts: skill by horizon, s" in done.stdout
    errors = from_csv((tmp_path / "run" / "errors.csv").read_text())
    for ahead, mae in {"step": saved["boats"]["heron"]["aid"]["mae"], "2": rows["2"]["mae"],
                       "free": saved["free"]["heron"]["aid"]}.items():  # fmt: skip
        some = [each for each in errors if each.ahead == ahead]
        total = sum(each.steps * each.mae["aid"] for each in some) / sum(each.steps for each in some)
        assert total == pytest.approx(mae) and {each.boat for each in some} == {"heron"}
    assert len({each.run for each in errors if each.ahead == "step"}) == 3
    assert len({each.run for each in errors if each.ahead == "free"}) == 2  # the second half


def test_the_newest_set_that_has_not_learned_from_a_run_is_taken():
    _, (season,) = boats(np.ones((1, 9)))
    assert [season.checkpoint_before(k) for k in range(2)] == [(0, True), (0, False)]
    several = season._replace(saved_in=np.array([0, 0, 1, 1]))
    assert [several.checkpoint_before(k) for k in range(2)] == [(0, True), (1, False)]
    other = season._replace(saved_in=np.array([-1, -1]))  # sets of other logs
    assert [other.checkpoint_before(k) for k in range(2)] == [(1, False), (1, False)]


def test_a_boat_without_noise_is_simulated_as_it_moved():
    ensemble, (season,) = boats(np.ones((1, 9)))
    first, second = free_runs(ensemble, season)
    assert (first.learned, second.learned) == (True, False)
    run, column = season.runs[1], ensemble.names.index("rls")
    assert np.isnan(second.predictions[0]).all()  # no step is made there
    error = np.abs(second.predictions[1:, column] - run.samples.surge[1:])
    assert error.max() < 0.02 < run.samples.surge.std()  # of an exact model, learned from the first run
    spoiled = season.runs[1]._replace(
        samples=run.samples._replace(surge=np.append(run.samples.surge[:1], np.ones(199)))
    )
    again = list(free_runs(ensemble, season._replace(runs=(season.runs[0], spoiled))))[1]
    assert np.array_equal(again.predictions, second.predictions, equal_nan=True)  # it sees the first speed alone
