"""Properties that every estimator has, whatever it learns."""

import pytest
import torch

from tests.support import ESTIMATORS, FAMILIES, each_family, few, layers, over, unaided
from usvlearn import Persistence, rollout
from usvlearn.core.samples import tree_map
from usvlearn.errors import ShapeError
from usvlearn.testing import (
    BATCHES,
    CONTRACTS,
    assert_same,
    at,
    check_estimator,
    learn_is_predict_and_update,
    monitor_names_numbers_per_element,
    random_samples,
    troubled,
)

every_family = pytest.mark.parametrize("name", FAMILIES)
each_layer = pytest.mark.parametrize("name", layers(FAMILIES))
each_layer_setting = each_family(layers(ESTIMATORS))
each_batch = over("batch", BATCHES)


@every_family
@pytest.mark.parametrize("contract", CONTRACTS)
def test_every_family_keeps_the_contract(name, contract):
    CONTRACTS[contract](ESTIMATORS[name])


@pytest.mark.thorough
@pytest.mark.parametrize("name", [name for name in ESTIMATORS if name not in FAMILIES])
def test_other_settings_keep_the_contracts(name):
    learn_is_predict_and_update(ESTIMATORS[name])
    monitor_names_numbers_per_element(ESTIMATORS[name])


@each_layer
@each_batch
def test_vmap_equals_batch(name, batch):
    estimator, samples = unaided(ESTIMATORS[name]()), random_samples(3, 4, *batch)
    state = estimator.init((4, *batch))
    for k in range(3):
        mapped = torch.vmap(lambda s, x: estimator(s, x))(state, at(samples, k))
        state, surge = estimator(state, at(samples, k))
        torch.testing.assert_close(mapped[1], surge)
        assert_same(mapped[0], state)


@each_layer_setting
@each_batch
def test_gradients_through_bad_samples_are_finite_and_reach_every_hyperparameter(name, batch):
    estimator, samples = ESTIMATORS[name](), troubled(*batch)
    _, surge, _ = rollout(estimator, estimator.init(batch), samples)
    usable = surge.isfinite() & samples.surge.isfinite()
    loss = torch.where(usable, surge - torch.where(usable, samples.surge, 0.0), 0.0).square().mean()
    parameters = {key: p for key, p in estimator.named_parameters() if p.requires_grad}
    if not parameters:
        assert not loss.requires_grad
        return
    loss.backward()
    for key, parameter in parameters.items():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), key
        assert parameter.grad.abs().max() > 0, key


@each_layer_setting
def test_gradients_of_hyperparameters_equal_differences(name):
    estimator, samples = ESTIMATORS[name](), random_samples(6)
    scalars = {key: p for key, p in estimator.named_parameters() if p.ndim == 0 and p.requires_grad}

    def loss() -> torch.Tensor:
        return (rollout(estimator, estimator.init(), samples)[1] - samples.surge).square().mean()

    if scalars:
        loss().backward()
    for key, parameter in scalars.items():
        slope, h = parameter.grad.clone(), 1e-6
        with torch.no_grad():
            parameter += h
            up = loss()
            parameter -= 2 * h
            down = loss()
            parameter += h
        torch.testing.assert_close(slope, (up - down) / (2 * h), rtol=2e-4, atol=1e-9, msg=lambda m, k=key: f"{k}: {m}")


@every_family
@torch.no_grad()
def test_grid_of_hyperparameters_is_a_batch_axis(name):
    """A hyperparameter of shape (grid, 1) beside a batch (grid, boats) equals one estimator per grid point."""
    factors = torch.tensor([0.9, 1.0, 1.1], dtype=torch.float64)
    scalars = [key for key, p in ESTIMATORS[name]().named_parameters() if p.ndim == 0]
    samples = random_samples(8, 2)
    for key in scalars:
        grid = ESTIMATORS[name]()
        grid.get_parameter(key).data = grid.get_parameter(key).data * factors[:, None]
        _, surge, _ = rollout(grid, grid.init((3, 2)), tree_map(lambda x: x[:, None].expand(8, 3, 2), samples))
        for g, factor in enumerate(factors):
            one = ESTIMATORS[name]()
            one.get_parameter(key).data *= factor
            torch.testing.assert_close(surge[:, g], rollout(one, one.init((2,)), samples)[1], rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("name", few([*layers(FAMILIES), "rnn_penalty"], {"rnn_replay", "boa"}))
def test_compiles_without_graph_breaks(name):
    estimator, samples = unaided(ESTIMATORS[name]()), random_samples(1, 3)
    state = tree_map(torch.Tensor.detach, estimator.init((3,)))
    torch.compiler.reset()
    compiled = torch.compile(estimator, backend="eager", fullgraph=True)(state, at(samples, 0))
    plain = estimator(state, at(samples, 0))
    torch.testing.assert_close(compiled[1], plain[1])
    assert_same(compiled[0], plain[0])


@every_family
def test_samples_that_do_not_fit_are_refused(name):
    estimator, samples = ESTIMATORS[name](), random_samples(4, 2)
    state, inputs = estimator.init((2,)), samples.inputs
    wrong = {
        "ndarray": tree_map(lambda x: x.numpy(), samples),
        "float32": tree_map(lambda x: x.float() if x.is_floating_point() else x, samples),
        "fresh is torch.float64": samples._replace(fresh=samples.surge),
        "heading has the shape": samples._replace(inputs=inputs._replace(heading=inputs.heading[:, :1])),
        "at least one step": tree_map(lambda x: x[:0], samples),
        r"estimator.init\(\(3,\)\)": random_samples(4, 3),
    }
    for message, bad in wrong.items():
        with pytest.raises(ShapeError, match=message):
            rollout(estimator, state, bad)
    scalars = [key for key, p in estimator.named_parameters() if p.ndim == 0]
    for key in scalars:
        grid = ESTIMATORS[name]()
        grid.get_parameter(key).data = grid.get_parameter(key).data.expand(5).clone()
        with pytest.raises(ShapeError, match="broadcasts against the batch"):
            grid.init((2,))


def test_a_class_that_breaks_them_is_told_which():
    class Knowing(Persistence):
        """Learns from the step before it has been; forgets who is who; and keeps what it learned in itself."""

        def update(self, state, inputs, surge):
            self.rest += 1.0
            return type(state)(surge.mean().expand(surge.shape))

        def start(self, state, surge):
            return state

    with pytest.raises(AssertionError) as failure:
        check_estimator(Knowing)
    named = {line.partition(":")[0] for line in str(failure.value).splitlines()[1:]}
    assert named >= {"steps_are_pure", "a_start_is_the_speed_to_depart_from", "vehicles_of_a_batch_are_independent"}
    assert "a step changes the estimator: what is learned is state" in str(failure.value)
