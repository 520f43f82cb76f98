"""Forecasts: open-loop simulations from origins, judged when they are due; nothing later than the origin but commands
is used.
"""

import json
import math

import numpy as np
import pytest
import torch

from tests.support import at, each_dtype
from tests.support.forecasts import HORIZONS, ensemble, plain
from usvlearn import AID, BOA, Ensemble, ForecastSettings, Inputs, Online, Persistence, Sample, rollout
from usvlearn.core.samples import Fleet, Run, named_leaves, tree_map
from usvlearn.engine.rollouts import simulate
from usvlearn.errors import ConfigError
from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.forecasts.state import DELAY, EMPTY, FIRST, MOST
from usvlearn.evaluation.horizons import LEAST, horizon_scores, horizon_sums

STEPS = (1, 5, 10)  # of 0.4 s: HORIZONS


def made(model: Ensemble, samples: Sample) -> tuple[torch.Tensor, torch.Tensor]:
    leaves = ["forecasts.predictions", "forecasts.halfwidths"]
    record = rollout(model, model.init(samples.surge.shape[1:]), samples, leaves)[2]
    return record[leaves[0]], record[leaves[1]]


def test_a_forecast_is_the_free_run_from_its_origin():
    """With overlap 5 each step is an origin of the horizons up to 2 s, and every other one of 4 s."""
    model, samples = ensemble(), plain(40)
    forecasts, _ = made(model, samples)
    states = rollout(model, model.init(), samples, lambda state: state)[2]
    for origin in (3, 8, 21):
        state = tree_map(lambda leaf, k=origin: leaf[k], states)
        ahead = tree_map(lambda x, k=origin: x[k + 1 : k + 1 + STEPS[-1]], samples)
        blind = ahead._replace(measured=torch.zeros_like(ahead.measured))
        free = simulate(model, state, blind, ["predictions"])[2]["predictions"]
        for j, steps in enumerate(STEPS):
            due = forecasts[origin + steps, j]
            if not due.isnan().all():
                torch.testing.assert_close(due[:4], free[steps - 1, :4], rtol=1e-12, atol=1e-12)
                assert due[4] == samples.surge[origin]  # persistence: what was measured at the origin
                plan = model.forecast(state, Inputs(*(x[:steps] for x in ahead.inputs)))
                torch.testing.assert_close(due[5], plan[0][-1], rtol=1e-12, atol=1e-12)
        assert not forecasts[origin + 1, 0].isnan().any() and not forecasts[origin + 5, 1].isnan().any()


def test_no_forecast_uses_a_command_or_a_speed_after_its_time():
    """What is due at a step is unchanged by all samples after it, and by speeds after its origin."""
    model, samples, k = ensemble(), plain(60), 40
    first, widths = made(model, samples)
    later = tree_map(torch.clone, samples)
    later.surge[k + 1 :] += 3.0
    for x in later.inputs[:4]:
        x[k + 1 :] = 0.9 - x[k + 1 :]
    other, other_widths = made(model, later)
    torch.testing.assert_close(other[: k + 1], first[: k + 1], rtol=0, atol=0, equal_nan=True)
    torch.testing.assert_close(other_widths[: k + 1], widths[: k + 1], rtol=0, atol=0, equal_nan=True)
    speeds = tree_map(torch.clone, samples)
    speeds.surge[k + 1 :] += 3.0
    other, other_widths = made(model, speeds)
    for j, steps in enumerate(STEPS):
        due = slice(k + 1, k + steps + 1)  # their origins are k and before
        torch.testing.assert_close(other[due, j], first[due, j], rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(other_widths[due, j], widths[due, j], rtol=0, atol=0, equal_nan=True)
        assert (other[k + steps + 1 :, j] - first[k + steps + 1 :, j]).abs().nan_to_num(0).max() > 0.1


def test_how_many_forecasts_are_under_way():
    """Over a horizon of h s some `overlap` at a time, or one a step."""
    model, samples = ensemble(horizons=(0.4, 2.0, 20.0), overlap=4.0), plain(400)
    _, _, record = rollout(model, model.init(), samples, ["forecasts.predictions", "forecasts.elapsed"])
    due = record["forecasts.predictions"][..., -1].isfinite().double()[100:].mean(0) * 300
    assert due[0] == 300  # every step
    assert due[1] == 300  # 0.5 s is rounded to one step
    assert due[2] == pytest.approx(300 / 12, abs=1)  # and 5 s to 12
    busy = (record["forecasts.elapsed"] >= 0).sum(-1)
    assert busy.max() <= model.forecasts.slots and busy[100:].min() >= 5


def test_a_segment_ends_what_is_under_way():
    model, samples = ensemble(), plain(60)
    samples.inputs.dt[30] = 0.0
    forecasts, _ = made(model, samples)
    state = rollout(model, model.init(), tree_map(lambda x: x[:31], samples))[0]
    assert (state.forecasts.elapsed == EMPTY).all()
    for j, steps in enumerate(STEPS):
        assert forecasts[31 : 31 + steps, j].isnan().all() and forecasts[31 + steps, j].isfinite().all()


def test_missing_speeds_are_neither_origins_nor_targets():
    model, samples = ensemble(), plain(60)
    samples.measured[30:40] = False
    leaves = ["forecasts.predictions", "forecasts.errors", "forecasts.coasted"]
    _, _, record = rollout(model, model.init(), samples, leaves)
    errors = record["forecasts.errors"][:, 0]
    assert errors[39] == errors[29] and errors[-1] > errors[39]
    torch.testing.assert_close(record["forecasts.coasted"][30:40, ...], 0.4 * torch.arange(1, 11).double())
    assert record["forecasts.predictions"][30, 0, -1].isfinite()  # it is due, but not judged
    assert record["forecasts.predictions"][31:41, 0].isnan().all()  # no origin without a speed


def weights_after(model: Ensemble, state, time: float) -> torch.Tensor:
    """The weights of the horizons, between which they are interpolated; those published are of the horizons."""
    values, labels = model.forecasts.monitor(state), model.forecasts.labels
    at = [[float(values[f"weight_{name}_at_{h}"]) for h in labels] for name in model.forecasts.names]
    return torch.tensor([np.interp(time, list(map(float, labels)), row) for row in at], dtype=torch.float64)


def test_after_an_outage_the_ensemble_predicts_with_the_weights_of_that_time():
    model, samples = ensemble(), plain(80)
    before = rollout(model, model.init(), tree_map(lambda x: x[:70], samples))[0]
    rest = tree_map(lambda x: x[70:], samples)
    _, surge, record = simulate(model, before, rest, ["predictions"])
    members = record["predictions"][:, [model.names.index(name) for name in model.forecasts.names]]
    weights = model.combiners["boa"].combine(before.combiners["boa"], record["predictions"][0, [0, 1]])
    assert surge[0] == pytest.approx(float(weights), abs=1e-12)  # the first step is the ordinary prediction
    for k in range(1, 10):
        expected = weights_after(model, before.forecasts, 0.4 * (k + 1)) @ members[k]
        assert surge[k] == pytest.approx(float(expected), abs=1e-12)


def test_weights_learn_by_boa_and_widths_by_their_equations():
    """One horizon, one member beside persistence, against the equations of the module in plain Python."""
    model = Ensemble({"aid": AID(28.0), "persistence": Persistence()}, forecasts=ForecastSettings((0.8,), overlap=2.0))
    samples = plain(120)
    leaves = ["forecasts.predictions", "forecasts.halfwidths", "forecasts.quantile", "forecasts.error"]
    record = rollout(model, model.init(), samples, leaves)[2]
    rule = BOA(memory=30 + 4 * 0.8)
    rule.bind(["aid", "persistence"])
    state, s, q, n = rule.init((), torch.zeros((), dtype=torch.float64)), 0.0, FIRST, 0
    for k in range(120):
        row = record["forecasts.predictions"][k, 0]
        if row.isnan().all():
            continue
        y = samples.surge[k]
        unit = math.sqrt(0.8 / 0.4)
        state = rule.learn(state, row[:2] / unit, y / unit, torch.tensor(0.4, dtype=torch.float64))
        e, n = abs(float(row[3] - y)), n + 1
        q = min(max(q * math.exp(((e > q * s) - 0.1) / (DELAY + 2.0)), 0.3), MOST)
        s += max(1 / n, 1 / 200) * (e - s)
        assert record["forecasts.error"][k, 0] == pytest.approx(s, rel=1e-9)
        assert record["forecasts.quantile"][k, 0] == pytest.approx(q, rel=1e-9)
    assert n > 100
    end = rollout(model, model.init(), samples)[0]
    torch.testing.assert_close(end.forecasts.rule.weights[0], state.weights, rtol=1e-6, atol=1e-9)


def test_a_horizon_that_was_hardly_judged_has_the_weights_of_a_shorter_one():
    model = ensemble(horizons=(0.4, 2.0, 30.0))
    state = rollout(model, model.init(), plain(60))[0].forecasts
    assert state.errors[1] >= FEW > state.errors[2]
    torch.testing.assert_close(weights_after(model, state, 30.0), state.rule.weights[1])


def test_intervals_cover_what_they_say():
    model, samples = ensemble(), plain(3000, seed=4)
    forecasts, widths = made(model, samples)
    error = (forecasts[..., -1] - samples.surge[:, None]).abs()
    for j in range(3):
        known = widths[:, j].isfinite() & forecasts[:, j, -1].isfinite()
        assert (error[known, j] <= widths[known, j]).double().mean() == pytest.approx(0.9, abs=0.03)
        first = int(known.nonzero()[0])
        assert (
            forecasts[:first, j, -1].isfinite().sum() >= FEW
            and (widths[:first, j].isinf() | widths[:first, j].isnan()).all()
        )


@each_dtype
def test_a_state_goes_on_where_it_was(dtype, tmp_path):
    """Saved aboard and opened in mid-flight, bit for bit; a batch is its batch elements."""
    model, samples = ensemble().to(dtype), plain(80, 2)
    samples = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, samples)
    end, _, record = rollout(model, model.init((2,)), samples, ["forecasts.predictions"])
    whole = record["forecasts.predictions"]
    half = rollout(model, model.init((2,)), tree_map(lambda x: x[:37], samples))[0]
    online = Online(model)
    online.state = at(half, 1)
    online = Online.open(online.save(tmp_path / "a.safetensors"))
    for k in range(37, 80):
        inputs = Inputs(*(float(x[k, 1]) for x in samples.inputs))
        online.step(Sample(inputs, float(samples.surge[k, 1]), True, True))
        expected = whole[k, 1].numpy()
        rounding = 0 if dtype == torch.float64 else 1e-5  # a call and a run round differently in float32
        np.testing.assert_allclose(online.state["forecasts.predictions"], expected, rtol=rounding)
    for name, leaf in named_leaves(end) if rounding == 0 else ():
        np.testing.assert_array_equal(online.state[name], leaf[1].numpy(), err_msg=name)


def test_an_estimator_without_a_kernel_is_not_forecast():
    class Slow(Persistence):
        pass

    members = {"slow": Slow(), "persistence": Persistence()}
    assert Ensemble(members, forecasts=ForecastSettings((2.0,))).forecasts.names == ("persistence",)
    with pytest.raises(ConfigError, match=r"forecasts.members: found slow, expected some of .* kernel, persistence,"):
        Ensemble(members, forecasts=ForecastSettings((2.0,), ["slow"]))


def test_scores_by_horizon_against_a_plain_loop():
    model, samples = ensemble(), plain(60, 2)
    samples.measured[20:25, 1] = False
    forecasts, widths = made(model, samples)
    arrays = {"forecasts": forecasts.flatten(2).numpy(), "forecast_halfwidths": widths.numpy()}
    run = Run(np.zeros((60, 2)), tree_map(lambda x: x.numpy(), samples), ("a", "a"), (60, 60))
    fleet = Fleet(("one", "two"), (run,), {})
    columns = model.forecasts.columns
    scores = horizon_scores(horizon_sums(fleet, [(0, 0, arrays)], HORIZONS, columns), fleet.boats)
    for element, boat in enumerate(fleet.boats):
        for j, horizon in enumerate(("0.4", "2", "4")):
            errors, inside = [], []
            for k in range(60):
                if samples.measured[k, element] and forecasts[k, element, j, -1].isfinite():
                    errors.append([abs(float(x - samples.surge[k, element])) for x in forecasts[k, element, j]])
                    if widths[k, element, j].isfinite():
                        inside.append(errors[-1][-1] <= float(widths[k, element, j]))
            mean = np.mean(errors, 0)
            for name, mae in zip(columns, mean, strict=True):
                row = scores[boat][name][horizon]
                assert row["mae"] == pytest.approx(mae) and row["steps"] == len(errors)
                assert row["skill"] == pytest.approx(1 - mae / mean[4])
            enough = len(inside) >= LEAST
            assert scores[boat]["ensemble"][horizon]["covers"] == (pytest.approx(np.mean(inside)) if enough else None)
    assert json.dumps(scores)


def test_only_the_leaves_of_a_free_run_are_kept():
    frozen = ensemble().init().forecasts.frozen
    assert {name: sorted(leaves) for name, leaves in frozen.items()} == {
        "joint": ["commands", "mean", "started", "surge"], "arx": ["past", "started", "surge", "theta"],
        "aid": ["surge", "theta"], "persistence": ["surge"],
    }  # fmt: skip
    assert not any("factor" in name for name, _ in named_leaves(frozen))
