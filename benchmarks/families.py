"""Networks on which conditions are measured: random, initialised, trained."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from certify.command.compare import random_networks as initial_networks
from certify.networks.shallow import ShallowWeights
from certify.training import conditions

HERON = {"quadratic": -0.125, "linear": -0.05, "cross": -0.1, "thrust": 0.25, "speed": -0.1}  # over the mass
SURGE_MAX = 2.0  # m/s


def surge_dot(v: Tensor, left: Tensor, right: Tensor, yaw_rate: Tensor) -> Tensor:
    """c_q |v| v + c_l v + c_r |r| v + Σ α ξ + α ξ² + γ ξ v over the mass, m/s², for commands and yaw rates ≥ 0."""
    drag = HERON["quadratic"] * v * v.abs() + (HERON["linear"] + HERON["cross"] * yaw_rate) * v
    return drag + sum(HERON["thrust"] * (xi + xi * xi) + HERON["speed"] * xi * v for xi in (left, right))


def random_networks(count: int, n: int, rng: np.random.Generator) -> list[ShallowWeights]:
    """Normal weights, four inputs, scaled so that K is spread log-uniformly over 0.03 … 3."""
    found = []
    for K in np.exp(rng.uniform(math.log(0.03), math.log(3), count)):
        a, w1, b = rng.normal(size=(3, n))
        gain = math.sqrt(K / float(conditions.rate(torch.tensor(a), torch.tensor(w1))))
        found.append(ShallowWeights(gain * a, gain * w1, rng.normal(size=(n, 4)), b))
    return found


def signed_networks(count: int, n: int, rarer: int, rng: np.random.Generator) -> list[ShallowWeights]:
    """Initial networks of which `rarer` neurons have s_i < 0, and the others s_i > 0."""
    signs = np.where(np.arange(n) < rarer, -1.0, 1.0)
    return [w._replace(a=np.abs(w.a) * signs, w1=np.abs(w.w1)) for w in initial_networks(count, n, rng)]


def trained_networks(
    count: int, n: int, rng: np.random.Generator, dt: float = 0.4, steps: int = 3000
) -> list[ShallowWeights]:
    """Initial networks after Adam, without any constraint, on one step of a surge model like the Heron's.

    v' = v + dt surge_dot, x = v/(2 v_max), in batches of 64 draws.
    """
    start = initial_networks(count, n, rng)
    weights = [torch.tensor(np.stack(x)).requires_grad_() for x in zip(*start, strict=True)]
    optimizer = torch.optim.Adam(weights, lr=5e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    for _ in range(steps):
        v, left, right, yaw, heading = torch.rand(5, 64, generator=generator, dtype=torch.float64)
        v, heading, yaw = SURGE_MAX * v, 2 * math.pi * heading, 0.5 * yaw
        target = (v + dt * surge_dot(v, left, right, yaw)) / (2 * SURGE_MAX)
        u = torch.stack([0.5 + 0.5 * heading.sin(), 0.5 + 0.5 * heading.cos(), left, right], -1)  # (64, 4)
        a, w1, W2, b = weights
        z = w1[:, None] * (v / (2 * SURGE_MAX))[:, None] + (W2 @ u.T).mT + b[:, None]  # (count, 64, n)
        loss = ((z.relu() @ a[..., None])[..., 0] - target).square().sum(0).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return [ShallowWeights(*(x[k].detach().numpy() for x in weights)) for k in range(count)]
