"""Forecasts of a plan online: their intervals, and what is refused."""

import math

import numpy as np
import pytest
import torch

from tests.support.forecasts import ensemble, plain
from usvlearn import AID, Ensemble, Inputs, Online, Sample, forecast, rollout
from usvlearn.errors import ConfigError, ShapeError


def test_online_forecasts_are_those_of_elements():
    model, samples = ensemble(), plain(50, 3)
    state = rollout(model, model.init((3,)), samples)[0]
    online, rng = Online(model, (3,)), np.random.default_rng(0)
    online.state = state
    commands, headings = rng.uniform(-1, 1, (12, 3, 2)), rng.uniform(-3, 3, (12, 3))
    ahead = online.forecast(commands, headings, 0.1, dt=0.4)
    left, right = (torch.from_numpy(np.ascontiguousarray(commands[..., k])) for k in (0, 1))
    psi = torch.from_numpy(headings)
    inputs = Inputs(left, right, psi, torch.full_like(psi, 0.1), torch.full_like(psi, 0.4))
    expected = forecast(model, state, inputs)
    np.testing.assert_allclose(ahead.surge, expected.surge, rtol=1e-12)
    np.testing.assert_allclose(ahead.high, expected.high, rtol=1e-12)
    assert ahead.time.tolist() == pytest.approx([0.4 * k for k in range(1, 13)])
    assert np.isfinite(ahead.low[:10]).all() and np.isinf(ahead.low[10:]).all()  # beyond the longest horizon of 4 s
    plain_torch = Online(model, (3,), backend="torch")
    plain_torch.state = state
    np.testing.assert_allclose(plain_torch.forecast(commands, headings, 0.1).surge, ahead.surge, rtol=1e-12)
    again = online.forecast(commands, headings, 0.1)
    np.testing.assert_array_equal(again.surge, ahead.surge)  # nothing was learned, and the state stays


def test_a_forecast_before_the_first_sample_has_no_interval(tmp_path):
    ahead = Online(ensemble()).forecast([[0.5, 0.5]] * 10, 0.0)
    assert np.isfinite(ahead.surge).all() and np.isinf(ahead.high).all() and np.isinf(ahead.low).all()
    boat, samples = Online(ensemble()), plain(60)
    calls = [
        Sample(Inputs(*(float(x[k]) for x in samples.inputs)), float(samples.surge[k]), True, True) for k in range(60)
    ]
    for each in calls:
        boat.step(each)
    assert np.isfinite(boat.forecast([[0.5, 0.5]] * 10, 0.0).high).all()
    opened = Online.open(boat.save(tmp_path / "a.safetensors"))  # nobody knows how long ago
    assert np.isinf(opened.forecast([[0.5, 0.5]] * 10, 0.0).high).all()
    opened.step(calls[-1])
    assert np.isfinite(opened.forecast([[0.5, 0.5]] * 10, 0.0).high).all()


@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_a_plan_after_steps_without_speed_is_less_sure(backend):
    """Its time counts from the last measured speed: widths grow, and end at the longest horizon."""
    model, samples = ensemble(), plain(60)
    online = Online(model, backend=backend)
    online.state = rollout(model, model.init(), samples)[0]
    sure = online.forecast([[0.5, 0.5]] * 10, 0.0)
    for _ in range(5):
        online.step(Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), math.nan, True, False))
    ahead = online.forecast([[0.5, 0.5]] * 10, 0.0)
    np.testing.assert_allclose((ahead.high - ahead.low)[:5], (sure.high - sure.low)[5:], rtol=1e-9)
    assert np.isinf(ahead.high[5:]).all()
    inputs = Inputs(*(torch.full((10,), x, dtype=torch.float64) for x in (0.5, 0.5, 0.0, 0.0, 0.4)))
    state = online.state
    np.testing.assert_allclose(forecast(model, state, inputs).high, ahead.high, rtol=1e-9)


def test_elements_of_another_number_are_refused():
    model = ensemble()
    inputs = Inputs(*(torch.zeros(10, 3, dtype=torch.float64) for _ in range(5)))
    with pytest.raises(ShapeError, match=r"inputs: found the shapes \[\(10, 3\)\], expected \(time, 2\)"):
        forecast(model, model.init((2,)), inputs)


PLANS = {
    "few_commands": (([[0.5, 0.5]] * 3, [0.0] * 4), {}, ShapeError, r"headings: found the shape \(4,\), expected one"),
    "beyond": (([[0.5, 1.2]], 0.0), {}, ConfigError, "commands: found 1.2 for the right side in step 1, expected -1"),
    "nan": (([[0.5, 0.5], [math.nan, 0.0]], 0.0), {}, ConfigError, "commands: found nan for the left side in step 2"),
    "nan_heading": (([[0.5, 0.5]], math.nan), {}, ConfigError, "headings: found nan in step 1"),
    "dt_0": (([[0.5, 0.5]], 0.0), {"dt": 0.0}, ConfigError, "dt: found 0, expected one time of 0.01 … 2 s"),
    "dt_10": (([[0.5, 0.5]], 0.0), {"dt": 10.0}, ConfigError, "dt: found 10, expected"),
    "dts": (([[0.5, 0.5]], 0.0), {"dt": [0.4]}, ConfigError, "dt: found the shape"),
    "none": (([], 0.0), {}, ShapeError, "commands: found the shape"),
    "one_side": (([0.5, 0.5, 0.5], 0.0), {}, ShapeError, r"commands: found the shape \(3,\), expected \(time, 2\)"),
    "turns": (([[0.5, 0.5]], 0.0, 30.0), {}, ConfigError, "yaw_rates: found 30 in step 1, expected -10 … 10, rad/s"),
    "nothing": (([[0.5, 0.5]], None), {}, ConfigError, r"headings: found none.*Online\(Planar\(…\)\)"),
    "text": ((["left"], 0.0), {}, ShapeError, "commands: found .* expected numbers"),
    "rates": (([[0.5, 0.5]], 0.0, [0.1, 0.2]), {}, ShapeError, r"yaw_rates: found the shape \(2,\)"),
}


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_that_cannot_be_is_refused_in_one_sentence(name):
    arguments, options, error, message = PLANS[name]
    with pytest.raises(error, match=message):
        Online(ensemble()).forecast(*arguments, **options)


def test_yaw_rates_are_those_of_the_headings():
    online = Online(ensemble())
    online.state = rollout(ensemble(), ensemble().init(), plain(40))[0]
    headings = [3.0, 3.1, -3.08, -2.98]  # through south
    rates = [0.25, (2 * math.pi - 6.18) / 0.4, 0.25, 0.25]
    surges = [online.forecast([[0.5, 0.2]] * 4, headings, each).surge for each in (None, rates)]
    np.testing.assert_allclose(surges[0], surges[1], rtol=1e-9)


def test_an_estimator_without_forecasts_says_what_to_add():
    for estimator in (AID(28.0), Ensemble({"aid": AID(28.0)})):
        for backend in ("auto", "torch"):
            with pytest.raises(
                ConfigError, match=r"found an estimator without forecasts, .* forecasts=ForecastSettings\(\)"
            ):
                Online(estimator, backend=backend).forecast([[0.5, 0.5]], 0.0)
