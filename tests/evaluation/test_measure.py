"""What is minimised: errors of the next step, of forecasts, or of free runs; by a run, by lanes, and by the command."""

import json
import subprocess

import numpy as np
import pytest
import torch

from tests.support.commands import ENVIRONMENT, QUICK, command, results
from tests.support.configured import request
from usvlearn import AID, Average, Ensemble, Forecasts, Persistence, rollout
from usvlearn.errors import ConfigError
from usvlearn.evaluation.measure import Measure, check_measure, free_mae, measure_of, middle
from usvlearn.logs.recordings import align_fleet
from usvlearn.rollouts import simulate, tensors
from usvlearn.signals import masks
from usvlearn.simulate.fleet import fleet as simulated
from usvlearn.tuning.lanes import Objective, fleet_mae


@pytest.fixture(scope="module")
def fleet():
    return align_fleet(simulated(n=2, hours=0.15, mission_minutes=3.0, seed=4))


@pytest.mark.parametrize(
    "output", ["ensemble.forecast", "ensemble.forecast.x", "ensemble.forecast.-1", "ensemble.loose", "ensemble."]
)
def test_an_output_of_another_form(output):
    with pytest.raises(ConfigError, match=r"output: found .*, expected RULE, RULE.forecast.SECONDS or RULE.free"):
        measure_of(output)


def test_what_is_measured_must_be_made(fleet):
    ensemble = Ensemble({"aid": AID(28.0)}, forecasts=Forecasts((2.0, 10.0)))
    check_measure(measure_of("average.forecast.10"), ensemble, fleet)
    with pytest.raises(ConfigError, match=r"a forecast over 5 s, expected one of forecasts.horizons: 2, 10"):
        check_measure(measure_of("average.forecast.5"), ensemble, fleet)
    with pytest.raises(ConfigError, match="there are none"):
        check_measure(measure_of("average.forecast.5"), Ensemble({"aid": AID(28.0)}), fleet)
    check_measure(measure_of("average.free"), ensemble, fleet)
    with pytest.raises(ConfigError, match="found free runs, and too few logs of heron1"):
        check_measure(measure_of("average.free"), ensemble, fleet._replace(runs=fleet.runs[:1]))


def test_lanes_measure_forecasts_as_an_ensemble_makes_them(fleet):
    build = request("grid=aid").build
    found = Objective(build, fleet, measure=Measure("", "forecast", 2.0))([{"gain": 0.1}, {"gain": 3.0}])
    for each in found:
        ensemble = Ensemble({"aid": build(each.setting)}, {"own": Average()}, forecasts=Forecasts((2.0,)))
        total, count, state = np.zeros(2), np.zeros(2), ensemble.init((2,))
        for run in fleet.runs:
            with torch.no_grad():
                state, _, kept = rollout(
                    ensemble, state, tensors(run.samples, torch.float64), ["forecasts.predictions"]
                )
            own = kept["forecasts.predictions"][..., 0, 0].numpy()
            due = np.isfinite(own) & masks(run.samples).learns
            total += np.where(due, np.abs(own - run.samples.surge), 0.0).sum(0)
            count += due.sum(0)
        np.testing.assert_allclose(each.maes, total / count, rtol=1e-9)


def test_free_runs_are_of_later_runs_with_what_was_learned_before(fleet):
    aid, half = AID(28.0), middle(fleet.runs)
    found = fleet_mae(aid, fleet, measure=Measure("", "free"))
    ensemble = Ensemble({"aid": AID(28.0), "persistence": Persistence()}, {"own": Average(["aid"])})
    state, lone = ensemble.init((2,)), aid.init((2,))
    total, count = np.zeros(2), np.zeros(2)
    with torch.no_grad():
        for run in fleet.runs[:half]:
            samples = tensors(run.samples, torch.float64)
            state, lone = rollout(ensemble, state, samples)[0], rollout(aid, lone, samples)[0]
        for run in fleet.runs[half:]:
            free = simulate(aid, lone, tensors(run.samples, torch.float64))[1].numpy()
            learns = masks(run.samples).learns
            total += np.where(learns, np.abs(free - run.samples.surge), 0.0).sum(0)
            count += learns.sum(0)
    np.testing.assert_allclose(found, total / count, rtol=1e-9)
    whole = free_mae(ensemble, state, fleet, half)
    assert [row["aid"] for row in whole.values()] == pytest.approx((total / count).tolist())


def test_the_gradient_minimises_the_next_step_alone():
    with pytest.raises(ConfigError, match=r"output: found ensemble.free with learn=aid"):
        request("learn=aid", "output=ensemble.free")
    assert request("search=aid", "output=ensemble.forecast.10").measure == Measure("ensemble", "forecast", 10.0)


@pytest.mark.parametrize("output", ["ensemble.forecast.2", "ensemble.free"])
def test_a_run_ends_with_what_it_measures(output, tmp_path):
    arguments = [*QUICK, "data.mission_minutes=1", f"output={output}", "hydra.run.dir=run"]
    done = subprocess.run(command(*arguments), cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = results(tmp_path / "run")
    assert found["output"] == output and f"MAE of {output}: {found['objective']:.4f} m/s" in done.stdout
    rows = found["forecast"]["heron"]["ensemble"]
    expected = rows["2"]["mae"] if "forecast" in output else found["free"]["heron"]["ensemble"]
    assert found["objective"] == pytest.approx(expected)
    assert set(rows) == {"0.4", "1.2", "2", "5.2", "10", "30"} and json.dumps(found)
    assert "Forecasts: skill by horizon, s" in done.stdout
