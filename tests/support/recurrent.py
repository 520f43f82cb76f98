"""What tests of the RNN share: its loss, written down plainly, and a simple boat that it learns."""

import torch

from usvlearn import Inputs, Sample
from usvlearn.estimators.rnn.layer import network


def loss(weights, x, u, target, penalty, x_before, u_before, unbroken):
    """Equation (2) of the RNN, written down plainly."""
    if unbroken:
        x = network(weights, x_before, u_before)[0]
    predicted, n = network(weights, x, u)[0], len(weights.a)
    psi = (weights.a.abs() + weights.w1.abs() / (n + 1) > 1 / (n + 1)).to(x.dtype)
    return 0.5 * (predicted - target) ** 2 + penalty / 2 * (psi * (weights.a**2 + weights.w1**2)).sum()


def boat(steps: int) -> Sample:
    """A hull of first order, v⁺ = 0.9 v + 0.1 (L + R), whose commands change every 20 steps; 0.005 m/s noise."""
    generator = torch.Generator().manual_seed(0)
    commands = torch.rand((steps // 20, 2), generator=generator).double().repeat_interleave(20, 0)
    surge = [torch.zeros((), dtype=torch.float64)]
    for left, right in commands:
        surge.append(0.9 * surge[-1] + 0.1 * (left + right))
    noise = 0.005 * torch.randn(steps, generator=generator).double()
    zero, true = torch.zeros(steps, dtype=torch.float64), torch.ones(steps, dtype=torch.bool)
    inputs = Inputs(commands[:, 0], commands[:, 1], zero, zero, zero + 0.4)
    return Sample(inputs, torch.stack(surge[1:]) + noise, true, true)
