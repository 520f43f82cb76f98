"""Projection onto signs: the active sets against an enumeration of them, and where it acts."""

import itertools

import numpy as np
import pytest
import torch

from tests.support import over, random_samples
from usvlearn import Inputs, Projected, QuasiStatic, Sample, SIFtRLS, SurgeDynamics, rollout
from usvlearn.estimators.least_squares.projected import held_by, project_signs

SIGNS = (1, -1, 0, 1, -1, 1)


def problem(seed: int, p: int = 6):
    """θ and a square root of P with the correlations of parameters that are told apart poorly."""
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((p, p)) + 2 * np.outer(rng.standard_normal(p), rng.standard_normal(p))
    return rng.standard_normal(p), factor


def enumerated(theta, factor, signs):
    """min |S⁻¹(θ − z)|² such that s_i θ_i ≥ 0, by trying every set of parameters that are held at 0."""
    P, best = factor @ factor.T, (np.inf, None)
    bound = [i for i, s in enumerate(signs) if s]
    for count in range(len(bound) + 1):
        for held in map(list, itertools.combinations(bound, count)):
            z = theta - P[:, held] @ np.linalg.solve(P[np.ix_(held, held)], theta[held]) if held else theta
            if all(signs[i] * z[i] >= -1e-12 for i in bound):
                best = min(best, (np.sum(np.linalg.solve(factor, theta - z) ** 2), z), key=lambda x: x[0])
    return best[1]


def projected(theta, factor, signs, iterations):
    return project_signs(torch.as_tensor(theta), torch.as_tensor(factor), *held_by(signs), iterations).numpy()


@over("seed", range(40))
def test_converges_to_the_nearest_with_these_signs(seed):
    theta, factor = problem(seed)
    expected = enumerated(theta, factor, SIGNS)
    np.testing.assert_allclose(projected(theta, factor, SIGNS, 6), expected, atol=1e-9)


def test_one_constraint_is_met_in_one_round():
    theta, factor = problem(1)
    for i, sign in itertools.product(range(6), (-1, 1)):
        signs = tuple(sign if j == i else 0 for j in range(6))
        expected = enumerated(theta, factor, signs)
        np.testing.assert_allclose(projected(theta, factor, signs, 1), expected, atol=1e-12)


@pytest.mark.parametrize("iterations", [1, 2, 20])
def test_signs_hold_to_the_bit_and_again_changes_nothing(iterations):
    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(200, 6, generator=generator, dtype=torch.float64)
    factor = torch.randn(200, 6, 6, generator=generator, dtype=torch.float64)
    signs = torch.tensor(SIGNS)
    held = held_by(SIGNS)
    once = project_signs(theta, factor, *held, iterations)
    assert (once * signs >= 0).all()
    assert torch.equal(project_signs(once, factor, *held, iterations), once)
    inside = theta.abs() * torch.where(signs == 0, 1, signs)
    assert torch.equal(project_signs(inside, factor, *held, iterations), inside)


def test_own_signs_and_free_parameters():
    model = SurgeDynamics(28.0, memory=True, ambient=True)
    assert Projected(SIFtRLS(model)).signs == (-1, -1, -1, 1, 1, -1, 1, 1, -1) + (0,) * 6
    free, samples = Projected(SIFtRLS(QuasiStatic())), random_samples(30, 2)
    plain = SIFtRLS(QuasiStatic())
    assert torch.equal(rollout(free, free.init((2,)), samples)[1], rollout(plain, plain.init((2,)), samples)[1])
    backwards = Projected(SIFtRLS(QuasiStatic()), signs=[-1] * 9)
    assert (rollout(backwards, backwards.init((2,)), samples)[0].theta <= 0).all()


@pytest.mark.parametrize("seed", range(6))
def test_kernel_and_torch_differ_by_no_more_than_the_condition_of_P_explains(seed):
    """Commands of 99.9: regressors differ by a factor of 1e4, and (2) is a poorly conditioned system."""
    rng, estimator = np.random.default_rng(seed), Projected(SIFtRLS(memory=5.0), signs=[1] * 9, iterations=8)
    commands = rng.choice([0.0, 1.0, -1.0, 0.5, 99.9, -99.9], (2, 40), p=[0.1, 0.2, 0.1, 0.2, 0.25, 0.15])
    heading, yaw_rate, surge = (torch.tensor(rng.uniform(-1, 1, 40)) for _ in range(3))
    inputs = Inputs(*map(torch.tensor, commands), heading, yaw_rate, torch.full((40,), 0.4, dtype=torch.float64))
    samples = Sample(inputs, 2 * surge, torch.ones(40, dtype=torch.bool), torch.ones(40, dtype=torch.bool))
    kernel, by_torch = (
        rollout(estimator, estimator.init(), samples, ["theta", "factor"], backend=backend)[2]
        for backend in ("kernel", "torch")
    )
    condition = float(torch.linalg.cond(by_torch["factor"]).max() ** 2)
    error = (kernel["theta"] - by_torch["theta"]).abs().amax() / by_torch["theta"].abs().amax()
    assert 1e12 < condition < 1e15 and error <= condition * torch.finfo(torch.float64).eps
    assert ((kernel["theta"] == 0) == (by_torch["theta"] == 0)).all()  # the same parameters are held
