"""Properties that every estimator has, whatever it learns: `check_estimator` tries them on a class of your own."""

from __future__ import annotations

import io
import itertools
import math
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs, Sample, named_leaves, tree_map
from usvlearn.engine.online import Online
from usvlearn.engine.rollouts import rollout

Make = Callable[[], Estimator]
BATCHES: list[tuple[int, ...]] = [(), (2, 3)]
BAD_INPUTS = [
    ("command_left", math.nan), ("command_right", math.inf), ("heading", -math.inf), ("yaw_rate", math.nan),
    ("dt", math.nan), ("dt", math.inf), ("dt", -0.4),
]  # fmt: skip


def check_estimator(make: Make) -> None:
    """Try on an estimator what every one must fulfil, such as that a prediction does not know what is measured then.

    Args:
        make: makes one; or its class.

    Raises:
        AssertionError: names each property that fails, and how.

    >>> from usvlearn import Persistence
    >>> check_estimator(Persistence)
    """
    failures = []
    for name, contract in CONTRACTS.items():
        try:
            contract(make)
        except Exception as error:
            first = " ".join(str(error).split())
            failures.append(f"{name}: {type(error).__name__}: {first[:300]}")
    if failures:
        raise AssertionError(f"{len(failures)} of {len(CONTRACTS)} properties fail:\n" + "\n".join(failures))


def random_samples(steps: int, *batch: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Sample:
    """Random inputs and speeds, all fresh and measured.

    >>> random_samples(4, 2).surge.shape
    torch.Size([4, 2])
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform() -> torch.Tensor:
        return torch.rand(steps, *batch, generator=generator, dtype=dtype)

    yes = torch.ones(steps, *batch, dtype=torch.bool)
    inputs = Inputs(uniform(), uniform(), 6 * uniform(), uniform() - 0.5, torch.full((steps, *batch), 0.4, dtype=dtype))
    return Sample(inputs, 2 * uniform(), yes, yes)


def troubled(*batch: int) -> Sample:
    """Samples with a missing speed, NaN inputs, stale steps and a new segment.

    >>> int(troubled().fresh.sum())
    9
    """
    samples = random_samples(12, *batch)
    surge, fresh, measured = samples.surge.clone(), samples.fresh.clone(), samples.measured.clone()
    dt, left = samples.inputs.dt.clone(), samples.inputs.command_left.clone()
    surge[3] = math.nan  # said to be measured, but is not
    measured[4], surge[4] = False, math.nan
    fresh[5], measured[5], left[5], surge[5] = False, False, math.nan, math.nan
    fresh[6], measured[6], left[6] = False, False, math.inf
    fresh[7], measured[7], dt[7], left[7] = False, False, 0.0, math.nan  # a segment starts
    return Sample(samples.inputs._replace(dt=dt, command_left=left), surge, fresh, measured)


def at(samples: Any, k: Any) -> Any:
    """The k-th of samples, or of inputs; of a state a batch element."""
    return tree_map(lambda x: x[k], samples)


def leaves(tree: Any) -> dict[str, torch.Tensor]:
    """The leaves of a state by name."""
    return dict(named_leaves(tree))


def assert_same(found: Any, expected: Any, **tolerance: Any) -> None:
    """Raise an AssertionError, which names the leaf, unless two states are the same."""
    found, expected = leaves(found), leaves(expected)
    assert found.keys() == expected.keys(), f"leaves {', '.join(found)}, expected {', '.join(expected)}"
    for name, leaf in expected.items():
        torch.testing.assert_close(found[name], leaf, msg=partial("{}: {}".format, name), **tolerance)


def shapes_and_dtypes(make: Make) -> None:
    for batch, dtype in itertools.product(BATCHES, (torch.float64, torch.float32)):
        estimator = make().to(dtype)
        state = estimator.init(batch)
        end, surge, _ = rollout(estimator, state, random_samples(4, *batch, dtype=dtype))
        assert surge.shape == (4, *batch) and surge.dtype == dtype, f"predictions {surge.shape} of {surge.dtype}"
        for key, leaf in leaves(state).items():
            assert leaf.shape[: len(batch)] == batch, f"{key}: found {tuple(leaf.shape)}, expected {batch} and more"
            assert leaf.dtype == dtype or not leaf.is_floating_point(), f"{key}: found {leaf.dtype}, expected {dtype}"
            last = leaves(end)[key]
            assert (last.shape, last.dtype) == (leaf.shape, leaf.dtype), f"{key}: {last.shape}, {last.dtype} at the end"


@torch.no_grad()
def vehicles_of_a_batch_are_independent(make: Make) -> None:
    batch = BATCHES[1]
    estimator, samples = make(), random_samples(15, *batch)
    end, surge, _ = rollout(estimator, estimator.init(batch), samples)
    for element in itertools.product(*map(range, batch)):
        one: Any = (slice(None), *element)
        alone = at(samples, one)
        end1, surge1, _ = rollout(estimator, estimator.init(), alone)
        torch.testing.assert_close(surge[one], surge1, rtol=1e-12, atol=1e-12)
        assert_same(at(end, element), end1, rtol=1e-12, atol=1e-12)


@torch.no_grad()
def prediction_is_causal(make: Make) -> None:
    for batch in BATCHES:
        estimator, samples = make(), random_samples(12, *batch)
        _, surge, _ = rollout(estimator, estimator.init(batch), samples)
        other = samples.surge.clone()
        other[7] += 1.0
        _, changed, _ = rollout(estimator, estimator.init(batch), samples._replace(surge=other))
        assert torch.equal(surge[:8], changed[:8]), "a prediction knows the speed that it predicts"
        assert not torch.allclose(surge[8:], changed[8:]), "what was measured changes no prediction"


@torch.no_grad()
def bad_samples_are_masked(make: Make) -> None:
    for batch in BATCHES:
        estimator, samples = make(), troubled(*batch)
        state = estimator.init(batch)
        for k in range(12):
            before = state
            state, surge = estimator(state, at(samples, k))
            leaf_of = leaves(state)
            widths = leaf_of.pop("halfwidths", torch.zeros(1))  # infinite before ten errors
            assert (widths >= 0).all() and all(x.isfinite().all() for x in leaf_of.values()), f"not finite at step {k}"
            if k in (5, 6):  # stale: held, bit for bit
                assert surge.isnan().all()
                assert_same(state, before, rtol=0, atol=0, equal_nan=True)
            elif k == 7:  # a start: no prediction, nothing learned
                assert surge.isnan().all()
            else:
                assert surge.isfinite().all(), f"no finite prediction at step {k}"


@torch.no_grad()
def an_input_that_is_no_number_leaves_the_state_as_it_was(make: Make) -> None:
    """Even where the sample claims to be fresh and measured."""
    for field, value in BAD_INPUTS:
        estimator, samples = make(), random_samples(4, 2)
        state, _, _ = rollout(estimator, estimator.init((2,)), samples)
        sample = at(samples, 2)
        values = getattr(sample.inputs, field).clone()
        values[0] = value
        after, surge = estimator(state, sample._replace(inputs=sample.inputs._replace(**{field: values})))
        expected, _ = estimator(state, sample)
        assert surge[0].isnan() and surge[1].isfinite(), f"{field} is {value}: predicted {surge.tolist()}"
        for key, leaf in leaves(after).items():
            assert torch.equal(leaf[0], leaves(state)[key][0]), f"{field} is {value}: {key} changed"
            assert torch.equal(leaf[1], leaves(expected)[key][1]), f"{field} is {value}: {key} of another vehicle"


@torch.no_grad()
def a_start_is_the_speed_to_depart_from(make: Make) -> None:
    """After an outage nothing remembers the speed before it: only learned parameters may differ from a fresh start."""
    estimator, samples = make(), random_samples(5)
    state, _, _ = rollout(estimator, estimator.init(), samples)
    zero, no = torch.zeros((), dtype=torch.float64), torch.tensor(False)
    opening = Sample(Inputs(*[zero] * len(Inputs._fields)), zero + 1.3, no, no)
    started, _ = estimator(state, opening)
    again, _ = estimator(started, opening._replace(surge=zero + 0.2))
    again, _ = estimator(again, opening)
    assert_same(again, started, rtol=0, atol=0)
    for key, leaf in leaves(started).items():
        if key.split(".")[-1] == "surge":
            assert torch.equal(leaf, torch.full_like(leaf, 1.3)), f"{key}: {leaf.tolist()}, expected 1.3"


def resume_from_disk_is_exact(make: Make) -> None:
    for batch in BATCHES:
        samples = tree_map(lambda *x: torch.cat(x), troubled(*batch), random_samples(8, *batch, seed=3))
        whole, half, resumed = (Online(make(), batch) for _ in range(3))
        expected = [whole.step(at(samples, k)) for k in range(20)]
        for k in range(10):
            half.step(at(samples, k))
        with tempfile.TemporaryDirectory() as folder:
            resumed.restore(half.save(Path(folder, "a.safetensors")))
        resumed_surge = [resumed.step(at(samples, k)) for k in range(10, 20)]
        np.testing.assert_array_equal(resumed_surge, expected[10:])
        assert_same(resumed.state, whole.state, rtol=0, atol=0, equal_nan=True)


@torch.no_grad()
def steps_are_pure(make: Make) -> None:
    """Same arguments, same result; nothing that was given changes, nor does the estimator."""
    for batch in BATCHES:
        estimator, samples = make(), random_samples(6, *batch)
        state, _, _ = rollout(estimator, estimator.init(batch), samples)
        before, given, parameters = tree_map(torch.clone, state), tree_map(torch.clone, samples), io.BytesIO()
        torch.save(estimator.state_dict(), parameters)
        first, second = (estimator(state, at(samples, 2)) for _ in range(2))
        assert torch.equal(first[1], second[1]), "the same step predicts something else the second time"
        assert_same(first[0], second[0], rtol=0, atol=0)
        assert_same(state, before, rtol=0, atol=0)
        assert_same(samples, given, rtol=0, atol=0)
        after = io.BytesIO()
        torch.save(estimator.state_dict(), after)
        assert after.getvalue() == parameters.getvalue(), "a step changes the estimator: what is learned is state"


@torch.no_grad()
def learn_is_predict_and_update(make: Make) -> None:
    estimator, samples = make(), random_samples(6)
    state, _, _ = rollout(estimator, estimator.init(), samples)
    inputs, target = at(samples, 2).inputs, samples.surge[2]
    learned, surge = estimator.learn(state, inputs, target)
    assert torch.equal(surge, estimator.predict(state, inputs)[1]), "learn predicts something else than predict"
    assert_same(learned, estimator.update(state, inputs, target), rtol=0, atol=0)
    assert_same(learned, estimator(state, at(samples, 2))[0], rtol=0, atol=0)


def monitor_names_numbers_per_element(make: Make) -> None:
    estimator = make()
    for key, value in estimator.monitor(estimator.init((2, 3))).items():
        assert value.shape == (2, 3) and value.isfinite().all(), f"{key}: {tuple(value.shape)}, expected (2, 3), finite"


CONTRACTS: dict[str, Callable[[Make], None]] = {
    each.__name__: each
    for each in (
        shapes_and_dtypes, vehicles_of_a_batch_are_independent, prediction_is_causal, bad_samples_are_masked,
        an_input_that_is_no_number_leaves_the_state_as_it_was, a_start_is_the_speed_to_depart_from,
        resume_from_disk_is_exact, steps_are_pure, learn_is_predict_and_update, monitor_names_numbers_per_element,
    )
}  # fmt: skip
