"""The network of surge, sway and yaw rate: its gradient, its masks, what it learns, and that it contracts meanwhile."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from certify.networks.vector import RELU, VectorWeights, check, load
from certify.proofs import vector_exact
from usvlearn import Inputs, VectorRNN, VectorSample
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.errors import ConfigError, ShapeError
from usvlearn.estimators.vector_rnn.equations import gradient, network
from usvlearn.estimators.vector_rnn.state import Kept, NetworkWeights
from usvlearn.simulate.planar import planar_runs

MAXIMA = (2.75, 0.25, 0.75)


def tensors(samples: VectorSample) -> VectorSample:
    return tree_map(torch.from_numpy, samples)


def at(samples: VectorSample, k) -> VectorSample:
    return tree_map(lambda x: x[k], samples)


def same(one, other) -> bool:
    return all(torch.equal(x, y) for (_, x), (_, y) in zip(named_leaves(one), named_leaves(other), strict=True))


@pytest.fixture(scope="module")
def boat():
    """Two runs of 2 minutes, leaves (time, 2)."""
    return tensors(planar_runs(0, 2.0, 2)[0])


def drawn(seed: int = 0, steps: int = 6, q: int = 3, n: int = 7, m: int = 2) -> tuple[NetworkWeights, Kept]:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    weights = NetworkWeights(normal(q, q) / 3, normal(q, n) / 3, normal(n, q), normal(n, m), normal(n))
    mask = (torch.rand(steps, q, generator=generator) > 0.3).double()
    led = torch.tensor([1.0, 1, 0, 1, 1, 1][:steps]).double()
    zero = torch.zeros(()).double()
    return weights, Kept(normal(steps, q), normal(steps, m), normal(steps, q), mask, led, zero, zero)


def together(*windows: Kept) -> Kept:
    """With the axis B."""
    return tree_map(lambda *x: torch.stack(x), *windows)


def loss(weights: NetworkWeights, window: Kept) -> torch.Tensor:
    """(2) of one window, step by step."""
    total, x, steps = torch.zeros(()).double(), window.before[0], len(window.before)
    for k in range(steps):
        if k > 0 and not window.successive[k]:
            x = window.before[k]
        x, _ = network(weights, x, window.inputs[k])
        total = total + (window.weight[k] * (x - window.target[k]).square()).sum()
    return total / (2 * steps)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("steps", [1, 2, 6])
@torch.enable_grad()
def test_the_gradient_is_that_of_autograd(seed, steps):
    weights, window = drawn(seed, steps)
    leaves = [w.requires_grad_() for w in weights]
    found = torch.autograd.grad(loss(NetworkWeights(*leaves), window), leaves)
    expected = torch.cat([g.flatten() for g in found])
    weights = NetworkWeights(*(w.detach() for w in weights))
    torch.testing.assert_close(gradient(weights, together(window)), expected)
    other = drawn(seed + 99, steps)[1]
    mean = (gradient(weights, together(window)) + gradient(weights, together(other))) / 2
    torch.testing.assert_close(gradient(weights, together(window, other)), mean)


def test_it_starts_as_persistence(boat):
    rnn = VectorRNN(MAXIMA, contraction_rate=0.99)
    state, _ = rnn(rnn.init((2,)), at(boat, 0))
    _, predicted = rnn.predict(state, at(boat, 1).inputs)
    torch.testing.assert_close(predicted, 0.99 * boat.velocity[0], atol=1e-9, rtol=1e-6)


@pytest.mark.thorough
def test_every_set_while_learning_contracts_in_fractions(boat):
    """At a rate of learning that is far too high, and with measurements that are wrong."""
    rnn = VectorRNN(MAXIMA, rate=0.5, scaling=(1.0, 0.3, 0.8), kept=50, window=5, windows=3).requires_grad_(False)
    state, loose = rnn.init((2,)), VectorRNN(MAXIMA, rate=0.5, stability="none", kept=50).requires_grad_(False)
    free = loose.init((2,))
    wrong = boat._replace(velocity=torch.where(torch.arange(601)[:, None, None] % 7 == 0, 90.0, boat.velocity))
    T = vector_exact.matrix(np.diag([1.0, 0.3, 0.8]))
    largest = Fraction(0)
    for k in range(60):
        state, _ = rnn(state, at(wrong, k))
        free, _ = loose(free, at(wrong, k))
        for element in range(2):
            weights = check(VectorWeights(*(w[element].numpy() for w in state.weights)))
            rate = vector_exact.rate(weights, vector_exact.everywhere(weights, RELU), scaling=T)
            assert rate <= Fraction(0.999)
            largest = max(largest, rate)
    assert largest > Fraction(0.99)  # the limit was reached
    assert float(loose.monitor(free)["contraction_rate"].min()) > 1


@pytest.mark.thorough
def test_two_starts_contract_while_the_weights_learn(boat):
    """Weights learned by one trajectory, applied to two: the distance shrinks by κ at every step."""
    t = torch.tensor([1.0, 0.3, 0.8]).double() / torch.tensor(MAXIMA).double()
    rnn = VectorRNN(MAXIMA, rate=5e-3, scaling=(1.0, 0.3, 0.8), contraction_rate=0.98, kept=50).requires_grad_(False)
    boat = tree_map(lambda x: x[:200, 0], boat)
    state = rnn.init()
    x, y = torch.tensor([2.0, 0.1, 0.3]).double(), torch.tensor([-1.0, -0.2, -0.5]).double()
    for k in range(1, 200):
        before = (t * (x - y)).abs().max()
        inputs = at(boat, k).inputs
        x, y = (rnn.predict(rnn.start(state, each), inputs)[1] for each in (x, y))
        assert (t * (x - y)).abs().max() <= 0.98 * before + 1e-12
        state, _ = rnn(state, at(boat, k))


@pytest.mark.slow
def test_what_is_learned_simulates_better_than_a_linear_fit():
    """On the simulated boat, which is not linear; the linear fit knows the same run."""
    train, test = tensors(planar_runs(0, 20.0, 1)[0]), tensors(planar_runs(1, 3.0, 4)[0])
    rnn = VectorRNN(MAXIMA, rate=1e-3, stability="none").requires_grad_(False)
    state, _ = rnn.rollout(rnn.init((1,)), train)
    state = tree_map(lambda x: x.expand(4, *x.shape[1:]), state)
    _, free = rnn.rollout(state, test, learn=False)
    x = torch.cat([train.velocity[:-1, 0], torch.stack(train.inputs[:2], -1)[1:, 0]], -1)
    fit = torch.linalg.lstsq(x, train.velocity[1:, 0]).solution
    linear = [test.velocity[0]]
    for k in range(1, len(test.velocity)):
        linear.append(torch.cat([linear[-1], torch.stack(test.inputs[:2], -1)[k]], -1) @ fit)
    errors = [(each[1:] - test.velocity[1:]).abs().mean((0, 1)) for each in (free, torch.stack(linear))]
    assert (errors[0][1:] < errors[1][1:]).all(), errors


@pytest.mark.thorough
def test_a_component_that_is_missing_is_not_learned_from_and_coasts(boat):
    """Its number does not matter, and the network predicts on from its own."""
    one = tree_map(lambda x: x[:30, 0], boat)
    mask = one.measured.clone()
    mask[5:, 1] = False
    rnn = VectorRNN(MAXIMA, kept=20).requires_grad_(False)
    found = []
    for value in (torch.nan, torch.inf, 5.0):
        velocity = torch.where(mask, one.velocity, value)
        found.append(rnn.rollout(rnn.init(), one._replace(velocity=velocity, measured=mask)))
    for state, predictions in found:
        assert predictions[1:].isfinite().all()
        assert all(
            torch.equal(x, y) for (_, x), (_, y) in zip(named_leaves(found[0][0]), named_leaves(state), strict=True)
        )
    before = rnn.rollout(rnn.init(), one._replace(measured=mask))[0]
    assert torch.equal(before.velocity[[0, 2]], one.velocity[-1, [0, 2]])
    torch.testing.assert_close(before.velocity[1], found[0][1][-1, 1])


def test_a_bad_sample_changes_nothing(boat):
    one = tree_map(lambda x: x[:40, 0], boat)
    rnn = VectorRNN(MAXIMA, kept=20).requires_grad_(False)
    state, _ = rnn.rollout(rnn.init(), one)
    good = at(one, 39)
    bad = [
        good._replace(fresh=torch.tensor(False)),
        good._replace(inputs=good.inputs._replace(command_left=torch.tensor(torch.nan).double())),
        good._replace(inputs=good.inputs._replace(heading=torch.tensor(torch.inf).double())),
        good._replace(inputs=good.inputs._replace(dt=torch.tensor(-1.0).double())),
    ]
    for sample in bad:
        after, predicted = rnn(state, sample)
        assert predicted.isnan().all()
        assert same(after, state)
    nothing = good._replace(velocity=good.velocity * torch.nan)
    coasted, predicted = rnn(state, nothing)
    assert predicted.isfinite().all() and torch.equal(coasted.velocity, predicted) and not coasted.unbroken
    assert all(torch.equal(x, y) for x, y in zip(coasted.weights, state.weights, strict=True))


@pytest.mark.thorough
def test_elements_do_not_mix_and_a_window_never_joins_two_segments(boat):
    """One batch element after the other as alone; and after a start the oldest samples are of no influence once M new
    ones came.
    """
    rnn = VectorRNN(MAXIMA, kept=8, window=4, windows=3).requires_grad_(False)
    both, _ = rnn.rollout(rnn.init((2,)), tree_map(lambda x: x[:40], boat))
    for element in range(2):
        alone, _ = rnn.rollout(rnn.init(), tree_map(lambda x, element=element: x[:40, element], boat))
        for (_, x), (_, y) in zip(named_leaves(both), named_leaves(alone), strict=True):
            torch.testing.assert_close(x[element], y)
    # a window with a start within it: its gradient is the sum of those of its parts
    weights, window = drawn(1)
    parts = [tree_map(lambda x: x[slice_] if x.ndim else x, window) for slice_ in (slice(0, 2), slice(2, 6))]  # noqa: B023
    joined, first, second = (gradient(weights, together(each)) for each in (window, *parts))
    torch.testing.assert_close(6 * joined, 2 * first + 4 * second)


def test_windows_of_kept_samples_are_in_the_order_of_time(boat):
    """Each sample's target is what the next one departs from, also where the ring is full."""
    rnn = VectorRNN(MAXIMA, kept=16, window=5, windows=4).requires_grad_(False)
    state = rnn.init()
    for k in range(50):
        state, _ = rnn(state, tree_map(lambda x, k=k: x[k, 0], boat))
        windows, _ = rnn._windows(state.kept)
        follows = windows.successive[:, 1:] > 0
        expected = torch.where(follows[..., None], windows.target[:, :-1], 0.0)
        torch.testing.assert_close(torch.where(follows[..., None], windows.before[:, 1:], 0.0), expected)
        if k >= 5:
            assert follows[0].all()
            torch.testing.assert_close(windows.target[0, -1] * rnn.maxima, boat.velocity[k, 0])
        assert (windows.weight.sum() > 0) == (k > 0)


def test_the_saved_weights_are_those_that_certify_reads(boat, tmp_path):
    rnn = VectorRNN(MAXIMA, kept=20).requires_grad_(False)
    state, _ = rnn.rollout(rnn.init((2,)), tree_map(lambda x: x[:50], boat))
    rnn.save(state, tmp_path / "boat.npz")
    networks = load(tmp_path / "boat.npz")
    assert [each.path[-3:] for each in networks] == ["[0]", "[1]"]
    for element, each in enumerate(networks):
        for name, w in state.weights._asdict().items():
            assert np.array_equal(getattr(each.weights, name), w[element].numpy())
    with np.load(tmp_path / "boat.npz") as file:
        assert file["maxima"].tolist() == list(MAXIMA)


def test_a_heading_is_an_input_where_asked_for():
    rnn = VectorRNN(MAXIMA, heading=True)
    one = torch.ones(2).double()
    found = rnn.network_inputs(Inputs(one, 2 * one, one * torch.pi / 2, one, one))
    torch.testing.assert_close(found, torch.tensor([[1.0, 2.0, 1.0, 0.0]] * 2).double())
    assert rnn.init((2,)).weights.W2.shape == (2, 20, 4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"maxima": ()}, "maxima: found 0 numbers"),
        ({"maxima": (1.0, -1.0)}, "maxima: found -1.0"),
        ({"maxima": 3.0}, r"maxima: found 3.0, expected numbers, one for each .*: write \(3.0,\)"),
        ({"maxima": "3"}, "maxima: found '3', expected numbers, .*: give a tuple"),
        ({"maxima": None}, "maxima: found None"),
        ({"scaling": 2.0}, r"scaling: found 2.0, expected numbers, 3, as maxima has: write \(2.0,\)"),
        ({"importance": 2}, "importance: found 2, expected numbers"),
        ({"rate_ratio": 1.0}, "rate_ratio: found 1.0, expected numbers, five of 0 or more"),
        ({"neurons": 4}, "neurons: found 4, expected a whole number, 5 … 1000"),
        ({"window": 11, "kept": 10}, "window: found 11, expected a whole number, 1 … 10"),
        ({"windows": True}, "windows: found True"),
        ({"condition": "tight"}, "condition: found 'tight', expected one of exact, gershgorin"),
        ({"stability": "penalty"}, "stability: found 'penalty'"),
        ({"scaling": (1.0, 1.0)}, "scaling: found 2 numbers, expected 3"),
        ({"scaling": (1.0, 1.0, 1.0), "condition": "gershgorin"}, "expected none for gershgorin"),
        ({"importance": (1.0,)}, "importance: found 1 numbers, expected 3"),
        ({"rate_ratio": (1.0,)}, "rate_ratio: found .* expected five numbers"),
        ({"contraction_rate": 1.5}, "contraction_rate"),
    ],
)
def test_errors_name_what_was_expected(arguments, message):
    with pytest.raises(ConfigError, match=message):
        VectorRNN(**arguments)


def narrow(samples: VectorSample, name: str) -> VectorSample:
    return samples._replace(**{name: getattr(samples, name)[..., :2]})


@pytest.mark.parametrize("learn", [True, False])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: narrow(x, "velocity"), "velocity: found 2 components, expected 3, as maxima has: give"),
        (lambda x: narrow(x, "measured"), "measured: found 2 components, expected 3"),
        (lambda x: tree_map(lambda leaf: leaf.numpy(), x), "command_left is ndarray, expected a torch tensor: convert"),
        (lambda x: tree_map(lambda leaf: leaf[:0], x), "found no sample, expected .* at least one step"),
        (lambda x: tree_map(lambda leaf: leaf[0, 0], x), "found no axis of time"),
        (lambda x: tree_map(lambda leaf: leaf[:, 0], x), r"batch \(\), the state \(2,\): make the state by rnn.init"),
        (lambda x: tree_map(lambda leaf: leaf[:, :1], x), r"batch \(1,\), .* make the state by rnn.init\(\(1,\)\)"),
        (lambda x: x._replace(measured=x.measured.double()), r"measured is torch.float64, .* with .bool\(\)"),
        (lambda x: x._replace(fresh=x.fresh[1:]), r"fresh has the axes \(600, 2\) .*, velocity \(601, 2\)"),
        (lambda x: x._replace(velocity=torch.tensor(1.0)), "velocity: found one number without an axis"),
        (lambda x: ("run", x), "found tuple, expected a VectorSample: .* field samples"),
    ],
)
def test_samples_that_do_not_fit_are_refused_in_one_sentence(boat, change, message, learn):
    rnn = VectorRNN(MAXIMA, kept=20)
    with pytest.raises(ShapeError, match=message) as error:
        rnn.rollout(rnn.init((2,)), change(boat), learn=learn)
    assert "\n" not in str(error.value) and len(str(error.value)) < 250


def test_a_state_of_no_batch_is_refused_for_samples_with_one(boat):
    rnn = VectorRNN(MAXIMA, kept=20)
    one = tree_map(lambda x: x[:, :1], boat)
    with pytest.raises(ShapeError, match=r"the batch \(1,\), the state \(\): make the state by rnn.init\(\(1,\)\)"):
        rnn.rollout(rnn.init(), one)
    with pytest.raises(ShapeError, match=r"rnn.init\(\(\)\)"):
        rnn.rollout(rnn.init((1,)), tree_map(lambda x: x[:, 0], one))


def test_a_state_of_another_network_is_refused(boat):
    rnn, surge = VectorRNN(MAXIMA, kept=20), VectorRNN((3.0,), kept=20)
    with pytest.raises(ShapeError, match="the state's velocity: found 1 components, expected 3"):
        rnn.rollout(surge.init((2,)), boat)


def test_a_single_step_refuses_a_velocity_of_other_components(boat):
    rnn = VectorRNN(MAXIMA, kept=20)
    state, one = rnn.init((2,)), at(boat, 1)
    with pytest.raises(ShapeError, match="velocity: found 2 components, expected 3"):
        rnn.start(state, one.velocity[..., :2])
    with pytest.raises(ShapeError, match="velocity: found ndarray, expected a torch tensor"):
        rnn.start(state, one.velocity.numpy())
    with pytest.raises(ShapeError, match="velocity: found 1 components, expected 3"):
        rnn.update(state, one.inputs, one.velocity[..., :1])
    with pytest.raises(ShapeError, match="measured: found 2 components, expected 3"):
        rnn.update(state, one.inputs, one.velocity, one.measured[..., :2])


def test_a_file_is_written_completely_or_not_at_all(boat, tmp_path, monkeypatch):
    rnn = VectorRNN(MAXIMA, kept=20)
    state = rnn.init()
    path = rnn.save(state, tmp_path / "new" / "folder" / "boat")
    assert path == tmp_path / "new" / "folder" / "boat.npz" and len(load(path)) == 1
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(ConfigError, match=r"boat\.npz: cannot be written \(No space"):
        patch.setattr("os.replace", full)
        rnn.save(rnn.init((2,)), path)
    assert path.read_bytes() == before and [each.name for each in path.parent.iterdir()] == ["boat.npz"]
    with pytest.raises(ConfigError, match=r"cannot be written \(.*\): give a file in a folder that can be written"):
        rnn.save(state, path / "below.npz")
