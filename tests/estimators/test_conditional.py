"""Half-widths that know the manoeuvre: what they depend on, and that they can be left out."""

import torch

from tests.support.forecasts import ensemble, plain
from usvlearn import Online, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import FAR, HIGH, LOW


def test_predictions_are_the_same_and_old_states_go_on(tmp_path):
    """Without the choice the leaves and the half-widths are those of before; with it the predictions are the same."""
    samples, runs = plain(300, 2), {}
    for knows in (True, False):
        model = ensemble(conditional=knows)
        state, surge, _ = rollout(model, model.init((2,)), samples)
        runs[knows] = dict(named_leaves(state)) | {"surge": surge}
    more = {name for name in runs[True] if ".conditional." in name}
    assert more and runs[False].keys() == runs[True].keys() - more
    for name, leaf in runs[False].items():
        if not name.endswith("halfwidths"):
            torch.testing.assert_close(runs[True][name], leaf, rtol=0, atol=0, equal_nan=True)
    assert "conditional" not in ensemble(conditional=False).description()
    torch.testing.assert_close(runs[False]["conformal.halfwidth"], runs[True]["conformal.halfwidth"], rtol=0, atol=0)
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
        assert path[FAR] == far


def test_no_gradient_passes_through_half_widths():
    with torch.enable_grad():
        model, samples = ensemble().double(), plain(6)
        state, surge, _ = rollout(model, model.init(), samples, backend="torch")
        leaves = dict(named_leaves(state))
        assert surge.requires_grad
        assert not any(leaf.requires_grad for name, leaf in leaves.items() if ".conditional." in name)
