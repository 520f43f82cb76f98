"""Projections of networks with a vector state: inside in fractions, and nearest by a quadratic program."""

import itertools
from fractions import Fraction

import cvxpy as cp
import numpy as np
import pytest
import torch

from certify.errors import CertifyError
from certify.networks.vector import RELU, VectorWeights, check
from certify.proofs import vector_exact
from certify.search.vector_scaling import best_diagonal
from certify.training.vector_projections import project
from certify.training.vector_rates import rate
from tests.support import cases, few

KAPPA = 0.999


def networks(batch, q: int = 3, n: int = 6, size: float = 1.0, seed: int = 0, dtype=torch.float64) -> VectorWeights:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return (size * torch.randn((*batch, *shape), generator=generator, dtype=torch.float64)).to(dtype)

    return VectorWeights(normal(q, q), normal(q, n), normal(n, q), normal(n, 2), normal(n))


def single(weights: VectorWeights, k: int) -> VectorWeights:
    return check(VectorWeights(*(None if x is None else x[k].double().numpy() for x in weights)))


def exact_rate(weights: VectorWeights, scaling=None) -> Fraction:
    """In rational arithmetic."""
    T = None if scaling is None else vector_exact.matrix(np.diag(scaling.double().numpy()))
    return vector_exact.rate(weights, vector_exact.everywhere(weights, RELU), scaling=T)


SIZES = [(1, 5, 1.0), (2, 6, 30.0), (3, 20, 1.0), (3, 5, 1e-3), (4, 7, 1e6)]
DTYPES = (torch.float32, torch.float64)
EACH_ONCE = [(sizes, DTYPES[k % 2]) for k, sizes in enumerate(SIZES)]


@pytest.mark.parametrize(("sizes", "dtype"), few(itertools.product(SIZES, DTYPES), EACH_ONCE, "thorough"))
@cases(50, 200)
def test_every_projected_network_has_the_rate_in_fractions(sizes, dtype, count):
    weights = networks((count,), *sizes, dtype=dtype)
    T = torch.linspace(0.3, 2.0, sizes[0], dtype=dtype)
    for scaling, rounds in ((None, 8), (T, 8), (T, 0)):
        near = project(weights, KAPPA, scaling, rounds=rounds)
        assert max(exact_rate(single(near, k), scaling) for k in range(count)) <= Fraction(KAPPA)


@pytest.mark.parametrize(
    "seeds", [*few([range(12), range(12, 40)], [range(12)], "thorough"), *few([range(40, 2000)], ())]
)
def test_networks_of_adverse_weights_have_the_rate_in_fractions(seeds):
    """Weights of very different sizes, whose sums cancel, or that lie on the limit."""
    for case in seeds:
        rng = np.random.default_rng(case)
        q, n = int(rng.integers(1, 5)), int(rng.integers(1, 9))
        dtype = (torch.float32, torch.float64)[case % 2]
        drawn = networks((), q, n, seed=case)
        spread = VectorWeights(*(x * 10.0 ** torch.from_numpy(rng.integers(-9, 10, x.shape)) for x in drawn[:5]))
        cancelling = drawn._replace(W=drawn.W - drawn.W.mean(-1, keepdim=True), A=1e7 * drawn.A)
        on_limit = project(drawn, KAPPA)
        whole = VectorWeights(*((3 * x).round() for x in drawn[:5]))
        for weights in (spread, cancelling, on_limit, whole):
            weights = VectorWeights(*(x.to(dtype) for x in weights[:5]))
            T = torch.from_numpy(10.0 ** rng.uniform(-3, 3, q)).to(dtype)
            for scaling in (None, T):
                near = project(weights, KAPPA, scaling)
                assert exact_rate(single(VectorWeights(*(x[None] for x in near[:5])), 0), scaling) <= Fraction(KAPPA)


def nearest_distance(weights: VectorWeights, kappa: float) -> float:
    """By a quadratic program."""
    R, A, W = weights.R, weights.A, weights.W
    x, y = cp.Variable(R.shape), cp.Variable(A.shape)
    limits = [
        x @ eps + cp.sum(cp.pos(cp.multiply(y, np.tile(W @ eps, (len(R), 1)))), axis=1) <= kappa
        for eps in np.array(list(itertools.product((-1.0, 1.0), repeat=len(R))))
    ]
    problem = cp.Problem(cp.Minimize(cp.sum_squares(x - R) + cp.sum_squares(y - A)), limits)
    return float(problem.solve(solver="CLARABEL")) ** 0.5


def distance(near: VectorWeights, weights: VectorWeights) -> torch.Tensor:
    return ((near.R - weights.R).square().sum((-1, -2)) + (near.A - weights.A).square().sum((-1, -2))).sqrt()


@cases(3, 10)
def test_many_rounds_reach_the_nearest_network(count):
    weights = networks((count,))
    nearest = torch.tensor([nearest_distance(single(weights, k), KAPPA) for k in range(count)])
    assert (distance(project(weights, KAPPA, rounds=500), weights) / nearest - 1).abs().max() < 1e-4


def test_few_rounds_suffice_after_a_small_step():
    """As they are after a step of learning from a network on the limit."""
    start = project(networks((10,), n=20, seed=1), KAPPA, rounds=200)
    step = networks((10,), n=20, size=1e-3, seed=2)
    weights = VectorWeights(start.R + step.R, start.A + step.A, *start[2:5])
    nearest = torch.tensor([nearest_distance(single(weights, k), KAPPA) for k in range(10)])
    ratio = distance(project(weights, KAPPA), weights) / nearest
    assert ratio.median() < 1.05 and ratio.max() < 1.3


def test_one_state_without_skip_is_the_projection_of_the_shallow_network():
    from certify.networks.shallow import ShallowWeights
    from certify.training.projections import project as project_shallow

    weights = networks((50,), q=1)
    # a large distance of R is no option for the shallow network: compare where R is far inside
    inside = weights._replace(R=0 * weights.R)
    near = project(inside, 0.7, rounds=200)
    shallow = project_shallow(ShallowWeights(weights.A[:, 0], weights.W[..., 0], weights.W2, weights.b), rate=0.7)
    assert (distance(near, inside) <= distance(inside._replace(A=shallow.a[:, None]), inside) + 1e-9).all()
    assert (rate(inside._replace(A=shallow.a[:, None])) <= 0.7).all()


def test_a_network_inside_is_unchanged():
    weights = networks((20,), size=0.05)
    near = project(weights, KAPPA)
    assert (rate(weights) < 0.9).all()
    assert all(torch.equal(x, y) for x, y in zip(near[:5], weights[:5], strict=True))


@pytest.mark.parametrize("condition", ["exact", "gershgorin"])
def test_batches_do_not_mix(condition):
    weights = networks((2, 3))
    near = project(weights, torch.tensor([0.3, 0.6, 0.9]).double(), condition=condition)
    for i, j in itertools.product(range(2), range(3)):
        alone = project(VectorWeights(*(x[i, j] for x in weights[:5])), (0.3, 0.6, 0.9)[j], condition=condition)
        torch.testing.assert_close(near.A[i, j], alone.A)
        torch.testing.assert_close(near.R[i, j], alone.R)


def test_the_gradient_is_that_of_finite_differences():
    weights = networks((), q=2, n=3, seed=5)

    def f(R, A, W):
        near = project(weights._replace(R=R, A=A, W=W), 0.8)
        return near.R, near.A

    given = [x.requires_grad_() for x in (weights.R, weights.A, weights.W)]
    assert torch.autograd.gradcheck(f, given)


def test_two_trajectories_contract_under_any_sequence_of_projected_weights():
    q, n, scaling = 3, 8, torch.tensor([1.0, 0.4, 2.0]).double()
    raw = networks((200,), q, n, seed=3)
    weights = project(raw, KAPPA, scaling)
    generator = torch.Generator().manual_seed(0)
    x, y = (5 * torch.randn(64, q, generator=generator, dtype=torch.float64) for _ in range(2))
    loose = [x, y]
    first = (scaling * (x - y)).abs().amax(-1)
    for k in range(200):
        u = torch.randn(64, 2, generator=generator, dtype=torch.float64)

        def step(weights, x, k=k, u=u):
            z = x @ weights.W[k].T + u @ weights.W2[k].T + weights.b[k]
            return x @ weights.R[k].T + z.relu() @ weights.A[k].T

        x, y = step(weights, x), step(weights, y)
        after = (scaling * (x - y)).abs().amax(-1)
        assert (after <= KAPPA ** (k + 1) * first + 1e-9).all()
        loose = [step(raw, each) for each in loose] if k < 5 else loose
    assert ((scaling * (loose[0] - loose[1])).abs().amax(-1) > first).all()  # the raw weights do not contract


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_lemma_holds_in_fractions_and_rescaling_changes_no_output(dtype):
    weights = networks((200,), n=8, dtype=dtype)
    near = project(weights, 0.9, condition="gershgorin")
    for k in range(200):
        margin, smallest = vector_exact.gershgorin(single(near, k))
        assert margin > 0 and smallest is not None and smallest <= Fraction(0.9)
    # where R and A were not scaled, the network is the same function
    small = VectorWeights(1e-4 * weights.R, 1e-4 * weights.A, *weights[2:5])
    gauged = project(small, 0.9, condition="gershgorin")
    x, u = torch.ones(200, 3, dtype=dtype), torch.ones(200, 2, dtype=dtype)

    def f(w):
        z = (w.W @ x[..., None] + w.W2 @ u[..., None])[..., 0] + w.b
        return (w.R @ x[..., None] + w.A @ z.relu()[..., None])[..., 0]

    torch.testing.assert_close(f(gauged), f(small))
    assert not torch.equal(gauged.W, small.W)


def test_many_rounds_reach_the_nearest_network_of_the_lemma():
    """With W of ‖W_i‖₁ = ½, by a quadratic program."""
    drawn = networks((10,), n=5)
    weights = drawn._replace(W=drawn.W / (2 * drawn.W.abs().sum(-1, keepdim=True)))
    near = project(weights, 0.9, condition="gershgorin", rounds=300)
    for k in range(10):
        R, A, W, *_ = single(weights, k)
        x, y = cp.Variable(R.shape), cp.Variable(A.shape)
        share = 2 * cp.sum(cp.abs(y), axis=0) @ np.abs(W)  # ‖W_i‖₁ = ½ leaves ½
        sums = cp.sum(cp.abs(x), axis=1) + cp.sum(cp.abs(x), axis=0) + cp.sum(cp.abs(y), axis=1) + share
        problem = cp.Problem(cp.Minimize(cp.sum_squares(x - R) + cp.sum_squares(y - A)), [sums <= 1.8])
        nearest = float(problem.solve(solver="CLARABEL")) ** 0.5
        assert abs(float(distance(near, weights)[k]) / nearest - 1) < 1e-4


def test_the_best_scaling_of_a_linear_map_reaches_its_spectral_radius():
    rng = np.random.default_rng(0)
    for q in (1, 2, 3, 4):
        R = rng.normal(size=(q, q))
        weights = VectorWeights(R, np.zeros((q, 1)), np.zeros((1, q)), np.zeros((1, 2)), np.zeros(1))
        T = torch.from_numpy(best_diagonal(weights))
        radius = np.abs(np.linalg.eigvals(np.abs(R))).max()
        assert radius - 1e-9 <= float(exact_rate(check(weights), T)) < 1.001 * radius


def test_the_best_scaling_of_a_network_is_no_worse_than_a_grid():
    for k in range(3):
        weights = single(networks((3,), q=2, seed=9), k)
        grid = min(
            float(exact_rate(weights, torch.tensor([1.0, each]).double())) for each in np.exp(np.linspace(-6, 6, 200))
        )
        assert float(exact_rate(weights, torch.from_numpy(best_diagonal(weights)))) <= grid * 1.0001


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"condition": "tight"}, "condition: found 'tight', expected one of exact, gershgorin"),
        ({"rate": 1.5}, r"rate: found 1.5, expected a number in \(0, 1]"),
        ({"scaling": torch.ones(2)}, r"scaling: found the shape \(2,\), expected the shape \(3,\)"),
        ({"scaling": torch.ones(3), "condition": "gershgorin"}, "expected no scaling for gershgorin"),
    ],
)
def test_errors_name_the_fix(change, message):
    with pytest.raises(CertifyError, match=message):
        project(networks(()), **change)


def test_two_hidden_layers_are_refused():
    weights = networks(())._replace(V=torch.eye(6), c=torch.zeros(6))
    with pytest.raises(CertifyError, match="two hidden layers"):
        project(weights)
