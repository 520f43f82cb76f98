"""Intervals: they cover what they promise, whatever the errors are, and nothing stops them for good."""

import math

import numpy as np
import pytest
import torch

from usvlearn.estimators.ensemble.conformal.layer import (
    BOOST,
    LEAST,
    RATE,
    START,
    ConformalState,
    conformal_start,
    conformal_step,
)


def track(errors, coverage: float = 0.9, dtype=torch.float64):
    """Half-widths before each error, `(time, k)`, and the last state."""
    errors = torch.as_tensor(errors).to(dtype)
    state, widths = conformal_start(errors.shape[1:-1], errors.shape[-1], errors), []
    for error in errors:
        widths.append(state.halfwidth)
        state = conformal_step(state, error, coverage)
    return torch.stack(widths), state


def noises(steps: int) -> np.ndarray:
    """Normal; Student's t with two degrees, whose variance is infinite; a scale that jumps tenfold and back."""
    rng = np.random.default_rng(0)
    jump = np.where(np.arange(steps) * 3 // steps == 1, 0.3, 0.03) * rng.standard_normal(steps)
    return np.stack([0.03 * rng.standard_normal(steps), 0.03 * rng.standard_t(2, steps), jump], -1)


@pytest.mark.parametrize("coverage", [0.5, 0.9])
def test_covers_normal_heavy_tailed_and_changing_errors(coverage):
    errors = noises(4000)
    widths, _ = track(errors, coverage)
    hits = np.abs(errors) <= widths.numpy()
    np.testing.assert_allclose(hits.mean(0), coverage, atol=0.01)
    halves = hits.reshape(4, 1000, 3).mean(1)  # it does not cover all in calm and nothing in the rest
    np.testing.assert_allclose(halves, coverage, atol=0.03)


def test_the_halfwidth_is_the_quantile():
    """That of a normal deviate at 90 %, 1.645 σ, within what a rate of 0.2 makes it wander."""
    errors = 0.03 * np.random.default_rng(1).standard_normal((4000, 1))
    widths, _ = track(errors)
    assert float(widths[200:].log().mean().exp()) == pytest.approx(1.645 * 0.03, rel=0.05)
    assert float(widths[200:].log().std()) < 0.35


@pytest.mark.parametrize("coverage", [0.5, 0.9, 0.99])
def test_misses_are_bounded_whatever_the_errors_are(coverage):
    """Summed up, (1) says η (misses − α K) = log(q_K/q_0) − Σ η₀/k (miss_k − α): exactly, on errors by an adversary."""
    alpha, steps = 1 - coverage, 3000
    state, misses, boost = conformal_start((), 1, torch.zeros((), dtype=torch.float64)), 0, 0.0
    rng = np.random.default_rng(2)
    for k in range(1, steps + 1):
        q = float(state.halfwidth)
        error = q * (1.01 if rng.random() < 0.5 and q < 5 else 0.99)  # just outside, or just inside
        miss = error > q
        misses, boost = misses + miss, boost + BOOST / k * (miss - alpha)
        state = conformal_step(state, torch.tensor([error], dtype=torch.float64), coverage)
        assert state.halfwidth > LEAST
    q = float(state.halfwidth)
    assert RATE * (misses - alpha * steps) == pytest.approx(math.log(q / START) - boost, abs=1e-9)
    harmonic = sum(1 / k for k in range(1, steps + 1))
    assert abs(misses / steps - alpha) <= (abs(math.log(q / START)) + BOOST * harmonic) / (RATE * steps)


def test_columns_and_elements_are_apart_and_what_is_not_finite_changes_nothing():
    errors = np.random.default_rng(3).standard_normal((50, 2, 3))
    widths, _ = track(errors)
    for element in range(2):
        for k in range(3):
            alone, _ = track(errors[:, element, k : k + 1])
            assert torch.equal(widths[:, element, k], alone[:, 0])
    errors[::2, 0, 1], errors[1::2, 1, 2] = math.nan, math.inf
    gaps, _ = track(errors)
    shorter, _ = track(errors[1::2, 0, 1:2])
    assert torch.equal(gaps[1::2, 0, 1], shorter[:, 0])
    shorter, _ = track(errors[::2, 1, 2:3])
    assert torch.equal(gaps[::2, 1, 2], shorter[:, 0])
    assert torch.equal(gaps[:, 0, 0], widths[:, 0, 0])


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_hours_of_exact_predictions_are_forgotten_in_seconds(dtype):
    """A boat that lies still is predicted exactly: log q would fall for ever, and in the end q be 0 and stay so."""
    still = ConformalState(torch.full((1,), LEAST, dtype=dtype), torch.full((1,), 1e5, dtype=dtype))
    assert conformal_step(still, torch.zeros(1, dtype=dtype), 0.9).halfwidth == still.halfwidth
    _, end = track(np.zeros((1000, 1)), dtype=dtype)
    assert end.halfwidth == torch.tensor([LEAST], dtype=dtype)
    for _ in range(30):  # 12 s
        end = conformal_step(end, torch.full((1,), 0.05, dtype=dtype), 0.9)
    assert end.halfwidth > 0.05


@torch.enable_grad()
def test_leaves_no_trace_in_the_graph():
    """A miss has no slope: gradients of what is predicted must not pass through the intervals."""
    error = torch.randn(4, dtype=torch.float64, requires_grad=True)
    assert not conformal_step(conformal_start((), 4, error), error, 0.9).halfwidth.requires_grad
