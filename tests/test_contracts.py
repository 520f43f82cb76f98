"""Properties that every estimator has, whatever it learns."""

import io
import itertools
import math

import numpy as np
import pytest
import torch

from tests.support import ESTIMATORS, FAMILIES, at, each_family, few, layers, leaves, over, random_samples, unaided
from tests.support.kernel_cases import mission
from usvlearn import Inputs, Online, Sample, rollout
from usvlearn.core.samples import tree_map
from usvlearn.errors import ShapeError

BATCHES = [(), (2, 3)]
every_family = pytest.mark.parametrize("name", FAMILIES)
each_layer = pytest.mark.parametrize("name", layers(FAMILIES))
each_setting = each_family(ESTIMATORS)  # where another setting of a family has other equations
each_layer_setting = each_family(layers(ESTIMATORS))
each_batch = over("batch", BATCHES)
BAD_INPUTS = [
    ("command_left", math.nan), ("command_right", math.inf), ("heading", -math.inf), ("yaw_rate", math.nan),
    ("dt", math.nan), ("dt", math.inf), ("dt", -0.4),
]  # fmt: skip


def assert_same(found, expected, **tolerance):
    found, expected = leaves(found), leaves(expected)
    assert found.keys() == expected.keys()
    for name in expected:
        torch.testing.assert_close(found[name], expected[name], msg=lambda m, n=name: f"{n}: {m}", **tolerance)


def troubled(*batch):
    """Samples with a missing speed, NaN inputs, stale steps and a new segment."""
    samples = random_samples(12, *batch)
    surge, fresh, measured = samples.surge.clone(), samples.fresh.clone(), samples.measured.clone()
    dt, left = samples.inputs.dt.clone(), samples.inputs.command_left.clone()
    surge[3] = math.nan  # said to be measured, but is not
    measured[4], surge[4] = False, math.nan
    fresh[5], measured[5], left[5], surge[5] = False, False, math.nan, math.nan
    fresh[6], measured[6], left[6] = False, False, math.inf
    fresh[7], measured[7], dt[7], left[7] = False, False, 0.0, math.nan  # a segment starts
    return Sample(samples.inputs._replace(dt=dt, command_left=left), surge, fresh, measured)


@every_family
@pytest.mark.parametrize("dtype", few([torch.float64, torch.float32], [torch.float64], "thorough"), ids=str)
@each_batch
def test_shapes_and_dtypes(name, batch, dtype):
    estimator = ESTIMATORS[name]().to(dtype)
    state = estimator.init(batch)
    end, surge, _ = rollout(estimator, state, random_samples(4, *batch, dtype=dtype))
    assert surge.shape == (4, *batch) and surge.dtype == dtype
    for key, leaf in leaves(state).items():
        assert leaf.shape[: len(batch)] == batch, key
        assert leaf.dtype in (dtype, torch.bool), key
        assert leaves(end)[key].shape == leaf.shape and leaves(end)[key].dtype == leaf.dtype, key


@every_family
@torch.no_grad()  # by compiled code, which test_kernels.py compares with torch over batches
def test_elements_equal_single_runs(name):
    batch = BATCHES[1]
    estimator, samples = ESTIMATORS[name](), random_samples(15, *batch)
    end, surge, _ = rollout(estimator, estimator.init(batch), samples)
    for element in itertools.product(*map(range, batch)):
        end1, surge1, _ = rollout(
            estimator, estimator.init(), tree_map(lambda x, i=element: x[(slice(None), *i)], samples)
        )
        torch.testing.assert_close(surge[(slice(None), *element)], surge1, rtol=1e-12, atol=1e-12)
        assert_same(tree_map(lambda x, i=element: x[i], end), end1, rtol=1e-12, atol=1e-12)


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


@every_family
@each_batch
@torch.no_grad()
def test_prediction_is_causal(name, batch):
    estimator, samples = ESTIMATORS[name](), random_samples(12, *batch)
    _, surge, _ = rollout(estimator, estimator.init(batch), samples)
    other = samples.surge.clone()
    other[7] += 1.0
    _, changed, _ = rollout(estimator, estimator.init(batch), samples._replace(surge=other))
    assert torch.equal(surge[:8], changed[:8])
    assert not torch.allclose(surge[8:], changed[8:])


@every_family
@each_batch
def test_bad_samples_are_masked(name, batch):
    estimator, samples = ESTIMATORS[name](), troubled(*batch)
    state = estimator.init(batch)
    for k in range(12):
        before = state
        state, surge = estimator(state, at(samples, k))
        kept = leaves(state)
        widths = kept.pop("halfwidths", torch.zeros(1))  # infinite before ten errors
        assert (widths >= 0).all() and all(x.isfinite().all() for x in kept.values()), k
        if k in (5, 6):  # stale: held, bit for bit
            assert surge.isnan().all()
            assert all(torch.equal(x, y) for x, y in zip(leaves(state).values(), leaves(before).values(), strict=True))
        elif k == 7:  # a start: no prediction, nothing learned
            assert surge.isnan().all()
        else:
            assert surge.isfinite().all()


@every_family
@over("bad", BAD_INPUTS)
def test_an_input_that_is_no_number_leaves_the_state_as_it_was(name, bad):
    """Even where the sample claims to be fresh and measured."""
    (field, value), estimator, samples = bad, ESTIMATORS[name](), random_samples(4, 2)
    state, _, _ = rollout(estimator, estimator.init((2,)), samples)
    sample = at(samples, 2)
    values = getattr(sample.inputs, field).clone()
    values[0] = value
    after, surge = estimator(state, sample._replace(inputs=sample.inputs._replace(**{field: values})))
    expected, _ = estimator(state, sample)
    assert surge[0].isnan() and surge[1].isfinite()
    for key, leaf in leaves(after).items():
        assert torch.equal(leaf[0], leaves(state)[key][0]), key
        assert torch.equal(leaf[1], leaves(expected)[key][1]), key


@every_family
def test_a_start_is_the_speed_to_depart_from(name):
    """After an outage nothing remembers the speed before it: only learned parameters may differ from a fresh start."""
    estimator, samples = ESTIMATORS[name](), random_samples(5)
    state, _, _ = rollout(estimator, estimator.init(), samples)
    opening = Sample(Inputs(*(torch.zeros((), dtype=torch.float64) for _ in Inputs._fields)),
                     torch.tensor(1.3, dtype=torch.float64), torch.tensor(False), torch.tensor(False))  # fmt: skip
    started, _ = estimator(state, opening)
    again, _ = estimator(started, opening._replace(surge=torch.tensor(0.2, dtype=torch.float64)))
    again, _ = estimator(again, opening)
    assert_same(again, started, rtol=0, atol=0)
    speeds = {key: leaf for key, leaf in leaves(started).items() if key.split(".")[-1] == "surge"}
    assert speeds and all(torch.equal(leaf, torch.full_like(leaf, 1.3)) for leaf in speeds.values())


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


@every_family
@each_batch
def test_resume_from_disk_is_exact(name, batch, tmp_path):
    samples = mission(20, *batch, seed=3)
    whole, half, resumed = (Online(ESTIMATORS[name](), batch) for _ in range(3))
    expected = [whole.step(at(samples, k)) for k in range(20)]
    for k in range(10):
        half.step(at(samples, k))
    resumed.restore(half.save(tmp_path / "a.safetensors"))
    found = [resumed.step(at(samples, k)) for k in range(10, 20)]
    np.testing.assert_array_equal(found, expected[10:])
    assert_same(resumed.state, whole.state, rtol=0, atol=0, equal_nan=True)


@every_family
@each_batch
def test_steps_are_pure(name, batch):
    """Same arguments, same result; nothing that was given changes, nor does the estimator."""
    estimator, samples = ESTIMATORS[name](), random_samples(6, *batch)
    state, _, _ = rollout(estimator, estimator.init(batch), samples)
    kept, given, parameters = tree_map(torch.clone, state), tree_map(torch.clone, samples), io.BytesIO()
    torch.save(estimator.state_dict(), parameters)
    first, second = (estimator(state, at(samples, 2)) for _ in range(2))
    assert torch.equal(first[1], second[1])
    assert_same(first[0], second[0], rtol=0, atol=0)
    assert_same(state, kept, rtol=0, atol=0)
    assert_same(samples, given, rtol=0, atol=0)
    after = io.BytesIO()
    torch.save(estimator.state_dict(), after)
    assert after.getvalue() == parameters.getvalue()


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


@each_setting
def test_learn_is_predict_and_update(name):
    estimator, samples = ESTIMATORS[name](), random_samples(6)
    state, _, _ = rollout(estimator, estimator.init(), samples)
    inputs, target = at(samples, 2).inputs, samples.surge[2]
    learned, surge = estimator.learn(state, inputs, target)
    assert torch.equal(surge, estimator.predict(state, inputs)[1])
    assert_same(learned, estimator.update(state, inputs, target), rtol=0, atol=0)
    assert_same(learned, estimator(state, at(samples, 2))[0], rtol=0, atol=0)


@each_setting
def test_monitor_names_numbers_per_element(name):
    estimator = ESTIMATORS[name]()
    numbers = estimator.monitor(estimator.init((2, 3)))
    assert all(value.shape == (2, 3) and value.isfinite().all() for value in numbers.values())
