"""Half-widths that know the manoeuvre: what they cover, their equations, and that they can be left out."""

import math

import numpy as np
import pytest
import torch

from tests.support.forecasts import ensemble, plain
from usvlearn import Online, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.estimators.ensemble.conditional import layer
from usvlearn.estimators.ensemble.conditional.state import HIGH, LOW


def track(spread: np.ndarray, far: np.ndarray, group: np.ndarray, e: np.ndarray) -> np.ndarray:
    """The half-widths before each error, of one horizon without delay, beside 2 mean errors."""
    state, found, mean = layer.init((), 1, torch.zeros((), dtype=torch.float64)), [], 0.1
    for k in range(len(e)):
        facts = [torch.tensor([float(x[k])], dtype=torch.float64) for x in (spread, far, group)]
        width = torch.tensor([2 * mean], dtype=torch.float64)
        count = torch.tensor([float(k)], dtype=torch.float64)
        found.append(float(layer.halfwidth_held(layer.hold(state, count), width, *facts)))
        error = torch.tensor([e[k]], dtype=torch.float64)
        state = layer.learn_error(state, count + 1, error, width, *facts, 0.0, 0.1)
        mean += 0.01 * (e[k] - mean)
    return np.array(found)


@pytest.mark.thorough
def test_each_group_is_covered_where_errors_grow_with_what_is_known():
    """Errors of scale .02 + .3 spread + .2 far: half-widths are in proportion to it, and each group holds 90 %."""
    rng, steps = np.random.default_rng(0), 6000
    group = rng.choice(3, steps, p=[0.7, 0.2, 0.1])
    spread, far = rng.uniform(0, 0.1, steps), np.array([0.0, 0.3, 1.0])[group] * rng.uniform(0.5, 1.0, steps)
    scale = 0.02 + 0.3 * spread + 0.2 * far
    e = np.abs(scale * rng.standard_normal(steps))
    found = track(spread, far, group, e)
    late = np.arange(steps) > 1000
    for each in range(3):
        here = late & (group == each)
        assert (e[here] <= found[here]).mean() == pytest.approx(0.9, abs=0.03)
        assert np.log(found[here] / (1.645 * scale[here])).std() < 0.25
    flat = np.quantile(e[late], 0.9)  # the best single width
    score = lambda w: (2 * w + 20 * np.maximum(e[late] - w, 0)).mean()  # noqa: E731
    assert score(found[late]) < 0.75 * score(flat)


def test_few_errors_leave_the_half_width_that_does_not_know():
    """With equal scores little is mixed in before 100 errors, and nothing else remains after 300."""
    state = layer.init((), 1, torch.zeros((), dtype=torch.float64))
    share = [float(layer.hold(state, torch.tensor([k], dtype=torch.float64))[0, -1]) for k in (10.0, 200.0, 300.0)]
    assert share[0] == pytest.approx(1 / (1 + math.exp(2))) and 0.5 < share[1] < 1 and share[2] == 1


def test_predictions_are_the_same_and_old_states_go_on(tmp_path):
    """Without the choice the leaves and the half-widths are those of before; with it the predictions are the same."""
    samples, found = plain(300, 2), {}
    for knows in (True, False):
        model = ensemble(conditional=knows)
        state, surge, _ = rollout(model, model.init((2,)), samples)
        found[knows] = dict(named_leaves(state)) | {"surge": surge}
    own = {name for name in found[True] if ".conditional." in name}
    assert own and found[False].keys() == found[True].keys() - own
    for name, leaf in found[False].items():
        if not name.endswith("halfwidths"):
            torch.testing.assert_close(found[True][name], leaf, rtol=0, atol=0, equal_nan=True)
    assert "conditional" not in ensemble(conditional=False).spec()
    torch.testing.assert_close(found[False]["conformal.halfwidth"], found[True]["conformal.halfwidth"], rtol=0, atol=0)
    boat = Online.open(Online(ensemble(conditional=False)).save(tmp_path / "a.safetensors"))
    assert "conditional" not in boat.description and not any(".conditional." in name for name in boat.state)


def test_a_plan_that_moves_is_less_sure_than_one_that_stays():
    model, samples = ensemble(), plain(900, seed=3)
    boat = Online(model)
    boat.state = rollout(model, model.init(), samples)[0]
    last = [float(samples.inputs.command_left[-1]), float(samples.inputs.command_right[-1])]
    stays = boat.forecast([last] * 5, 0.0)
    moves = boat.forecast([[-1.0, -1.0] if sum(last) > 0 else [1.0, 1.0]] * 5, 0.0)
    assert (moves.high - moves.low)[-1] > (stays.high - stays.low)[-1] > 0


def test_a_path_is_the_commands_since_the_last_measured_speed():
    model, samples = ensemble(), plain(40)
    samples.measured[30:35] = False
    state = rollout(model, model.init(), tree_map(lambda x: x[:35], samples))[0]
    left, right = samples.inputs.command_left[29:35], samples.inputs.command_right[29:35]
    for path in (state.conformal.conditional.path, state.forecasts.conditional.path):
        assert path[LOW] == ((left + right) / 2).min() and path[HIGH] == ((left + right) / 2).max()
        far = torch.maximum((left - left[0]).abs(), (right - right[0]).abs()).max()
        assert layer.far_of(path) == far


def test_no_gradient_passes_through_half_widths():
    with torch.enable_grad():
        model, samples = ensemble().double(), plain(6)
        state, surge, _ = rollout(model, model.init(), samples, backend="torch")
        leaves = dict(named_leaves(state))
        assert surge.requires_grad
        assert not any(leaf.requires_grad for name, leaf in leaves.items() if ".conditional." in name)
