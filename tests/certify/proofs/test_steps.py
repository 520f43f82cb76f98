"""One proof for all smaller steps: the closed form against the exact rate at each step, enumeration and simulation."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from certify.networks.vector import RELU, VectorWeights, activation, check
from certify.proofs.steps import short, stepped, steps
from certify.proofs.vector_exact import Proof, everywhere, rate
from certify.proofs.vector_exact import proves as proves_metric
from tests.support import few

ETAS = [Fraction(k, 7) for k in range(1, 30)]


def network(rng: np.random.Generator, q: int, n: int, last: int | None = None) -> VectorWeights:
    deep = {} if last is None else {"V": rng.normal(size=(last, n)) / n, "c": rng.normal(size=last)}
    A = rng.normal(size=(q, last or n)) / (2 * n)
    return check(
        VectorWeights(
            rng.normal(size=(q, q)) / 3, A, rng.normal(size=(n, q)), np.zeros((n, 1)), rng.normal(size=n), **deep
        )
    )


CASES = [(*each, norm) for norm in ("inf", "one")
         for each in (("relu", None), ("leaky:1/3", None), ("tanh", 2), ("leaky:1/3", 2))]  # fmt: skip


@pytest.mark.parametrize(("name", "last", "norm"), few(CASES, CASES[::3], "thorough"))
def test_the_closed_form_is_the_exact_rate_of_every_step(name, last, norm):
    rng, phi, contracting = np.random.default_rng(0), activation(name), 0
    for k in range(12):
        net, T = network(rng, 1 + k % 3, 4, last), None
        if k % 2:
            T = [[Fraction(int(rng.integers(1, 5))) * (i == j) + Fraction(i < j, 3) for j in range(1 + k % 3)]
                 for i in range(1 + k % 3)]  # fmt: skip
        slopes = everywhere(net, phi)
        limits = steps(net, slopes, norm, T)
        for eta in [*ETAS, limits.fastest, limits.largest]:
            assert rate(stepped(net, eta), slopes, norm, T) == (limits.rate(eta) if eta else 1)
        if limits.largest:
            contracting += 1
            assert limits.rate(limits.largest) == 1 and limits.fastest < limits.largest
            eta = short(limits.largest)
            assert 0 < limits.largest - eta <= Fraction(1, 2**20) and limits.rate(eta) < 1
            kappa = limits.rate(limits.fastest)
            assert rate(stepped(net, limits.fastest), everywhere(net, phi), norm, T) == kappa
            for each in ETAS:  # equation (2)
                if each <= limits.fastest:
                    assert limits.rate(each) <= 1 - each / limits.fastest * (1 - kappa)
        else:
            assert limits.measure >= 0 and all(rate(stepped(net, eta), slopes, norm, T) >= 1 for eta in ETAS)
            assert short(limits.largest) is None
    assert contracting >= 4


def test_one_state_contracts_iff_the_two_inequalities_hold():
    """ρ + P < 1 and η (1 − ρ + N) < 2, against all patterns of slopes."""
    rng, seen = np.random.default_rng(1), set()
    for _ in range(200):
        a, w, rho = rng.integers(-4, 5, 4) / 8, rng.integers(-2, 3, 4) / 2, float(rng.integers(-8, 9) / 8)
        net = check(VectorWeights([[rho]], [a], w[:, None], np.zeros((4, 0)), np.zeros(4)))
        slopes = [
            rho + sum(x for x, on in zip(a * w, each, strict=True) if on)
            for each in itertools.product((0, 1), repeat=4)
        ]
        for eta in (Fraction(1, 4), Fraction(1), Fraction(9, 4)):
            contracts = all(abs(1 + eta * (Fraction(s) - 1)) < 1 for s in slopes)
            P, N = sum(x for x in a * w if x > 0), -sum(x for x in a * w if x < 0)
            assert contracts == (rho + P < 1 and eta * (1 - Fraction(rho) + Fraction(N)) < 2)
            assert contracts == (0 < eta < steps(net, everywhere(net, RELU)).largest)
            seen.add(contracts)
    assert seen == {True, False}


def test_a_metric_proves_all_smaller_steps_too():
    net = check(VectorWeights([[0.0]], [[0.5, -0.5]], [[1.0], [1.0]], np.zeros((2, 0)), [0.0, -0.5]))
    proof = Proof([[Fraction(1)]], [[Fraction(1, 2), Fraction(1, 2)]])
    assert all(
        proves_metric(stepped(net, eta), RELU, proof, Fraction(99, 100)) for eta in (Fraction(1), Fraction(1, 3))
    )
