"""The kernels make torch's steps whatever stands in the samples, and whatever state they start from."""

import functools
import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings

from tests.support import ESTIMATORS, few, layers
from tests.support.kernel_cases import VARIANTS, difference, mission
from usvlearn import Inputs, Sample, rollout
from usvlearn.core.protocol import clean
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine.rollouts import simulate

EVERY = layers(ESTIMATORS | VARIANTS)
FAR = [math.nan, math.inf, -math.inf, 1e300, -1e300, 5e-324, 99.9, -100.0, 1e6, -0.0]
numbers = st.floats(-1.5, 1.5) | st.sampled_from(FAR) | st.floats()
spans = (
    st.sampled_from([0.0, -0.0, 0.4, 0.4, 1e-3, 30.0, 9999.0, 1e4, -0.4, math.nan, math.inf, -math.inf]) | st.floats()
)
ordinary = st.tuples(*[st.floats(-1.0, 1.0)] * 4, st.just(0.4), st.floats(-2.0, 2.0), *[st.just(True)] * 2)
anything = st.tuples(*[numbers] * 4, spans, numbers, st.booleans(), st.booleans())
steps = st.lists(ordinary | anything, min_size=1, max_size=12)


def of(rows) -> Sample:
    """Samples of one boat from rows of numbers."""
    *reals, fresh, measured = (np.array(column) for column in zip(*rows, strict=True))
    *inputs, surge = (torch.tensor(column, dtype=torch.float64) for column in reals)
    return Sample(Inputs(*inputs), surge, torch.tensor(fresh), torch.tensor(measured))


@functools.cache
def reachable(name: str, after: int):
    """An estimator, and its state after so many samples with faults."""
    estimator = EVERY[name]()
    with torch.no_grad():
        return estimator, rollout(estimator, estimator.init(), mission(after, seed=after))[0]


@pytest.mark.parametrize("run", few([rollout, simulate], [rollout], "thorough"), ids=lambda run: run.__name__)
@settings(deadline=None, derandomize=True, max_examples=150)
@given(name=st.sampled_from(sorted(EVERY)), after=st.sampled_from([1, 30, 100]), rows=steps)
def test_any_samples(run, name, after, rows):
    """Predictions are NaN where torch's are, states equal; they stay bit for bit where no step is made."""
    (estimator, state), samples = reachable(name, after), of(rows)
    leaves = [key for key, _ in named_leaves(state)]
    with torch.no_grad():
        found, expected = (run(estimator, state, samples, leaves, backend=backend) for backend in ("kernel", "torch"))
    assert torch.equal(found[1].isnan(), expected[1].isnan())
    for x, y in zip(found, expected, strict=True):
        assert difference(x, y) <= 1e-9
    use = clean(samples, estimator.surge_limit)
    for k in np.flatnonzero(~(use.steps | use.starts).numpy()):
        before = dict(named_leaves(state)) if k == 0 else {key: leaf[k - 1] for key, leaf in found[2].items()}
        assert found[1][k].isnan()
        assert difference({key: leaf[k] for key, leaf in found[2].items()}, before) == 0.0


@pytest.mark.thorough
@settings(deadline=None, derandomize=True, max_examples=100)
@given(name=st.sampled_from(sorted(EVERY)), rows=steps, scale=st.sampled_from([1e-9, 1e-3, 10.0, 1e4]))
def test_any_finite_state(name, rows, scale):
    """Also from states that no run has reached: every number that was learned is another."""
    (estimator, state), samples = reachable(name, 30), of(rows)
    shaken = tree_map(lambda x: x if x.dtype == torch.bool else x * scale, state)
    with torch.no_grad():
        found, expected = (rollout(estimator, shaken, samples, backend=backend) for backend in ("kernel", "torch"))
    assert torch.equal(found[1].isnan(), expected[1].isnan())
    assert difference(found[0], expected[0]) <= 1e-6
