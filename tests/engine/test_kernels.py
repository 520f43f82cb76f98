"""The compiled kernels make torch's steps: the same states and predictions, whatever the estimator and the samples.

A difference is relative to the largest entry of its leaf. Rounding differs by some 1e-16 a step (sums in another
order), and most estimators forget it as they forget their samples. Some enlarge it, whoever computes: covariances that
tell directions apart poorly, speeds fed back, steps of Adam whose gradient is all but zero. So many settings are held
against torch over windows, torch starting each from the kernels' state, and one of each family over 10⁴ steps straight.
"""

import copy
import itertools

import numpy as np
import pytest
import torch

from tests.support import ESTIMATORS, FAMILIES, each_family, few, layers
from tests.support.kernel_cases import CONDITIONS, LONG, VARIANTS, difference, failing_thrusters, mission
from usvlearn import RNN, Ensemble, Persistence, Robust, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine.rollouts import simulate
from usvlearn.estimators.ensemble.conformal.layer import LEAST
from usvlearn.estimators.ensemble.monitors.state import THRESHOLD
from usvlearn.estimators.rnn.projection_kernel import threshold

EVERY = layers(ESTIMATORS | VARIANTS)
every_setting = pytest.mark.parametrize("name", EVERY)
every_family = pytest.mark.parametrize("name", layers(FAMILIES))
each_batch = pytest.mark.parametrize("batch", [(2, 3), pytest.param((), marks=pytest.mark.thorough)], ids=str)
IN_CI = ("rls", "sift", "rnn")  # in the thorough tests; all others are slow
AMPLIFYING = ("ensemble",)  # the covariance of a member is inflated: torch, started one rounding away, ends 4e-7 away


@pytest.fixture(autouse=True)
def no_gradients():
    with torch.no_grad():
        yield


def part(samples, begin, end):
    return tree_map(lambda x: x[begin:end], samples)


def doubled(tree):
    return tree_map(lambda x: x.double() if x.is_floating_point() else x, tree)


def assert_equal(found, expected, tolerance):
    """Last states, predictions and records."""
    for what, x, y in zip(("state", "predictions", "record"), found, expected, strict=True):
        if y is not None:
            assert difference(x, y) <= tolerance, what


def assert_windows_equal(estimator, samples, window, tolerance, run=rollout):
    state = estimator.init(samples.surge.shape[1:])
    for begin in range(0, len(samples.surge), window):
        some = part(samples, begin, begin + window)
        found, expected = (run(estimator, state, some, backend=backend) for backend in ("kernel", "torch"))
        assert_equal(found, expected, tolerance)
        state = found[0]


@pytest.mark.parametrize("steps", few([2_000, 10_000], [2_000]))
@pytest.mark.thorough
@pytest.mark.parametrize("name", few(layers(LONG), IN_CI))
def test_thousands_of_steps(name, steps):
    estimator, samples = LONG[name](), mission(steps, 4)
    if name in AMPLIFYING:
        assert_windows_equal(estimator, samples, 50, 1e-9)
        return
    found, expected = (rollout(estimator, estimator.init((4,)), samples, backend=b) for b in ("kernel", "torch"))
    finite = expected[1][expected[1].isfinite()]
    assert len(finite) > 3.6 * steps and finite.std() > 0.1
    assert_equal(found, expected, 1e-9)


@every_setting
def test_every_estimator_and_setting(name):
    assert_windows_equal(EVERY[name](), mission(50, 2), 25, 1e-9)


@pytest.mark.thorough
@every_family
def test_single_precision(name):
    """The kernels' float32 is no further from float64 than torch's, by more than a few roundings' chance."""
    estimator, samples = EVERY[name]().to(torch.float32), mission(20, 2, dtype=torch.float32)
    double, state = copy.deepcopy(estimator).to(torch.float64), estimator.init((2,))
    for begin in range(0, 20, 5):
        some = part(samples, begin, begin + 5)
        truth = rollout(double, doubled(state), doubled(some), backend="torch")[:2]
        found, other = (rollout(estimator, state, some, backend=backend)[:2] for backend in ("kernel", "torch"))
        for x, y, exact in zip(found, other, truth, strict=True):
            assert difference(doubled(x), exact) <= 1e-5 + 10 * difference(doubled(y), exact)
        state = found[0]


@pytest.mark.thorough
def test_alarms_and_intervals_of_a_steady_boat():
    """Evidence that comes, is held at its highest, ends, and is dropped; intervals as narrow as they become."""
    ensemble, samples = Ensemble({"persistence": Persistence()}), failing_thrusters()
    names = ["monitors.thrusters.evidence", "monitors.thrusters.raised", "halfwidths"]
    expected = rollout(ensemble, ensemble.init(), samples, names)
    thrusters, evidence = expected[0].monitors.thrusters, expected[2]["monitors.thrusters.evidence"][:, 0]
    assert thrusters.alarms >= 1 and thrusters.raised.sum() == 0 and 0 < thrusters.since < 1000
    assert evidence.max() == 2 * THRESHOLD and (evidence.diff() < -THRESHOLD / 2).any()
    assert float(expected[2]["halfwidths"].min()) == pytest.approx(LEAST, rel=1e-12)  # a mean of two that are this


@pytest.mark.parametrize("name", layers(FAMILIES))
@each_batch
def test_batches(name, batch):
    assert_windows_equal(EVERY[name](), mission(40, *batch, seed=1), 20, 1e-9)


@every_family
def test_a_grid_of_hyperparameters(name):
    """Hyperparameters `(grid, 1)` beside a batch `(grid, boats)`, all at once, whose boats' samples the grid shares."""
    estimator, factors = FAMILIES[name](), torch.tensor([[0.9], [1.0], [1.1]], dtype=torch.float64)
    for parameter in estimator.parameters():
        if parameter.ndim == 0:
            parameter.data = parameter.data * factors
    samples = tree_map(lambda x: x[:, None].expand(40, 3, 2), mission(40, 2))
    assert_windows_equal(estimator, samples, 20, 1e-9)


@each_family(EVERY)
def test_free_runs(name):
    """`simulate`, from a state that has learned."""
    estimator, samples = EVERY[name](), mission(120, 2)
    state = rollout(estimator, estimator.init((2,)), part(samples, 0, 80), backend="kernel")[0]
    found, expected = (simulate(estimator, state, part(samples, 80, 120), backend=b) for b in ("kernel", "torch"))
    assert_equal(found, expected, 1e-9)


@pytest.mark.parametrize("run", [rollout, simulate], ids=lambda run: run.__name__)
@each_batch
@pytest.mark.parametrize("name", ["boa", "dynamic_sift"])
def test_records(name, batch, run):
    """By names of leaves, or by a function; over more steps than are held at a time."""
    estimator, samples = ESTIMATORS[name](), mission(300 if batch == () else 30, *batch)
    start = estimator.init(batch)
    names = [key for key, _ in named_leaves(start)][::2]
    records = names, lambda state: {"twice": [leaf for _, leaf in named_leaves(state)][-1] * 2}
    for record in records:
        found, expected = (run(estimator, start, samples, record=record, backend=b) for b in ("kernel", "torch"))
        assert_equal(found, expected, 1e-9)


@every_family
def test_what_was_given_stays_and_results_are_new(name):
    estimator, samples = EVERY[name](), mission(30, 2)
    state = rollout(estimator, estimator.init((2,)), samples, backend="kernel")[0]
    given, names = {"state": state, "samples": samples}, [name for name, _ in named_leaves(state)]
    before = tree_map(torch.clone, given)
    results = [dict(zip("abc", rollout(estimator, state, samples, names, backend="kernel"), strict=True)) for _ in "12"]
    assert difference(given, before) == 0.0 and difference(*results) == 0.0
    memory = [{leaf.untyped_storage().data_ptr() for _, leaf in named_leaves(tree)} for tree in (given, *results)]
    assert not (memory[0] & memory[1] or memory[0] & memory[2] or memory[1] & memory[2])


def test_shared_samples_equal_their_copies():
    """Batch elements along an axis of stride 0 share what is prepared of a sample."""
    estimator, single = ESTIMATORS["boa"](), mission(60, 2)
    for shared in (
        tree_map(lambda x: x[:, None].expand(60, 3, 2), single),
        tree_map(lambda x: x[:, :1, None].expand(60, 3, 2), single),
        tree_map(lambda x: x[:, :, None].expand(60, 2, 3), single),
        tree_map(lambda x: x.T.contiguous().T, single),
        single._replace(surge=single.surge[:, :1].expand(60, 2)),
    ):
        batch = shared.surge.shape[1:]
        copied = tree_map(torch.Tensor.contiguous, shared)
        found, expected = (rollout(estimator, estimator.init(batch), x, backend="kernel") for x in (shared, copied))
        assert_equal(found, expected, 0.0)


def test_threads_share_the_elements():
    estimator, samples = ESTIMATORS["boa"](), mission(40, 11)
    one = rollout(estimator, estimator.init((11,)), samples, record=["predictions"], backend="kernel")
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        two = rollout(estimator, estimator.init((11,)), samples, record=["predictions"], backend="kernel")
    finally:
        torch.set_num_threads(before)
    assert_equal(two, one, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("condition", CONDITIONS)
def test_every_network(condition):
    """All its choices with each other, at rates so high that the projection acts at every step."""
    samples = mission(60, 2)
    for gauge, unroll, momentum, decay, clip, initial, feedback, neurons in itertools.product(
        ("literal", "best"), (1, 2), (0.0, 0.9), (None, 10), (None, 0.1), ("random", "persistence"),
        ("measured", "estimate"), (5, 20),
    ):  # fmt: skip
        rnn = RNN(
            neurons, 3.0, initial, None, 0.03, (1, 2, 0.3, 1.5, 5), decay, momentum, clip, "project", condition, 0.8,
            gauge, unroll=unroll, feedback=feedback,
        )  # fmt: skip
        assert_windows_equal(rnn, samples, 10, 1e-9)


@pytest.mark.slow
@every_setting
def test_every_setting_for_long(name):
    """Over 1000 steps; alone, as a robust estimator's, and as a member of an ensemble."""
    # The literal condition's costs are 1/(1 − |w₁|): a neuron that creeps up to 1e-12 of 1 makes 1e-5 of a rounding.
    tolerance = 1e-4 if name.startswith(("rnn_gershgorin_literal", "rnn_gershgorin_regauged")) else 1e-9
    # From step 380 on, that of _1 in the ensemble lies within 3e-15 of 1: there a rounding is all that is left of it.
    window, steps = (5, 350) if name in ("rnn_gershgorin_literal_1", "forecasts_wrapped") else (20, 400)
    estimator = EVERY[name]()
    assert_windows_equal(estimator, mission(1000, 2, seed=2), window, tolerance)
    assert_windows_equal(estimator, mission(500, seed=3, faults=False), window, tolerance, simulate)
    if not isinstance(estimator, Ensemble):
        assert_windows_equal(Ensemble({"it": EVERY[name]()}), mission(steps, 2, seed=4), window, tolerance)
        if "robust" not in name and "refus" not in name and name != "rnn_clips":  # an error of 1e40 has no clipped one
            robust = Robust(EVERY[name](), threshold=1.0, patience=1)
            assert_windows_equal(robust, mission(400, 2, seed=5), window, tolerance)


def test_a_projection_ends_where_a_neuron_lies_on_the_threshold():
    """To rounding: whoever becomes zero in one round, and not in the next, must not keep the search going."""
    a = np.array([0.7697867137638703, 0.5409735239361947, 0.5165276355285291, 0.15141619292868486])
    cost = np.array([0.9132702392002724, 1.0127555772777217, 0.7066357757671798, 0.6436249914654228])
    theta, _ = threshold(a, cost, 1.0609103068595371)
    assert abs(cost @ np.maximum(a - theta * cost, 0) - 1.0609103068595371) < 1e-12
