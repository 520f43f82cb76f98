"""Projections: nearest (a quadratic program, many starts), inside exactly, differentiable, and what they guarantee."""

from fractions import Fraction

import cvxpy as cp
import numpy as np
import pytest
import torch

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.training import conditions
from certify.training.projections import project
from tests.support import cases, few, over
from tests.support.placement import on_device

BOUNDS = torch.tensor([0.0, 0, 0, -1, -1]).double(), torch.ones(5).double()
CASES = [("simple", "literal"), ("simple", "best"), ("gershgorin", "literal"), ("gershgorin", "best"),
         ("lmi", "literal"), ("exact", "literal"), ("interval", "literal")]  # fmt: skip


def networks(batch, n: int = 6, size: float = 1.0, seed: int = 0, dtype=torch.float64) -> ShallowWeights:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return (size * torch.randn((*batch, *shape), generator=generator, dtype=torch.float64)).to(dtype)

    return ShallowWeights(normal(n), normal(n), normal(n, 4), normal(n))


def single(weights: ShallowWeights, k: int) -> ShallowWeights:
    return ShallowWeights(*(x[k] for x in weights))


def exact_rate(weights: ShallowWeights, condition: str, gauge: str) -> Fraction:
    """The rate of a condition at which the weights hold it, in rational arithmetic; huge where at none."""
    weights = ShallowWeights(*(x.double() for x in weights))
    a, w1 = weights.a.numpy(), weights.w1.numpy()
    if gauge == "best":
        s = [abs(x * y) for x, y in zip(exact.fractions(a), exact.fractions(w1), strict=True)]
        return 4 * (len(s) + 1) * max(s) if condition == "simple" else 2 * sum(s)
    if condition == "interval":
        on, up, down = exact.ZERO, exact.ZERO, exact.ZERO
        box = [(Fraction(float(x)), Fraction(float(y))) for x, y in zip(*BOUNDS, strict=True)]
        for x, y, row, b in zip(a, w1, weights.W2.numpy(), weights.b.numpy(), strict=True):
            s, z = Fraction(float(x)) * Fraction(float(y)), Fraction(float(b))
            ends = [(c * left, c * right) for c, (left, right) in zip(exact.fractions([y, *row]), box, strict=True)]
            if z + sum(map(min, ends)) >= 0:
                on += s
            elif z + sum(map(max, ends)) > 0:
                up, down = up + max(s, 0), down + max(-s, 0)
        return max(on + up, down - on)
    rate = exact.conditions(a, w1)[condition].rate
    return Fraction(10**9) if rate is None else rate


def nearest_by_quadratic_program(weights: ShallowWeights, condition: str, gauge: str, kappa: float) -> np.ndarray:
    a, w, n = weights.a.numpy(), weights.w1.numpy(), len(weights.a)
    x = cp.Variable(n)
    if condition == "simple" and gauge == "literal":
        held = [(n + 1) * cp.abs(x) / kappa + np.abs(w) <= 1]
    elif condition == "simple":
        held = [4 * (n + 1) * cp.abs(cp.multiply(w, x)) <= kappa]
    elif condition == "gershgorin" and gauge == "literal":
        held = [cp.sum(cp.multiply(1 / (1 - np.abs(w)), cp.abs(x))) <= 2 * kappa]
    elif condition == "gershgorin":
        held = [2 * cp.sum(cp.abs(cp.multiply(w, x))) <= kappa]
    else:
        times = 2 if condition == "lmi" else 1
        on, free = np.zeros(n), np.ones(n)
        if condition == "interval":
            always, never = (y.numpy() for y in conditions.fixed_signs(weights, *BOUNDS))
            on, free = always.astype(float), (~(always | never)).astype(float)
        s = cp.multiply(w, x)
        fixed = on @ s
        held = [
            times * (fixed + cp.sum(cp.multiply(free, cp.pos(s)))) <= kappa,
            times * (-fixed + cp.sum(cp.multiply(free, cp.neg(s)))) <= kappa,
        ]
    cp.Problem(cp.Minimize(cp.sum_squares(x - a)), held).solve(solver="CLARABEL")
    return x.value


@pytest.mark.parametrize(("condition", "gauge"), CASES)
@cases(10, 25)
def test_projection_is_the_solution_of_a_quadratic_program(condition, gauge, count):
    weights = networks((count,), size=0.8, seed=3)
    if gauge == "literal" and condition in ("simple", "gershgorin"):
        weights = weights._replace(w1=0.9 * weights.w1.tanh())
    if condition == "interval":  # so that some neurons are always on
        weights = weights._replace(b=3 * weights.b, W2=0.5 * weights.W2)
    near = project(weights, condition, 0.9, gauge, BOUNDS)
    moved = 0
    for k in range(count):
        expected = nearest_by_quadratic_program(single(weights, k), condition, gauge, 0.9)
        np.testing.assert_allclose(near.a[k].numpy(), expected, atol=2e-5)
        moved += not np.allclose(expected, weights.a[k], atol=1e-4)
    assert moved >= 0.2 * count
    assert torch.equal(near.w1, weights.w1) and torch.equal(near.W2, weights.W2)


@pytest.mark.parametrize(("condition", "gauge"), CASES)
@over("dtype", [torch.float64, torch.float32])
@over("size", [0.1, 1.0, 1e6])
@cases(15, 40)
def test_inside_exactly(condition, gauge, size, dtype, count):
    bounds = tuple(x.to(dtype) for x in BOUNDS)
    weights = networks((count,), n=20, size=size, seed=1, dtype=dtype)
    near = project(weights, condition, 0.999, gauge, bounds)
    assert all(x.isfinite().all() for x in near)
    rates = [exact_rate(single(near, k), condition, gauge) for k in range(count)]
    assert all(rate <= Fraction(0.999) for rate in rates)
    if condition != "interval" and size == 1e6 and dtype == torch.float64:  # no further than needed
        assert min(rates) > 0.99


def test_signs_do_not_cancel():
    """One class of 1e17 hides nothing of the other: P and N are summed apart."""
    a, one = torch.tensor([1e17, -5.0]).double(), torch.ones(2).double()
    near = project(ShallowWeights(a, one, torch.zeros(2, 4).double(), 0 * one), "exact", 0.999)
    assert exact_rate(near, "exact", "literal") <= Fraction(0.999)


def test_networks_inside_on_a_box_stay_exactly():
    """Few neurons, large biases: all of one sign class is zero, and the radii at the ends of δ are zero."""
    generator = torch.Generator().manual_seed(0)
    for n in (1, 2, 3):
        draw = torch.randn(4, 20_000, n, 4, generator=generator, dtype=torch.float64)
        weights = ShallowWeights(draw[0, ..., 0], draw[1, ..., 0], draw[2], 3 * draw[3, ..., 0])
        inside = conditions.interval(weights, *BOUNDS).rate < 0.9
        near = project(weights, "interval", 0.95, bounds=BOUNDS)
        assert inside.sum() > 1000 and torch.equal(near.a[inside], weights.a[inside])


@pytest.mark.parametrize(("condition", "gauge"), CASES)
def test_what_holds_the_condition_stays(condition, gauge):
    weights = networks((5,), size=1e-3, seed=2)
    near = project(weights, condition, 0.9, gauge, BOUNDS)
    for x, y in zip(near, weights, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-15, atol=0)


def test_rescaling_a_neuron_changes_no_output():
    """The literal conditions ask for |w1| < 1: what is done to get there leaves the map as it is."""
    weights = networks((), seed=4)._replace(a=torch.full((6,), 1e-4).double())
    weights = weights._replace(w1=weights.w1 * 5)
    near = project(weights, "gershgorin", 1.0)
    assert (weights.w1.abs() > 1).any() and (near.w1.abs() < 1).all()
    x = torch.linspace(-1, 1, 50, dtype=torch.float64)[:, None]
    values = [(w.a * (w.w1 * x + w.W2.sum(-1) + w.b).relu()).sum(-1) for w in (weights, near)]
    torch.testing.assert_close(*values)


@pytest.mark.parametrize(("condition", "gauge"), few(CASES, CASES[1::2], "thorough"))
def test_gradients(condition, gauge):
    weights = networks((3,), size=0.8, seed=6)

    def leaves(a, w1):
        near = project(weights._replace(a=a, w1=w1), condition, 0.9, gauge, BOUNDS)
        return near.a, near.w1

    a, w1 = weights.a.clone().requires_grad_(), (0.5 * weights.w1).requires_grad_()
    assert torch.autograd.gradcheck(leaves, (a, w1), eps=1e-7, atol=1e-4)


def test_elements_equal_single_networks():
    weights = networks((2, 3), seed=7)
    near, kappa = project(weights, "exact", torch.full((2, 1), 0.7)), 0.7
    for i, j in np.ndindex(2, 3):
        alone = project(ShallowWeights(*(x[i, j] for x in weights)), "exact", kappa)
        torch.testing.assert_close(near.a[i, j], alone.a, rtol=1e-6, atol=1e-7)


def test_zero_and_dead_neurons_do_no_harm():
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    dead = torch.tensor([0.0, 5.0, 5.0], dtype=torch.float64, requires_grad=True)
    for condition, gauge in CASES:
        for a, w1 in [(zero, zero), (dead, zero), (zero, dead), (dead, dead.flip(0))]:
            weights = ShallowWeights(a, w1, torch.zeros(3, 4).double(), torch.zeros(3).double())
            near = project(weights, condition, 0.9, gauge, BOUNDS)
            assert near.a.isfinite().all() and near.w1.isfinite().all()
            gradients = torch.autograd.grad(near.a.sum(), [a, w1], allow_unused=True, retain_graph=True)
            assert all(g is None or g.isfinite().all() for g in gradients), (condition, gauge)


def test_bad_arguments():
    weights = networks(())
    for wrong, message in [({"condition": "loose"}, "simple"), ({"gauge": "worst"}, "best")]:
        with pytest.raises(CertifyError, match=message):
            project(weights, **wrong)
    for rate in (0.0, -1, float("nan"), 2):
        with pytest.raises(CertifyError, match="rate"):
            project(weights, rate=rate)
    with pytest.raises(CertifyError, match="bounds"):
        project(weights, "interval")


@pytest.mark.parametrize(("condition", "gauge"), few(CASES, CASES[::3], "thorough"))
@over("batch", [(), (2, 3)])
def test_a_projection_stays_on_the_device_of_the_weights(condition, gauge, batch):
    """And its gradient; `meta` stands for an accelerator (`tests/estimators/test_devices.py`)."""
    here, bounds = networks(batch, dtype=torch.float32), tuple(x.float() for x in BOUNDS)
    there, away = ShallowWeights(*(x.to("meta").requires_grad_() for x in here)), tuple(x.to("meta") for x in bounds)
    expected = project(here, condition, 0.9, gauge, bounds)
    for rate in (0.9, torch.full(batch, 0.9, device="meta")):
        with on_device():
            moved = project(there, condition, rate, gauge, away)
            (slope,) = torch.autograd.grad(moved.a.sum(), there.a)
        assert all(x.is_meta and (x.shape, x.dtype) == (y.shape, y.dtype) for x, y in zip(moved, expected, strict=True))
        assert slope.is_meta and slope.shape == here.a.shape
