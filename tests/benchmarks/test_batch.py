"""Batch peers: each one learns a boat that it can represent, and no forecast is told what it may not know."""

from functools import partial

import batch
import numpy as np
import pytest
import torch
from peers import gru, narmax, physics, state_space
from peers.batch import (
    HORIZONS,
    Held,
    choose,
    cut,
    errors,
    features,
    free_run_errors,
    need,
    stretches,
    targets,
    windows,
)

from tests.support import few
from usvlearn.core.samples import Inputs, Sample

NOISE, STEPS, TOP = 0.01, 400, 2.0
PEERS = {
    "narmax": partial(narmax.one, lags=1, degree=1, terms=4, heading=False, noise=True),
    "state_space": partial(state_space.one, top=TOP, hidden=1, penalty=1e-5, heading=False, adam=100, lbfgs=60),
    "gru": partial(gru.one, top=TOP, units=8, heading=False, updates=100),
    "physics": partial(physics.one, top=TOP, cubic=False, current=False, lag=False),
}
MODULES = {"narmax": "sysidentpy", "state_space": "jax_sysid"}


def run(seed):
    """A linear boat, v' = −v/2 + ξ_L/2 + ξ_R/2, whose speed is measured with noise."""
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform(0, 1, (STEPS // 8, 2)), 8, axis=0)
    speed, keep = np.zeros(STEPS), np.exp(-0.5 * 0.4)
    for k in range(1, STEPS):
        speed[k] = keep * speed[k - 1] + (1 - keep) * commands[k].sum()
    dt, yes = np.where(np.arange(STEPS) == 0, 0.0, 0.4), np.ones(STEPS, bool)
    inputs = Inputs(*commands.T.copy(), 0.1 * rng.standard_normal(STEPS).cumsum(), np.zeros(STEPS), dt)
    return Sample(inputs, speed + NOISE * rng.standard_normal(STEPS), yes, yes.copy())


@pytest.fixture(scope="module", params=["narmax", "state_space", *few(["physics"], (), "thorough"), *few(["gru"], ())])
def model(request):
    """Each peer, fitted to two runs."""
    if request.param in MODULES:
        pytest.importorskip(MODULES[request.param], reason=f"{request.param} needs the extra bench")
    torch.manual_seed(0)
    return PEERS[request.param]([run(0), run(1)])


pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")  # of other libraries


def test_a_free_run_of_a_linear_boat_is_near_the_noise(model):
    """The MAE of the truth is √(2/π) NOISE = 0.008; the first speed has noise too."""
    found, held = free_run_errors(model, [run(2)])
    assert found < 4 * NOISE < 0.1 * held


def test_forecasts_are_better_than_persistence(model):
    for mae, held in list(errors([run(2)], [model.forecast(run(2))]).values())[1:]:
        assert mae < 0.6 * held


def test_no_forecast_is_told_a_command_after_its_target(model):
    before, after, last = run(2), run(2), 200
    for field in after.inputs[:4]:
        field[last + 1 :] += 0.3
    aim, changed = targets(before), model.forecast(before) != model.forecast(after)
    changed &= aim.reached
    assert not changed[aim.rows <= last].any()
    assert changed[(aim.rows > last + 1) & aim.reached].all()


def test_no_forecast_is_told_a_speed_after_its_origin(model):
    before, after, last = run(2), run(2), 200
    after.surge[last + 1 :] += 0.5
    aim, changed = targets(before), model.forecast(before) != model.forecast(after)
    changed &= aim.reached
    assert not changed[aim.origins <= last].any()
    assert changed[aim.origins > last + 1, 0][aim.reached[aim.origins > last + 1, 0]].all()


def test_a_free_run_is_told_the_first_speed_alone(model):
    before, after = run(2), run(2)
    after.surge[1:] += 0.5
    np.testing.assert_array_equal(model.free_run(before), model.free_run(after))


def test_narmax_steps_as_its_library_does():
    pytest.importorskip("sysidentpy", reason="needs the extra bench")
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    one, other = run(0), run(2)
    shifted = [np.append(x[1:], x[-1:], 0) for x in (features(r, False) for r in (one, other))]
    lags = [1, 2]
    theirs = FROLS(ylag=lags, xlag=[lags] * 3, basis_function=Polynomial(degree=2), order_selection=False, n_terms=9,
                   estimator=LeastSquares())  # fmt: skip
    theirs.fit(X=shifted[0], y=one.surge[:, None])
    expected = theirs.predict(X=shifted[1], y=other.surge[:, None])[:, 0]
    ours = narmax.one([one], lags=2, degree=2, terms=9, heading=False, noise=False)
    np.testing.assert_allclose(sorted(ours.theta), sorted(theirs.theta[:, 0]), atol=1e-9)
    state, x = ours.begin(other.surge[:1], features(other, False)[:1]), features(other, False)
    state = ours.correct(ours.step(state, x[1:2])[0], other.surge[1:2])  # the library is told two speeds
    for k in range(2, 40):
        state, speed = ours.step(state, x[k : k + 1])
        assert speed[0] == pytest.approx(expected[k], abs=1e-9)


@pytest.fixture
def gap():
    """A run with an outage: the inputs of rows 100 to 119 are stale, and a segment starts at row 120."""
    one = run(3)
    one.fresh[100:120] = one.measured[100:120] = False
    one.inputs.dt[120] = 0.0
    one.measured[150] = False
    return one


def test_no_forecast_crosses_a_gap(gap):
    aim = targets(gap)
    assert aim.origins.tolist() == [k for k in range(0, STEPS, 5) if not 100 <= k < 120 and k != 150]
    for k, origin in enumerate(aim.origins):
        for j, h in enumerate(HORIZONS):
            inside = origin + h < STEPS and not (origin < 100 <= origin + h or origin < 120 <= origin + h)
            assert aim.reached[k, j] == inside
            assert aim.scored[k, j] == (inside and origin + h != 150)


def test_stretches_and_windows_end_at_a_gap(gap):
    steps = gap.fresh & (gap.inputs.dt > 0)
    assert stretches(steps, gap.inputs.dt == 0) == [(0, 100), (120, STEPS)]
    made = windows([gap], heading=True)
    assert not (made.told & made.scored).any()
    assert set(made.told.sum(0)) <= {0, 9, 10}  # none is told, or ten, of which one may not be measured
    assert made.inputs.shape[-1] == 5 and made.scored.any(0).all()
    first = next(k for k in range(made.first.size) if made.first[k] == gap.surge[90])
    assert (made.told | made.scored)[:, first].sum() == 9  # rows 91 to 99
    np.testing.assert_array_equal(made.speeds[:9, first], gap.surge[91:100])


def test_runs_are_cut_by_their_steps():
    early, late = cut([run(0), run(1)], 0.8)
    assert [len(one.surge) for one in (*early, *late)] == [400, 240, 160]
    assert late[0].inputs.dt[0] == 0.0 and run(1).inputs.dt[240] == 0.4
    np.testing.assert_array_equal(late[0].surge, run(1).surge[240:])


def test_the_best_setting_is_chosen_on_late_runs_and_fitted_to_all():
    told = []

    class Off(Held):
        def __init__(self, by, runs):
            self.by = by
            told.append((by, sum(len(one.surge) for one in runs)))

        def forecast(self, run, horizons=HORIZONS):
            return super().forecast(run, horizons) + self.by

    fitted = choose({"far": partial(Off, 1.0), "near": partial(Off, 0.0)}, [run(0), run(1)])
    assert fitted.setting == "near"
    assert told == [(1.0, 640), (0.0, 640), (0.0, 800)]


def test_persistence_has_no_skill():
    pairs = errors([run(0)], [Held().forecast(run(0))])
    assert all(mae == held > 0 for mae, held in pairs.values())
    assert batch.skills(pairs) == dict.fromkeys(HORIZONS, 0.0)


def test_a_library_that_is_absent_has_a_row_that_says_so():
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'usvlearn\[bench\]'"):
        need("no_such_module", "NoSuchPeer")

    class Absent:
        fit = staticmethod(lambda runs, top: need("no_such_module", "NoSuchPeer"))

    log = batch.Log("boat", [run(0)], [run(1)], TOP, ())
    found = {"persistence": batch.Row(0.5, {}), "absent": batch.peer_row(Absent, log)}
    found["ours: joint"] = batch.Row(0.1, dict.fromkeys(HORIZONS, 0.5))
    text = "\n".join(batch.page({"boat": found}, 1.0))
    assert "| absent | not installed |" in text and "| ours: joint | **0.100** |" in text


def test_our_forecasts_begin_with_the_prediction_of_one_step():
    """At one step they are what the ensemble predicted as it learned online."""
    from usvlearn import AID, Average, Ensemble, rollout
    from usvlearn.core.samples import tree_map
    from usvlearn.engine.rollouts import tensors

    model, one = Ensemble({"aid": AID(20.0)}, {"average": Average()}), run(0)
    samples = tensors(one, torch.float64)
    with torch.no_grad():
        _, _, states = rollout(model, model.init(), samples, record=lambda state: state)
        predictions = rollout(model, model.init(), samples, record=["predictions"])[2]["predictions"].numpy()
        aim = targets(one)
        at_origins = tree_map(lambda leaf: leaf[aim.origins].contiguous(), states)
        ahead = batch.free_from(model, at_origins, one, aim)
    np.testing.assert_allclose(ahead[0], predictions[aim.origins + 1], atol=1e-12)
    whole = int(np.flatnonzero(aim.origins == 100)[0])
    blind = one._replace(surge=np.where(np.arange(STEPS) <= 100, one.surge, np.nan))
    with torch.no_grad():
        after = rollout(model, model.init(), tensors(blind, torch.float64), record=["predictions"])[2]["predictions"]
    np.testing.assert_allclose(ahead[:, whole], after[101:176].numpy(), atol=1e-12)
