"""The bound for weights that change: real joint trajectories stay within it, and it is not far above them."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from certify.errors import CertifyError
from certify.networks.vector import RELU, VectorWeights, activation, check, of_shallow
from certify.proofs.box_planes import Box
from certify.proofs.learning import bound, change_bound, gradient_bound, root_above, weight_distance
from tests.support import random_samples
from usvlearn.estimators.rnn.layer import RNN, lane_weights, network_inputs

BOX = Box(np.array([-1.0, 0.0, 0.0, 0.0, 0.0]), np.ones(5))  # x, heading, commands of `random_samples`


def joint_run(rate: float, steps: int, lanes: int = 2, kappa: float = 0.9):
    """The weights of every lane at every step, and the scaled speeds, of networks that learn from their estimates."""
    rnn, samples = RNN(feedback="estimate", rate=rate, contraction_rate=kappa), random_samples(steps, 1)
    surge = torch.linspace(-0.5, 1.5, lanes, dtype=torch.float64)
    state = rnn.init((lanes,))._replace(surge=surge)
    weights, x, inputs = [], [rnn.scale * state.surge.numpy()], []
    with torch.no_grad():
        for k in range(steps):
            now = type(samples.inputs)(*(x[k].expand(lanes) for x in samples.inputs))
            weights.append([of_shallow(lane_weights(state, lane)) for lane in range(lanes)])
            inputs.append(network_inputs(now)[0].numpy())
            state = rnn.update(state, now, samples.surge[k].expand(lanes))
            x.append(rnn.scale * state.surge.numpy())
    return list(zip(*weights, strict=True)), np.array(x), np.array(inputs)


@pytest.mark.parametrize("rate", [1e-3, 1e-2, 0.1])
def test_two_starts_that_learn_differently_stay_within_the_bound(rate):
    (first, second), x, u = joint_run(rate, 60)
    assert (np.abs(x[:, 1]) <= 1).all() and (u >= 0).all() and (u <= 1).all()
    found = bound(first, second, BOX, abs(x[0, 0] - x[0, 1]))
    apart = np.abs(x[:, 0] - x[:, 1])
    assert (apart <= found.steps + 1e-12).all()
    assert found.rate <= 0.9 + 1e-9 and (found.steps <= [found.after(k) for k in range(61)]).all()
    assert (apart > 0.9 ** np.arange(61) * apart[0] + 1e-12).any()  # the weights are not equal
    recorded = [Box(point, point) for point in np.column_stack([x[:-1, 1], u])]
    near = bound(first, second, recorded, abs(x[0, 0] - x[0, 1]))
    assert (apart <= near.steps + 1e-12).all() and (near.steps <= found.steps).all()
    largest = apart[20:].max()
    assert found.steps[20:].max() < 75 * largest  # measured 10, 22 and 50
    assert near.steps[20:].max() < 4 * largest  # measured 2.1, 2.7 and 2.1


def test_a_run_stays_near_the_free_run_of_frozen_weights():
    (weights,), x, u = joint_run(1e-3, 60, lanes=1)
    frozen = weights[-1]
    state, free = x[0, 0], [x[0, 0]]
    for inputs in u:
        z = frozen.W[:, 0] * state + frozen.W2 @ inputs + frozen.b
        state = float(frozen.A[0] @ np.maximum(z, 0))
        free.append(state)
    found = bound([frozen] * 60, weights, BOX, 0.0)
    apart = np.abs(np.array(free) - x[:, 0])
    assert (apart <= found.steps + 1e-12).all() and apart.max() > 1e-6 and found.limit < np.inf
    assert found.steps[0] == 0 and bound([frozen] * 3, [frozen] * 3, BOX, 0.5).limit == 0


@pytest.mark.parametrize(("name", "norm"), [("relu", "inf"), ("leaky:0.25", "one"), ("tanh", "inf"), ("tanh", "one")])
def test_vector_states_stay_within_the_bound(name, norm):
    rng, phi, T = (
        np.random.default_rng(0),
        activation(name),
        [[Fraction(2), Fraction(1, 2)], [Fraction(0), Fraction(1)]],
    )
    size = (lambda v: np.abs(np.array(T, float) @ v).max()) if norm == "inf" else (
        lambda v: np.abs(np.array(T, float) @ v).sum())  # fmt: skip
    start = check(
        VectorWeights(
            0.3 * np.eye(2), rng.normal(size=(2, 5)) / 9, rng.normal(size=(5, 2)) / 2, rng.normal(size=(5, 1)),
            rng.normal(size=5),
        )
    )  # fmt: skip

    def walk():
        now, found = start, []
        for _ in range(40):
            now = VectorWeights(*(None if w is None else w + 0.003 * rng.normal(size=w.shape) for w in now))
            found.append(now)
        return found

    def step(w, x, u):
        z = w.W @ x + w.W2 @ u + w.b
        return w.R @ x + w.A @ (np.tanh(z) if name == "tanh" else np.maximum(z, float(phi.least) * z))

    first, second, x, y = walk(), walk(), np.array([1.0, -1.0]), np.array([-1.0, 0.5])
    found = bound(
        first, second, Box(np.array([-2.0, -2.0, -1.0]), np.array([2.0, 2.0, 1.0])), size(x - y), phi, norm, T
    )
    assert found.rate < 1
    points, sizes, start_apart = [], [], size(x - y)
    for k in range(40):
        u = rng.uniform(-1, 1, 1)
        points.append(Box(np.r_[y, u], np.r_[y, u]))
        x, y = step(first[k], x, u), step(second[k], y, u)
        sizes.append(size(x - y))
        assert np.abs(y).max() <= 2 and sizes[-1] <= found.steps[k + 1]
    near = bound(first, second, points, start_apart, phi, norm, T).steps[1:]
    assert (sizes <= near * (1 + 1e-12)).all() and (near <= found.steps[1:]).all()
    assert near[20:].max() < 6 * max(sizes[20:])  # measured 1.2 to 1.5; by the one box 9 to 37


def test_the_gradient_bound_is_reached_at_a_corner_and_the_distance_is_euclidean():
    net = check(VectorWeights([[0.5]], [[2.0]], [[3.0]], [[1.0]], [0.5]))
    box = Box(np.array([-1.0, 0.0]), np.array([1.0, 1.0]))
    z, other = 4.5, net._replace(R=np.array([[0.25]]))
    assert gradient_bound(net, net, box) == root_above(Fraction(z) ** 2 + 3 * 4)
    assert gradient_bound(net, other, box) == root_above(1 + Fraction(z) ** 2 + 3 * 4)
    assert change_bound(net, other, box) == Fraction(1, 4) and change_bound(net, net, box) == 0
    point = Box(np.ones(2), np.ones(2))
    assert change_bound(net, net._replace(A=np.array([[2.5]]), b=np.array([-0.5])), point) == 2 * 4.5 - 2.5 * 3.5
    y, rows = torch.tensor([1.0, 1.0]), [torch.tensor(w, requires_grad=True) for w in (net.A, net.W, net.W2, net.b)]
    A, W, W2, b = rows
    (A @ (W @ y[:1].double() + W2 @ y[1:].double() + b).relu()).backward()
    assert sum(float((w.grad**2).sum()) for w in rows) == pytest.approx(z**2 + 12)
    assert weight_distance(net, other) == Fraction(1, 4) and weight_distance(net, net) == 0
    for x in (Fraction(2), Fraction(1, 3), Fraction(10) ** 40, Fraction(1, 10**40)):
        assert x <= root_above(x) ** 2 <= x * (1 + Fraction(1, 2**60))


def test_bounds_that_no_float_holds_are_infinite():
    one = VectorWeights(None, [[2.0]], [[1.0]], [[0.0]], [0.0])
    box = Box(np.zeros(2), np.ones(2))
    same, other = ([one] * 1100, [one._replace(A=[[1.5]])] * 1100)
    for second in (same, other):
        found = bound(same, second, box, 1.0)
        assert found.rate == 2 and found.steps[-1] == np.inf and (np.diff(found.steps[:1000]) > 0).all()
    assert found.limit == found.after(0) == found.after(1) == np.inf  # κ ≥ 1, and the weights differ
    found = bound(same, same, box, 1.0)
    assert (found.after(3), found.after(2000)) == (8.0, np.inf)
    with pytest.raises(CertifyError, match="kappa"):
        bound(same, other, box, 1.0, kappa=float("nan"))


def test_what_does_not_fit_is_said():
    one = VectorWeights(None, [[0.5]], [[1.0]], [[0.0]], [0.0])
    deep, box = one._replace(V=[[1.0]], c=[0.0]), Box(np.zeros(2), np.ones(2))
    for first, second, over, start in (
        ([one], [], box, 1.0),
        ([one], [deep], box, 1.0),
        ([deep], [deep], box, 1.0),
        ([one], [one], Box(np.zeros(3), np.ones(3)), 1.0),
        ([one], [one], Box(np.ones(2), np.zeros(2)), 1.0),
        ([one], [one], box, float("nan")),
        ([one], [one], box, -1.0),
    ):
        with pytest.raises(CertifyError):
            bound(first, second, over, start, RELU)
    assert bound([one._replace(A=[[2.0]])], [one], box, 1.0).limit == np.inf
