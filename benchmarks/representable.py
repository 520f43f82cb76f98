"""Which constraint can represent a boat at all.

python benchmarks/representable.py        writes docs/benchmarks/representable.md

Offline, without noise: networks of 20 neurons learn one hour of a surge model like the Heron's by Adam, through free
runs of 10 s, and are projected after every update. The learning rate of a row is the best on a second trajectory, what
is reported is the open-loop simulation over a third one of half an hour.
"""

import math

import torch
from families import SURGE_MAX, surge_dot
from pages import publish
from torch import Tensor

from certify.networks.shallow import ShallowWeights
from certify.training.conditions import rate as contraction_rate
from certify.training.projections import project

ROWS: dict[str, dict | float | None] = {
    "none": None,
    "penalty, η = 0.05": 0.05,
    "penalty, η = 0.0005": 0.0005,
    "simple, best gauge": {"condition": "simple", "gauge": "best"},
    "gershgorin, best gauge": {"condition": "gershgorin", "gauge": "best"},
    "lmi": {"condition": "lmi"},
    "tight": {"condition": "tight"},
}
RATES, SEEDS, NEURONS, UPDATES, WINDOWS = (1e-3, 3e-3, 1e-2), 5, 20, 5000, 64


def trajectory(hours: float, dt: float, seed: int) -> tuple[Tensor, Tensor]:
    """x = v/(2 v_max), `(time,)`, and the inputs that led to it, `(time, 4)`; commands are held for 2 to 20 s."""
    generator = torch.Generator().manual_seed(seed)
    steps = round(3600 * hours / dt)

    def held(low: float, high: float) -> Tensor:
        lengths = (2 / dt + 18 / dt * torch.rand(steps, generator=generator)).long().clamp(min=1)
        values = low + (high - low) * torch.rand(steps, generator=generator)
        return values.repeat_interleave(lengths)[:steps].double()

    left, right, heading, yaw = held(0, 1), held(0, 1), held(0, 2 * math.pi), held(0, 0.5)
    v, speeds = torch.zeros((), dtype=torch.float64), []
    for k in range(steps):
        for _ in range(10):
            v = v + dt / 10 * surge_dot(v, left[k], right[k], yaw[k])
        speeds.append(v)
    u = torch.stack([0.5 + 0.5 * heading.sin(), 0.5 + 0.5 * heading.cos(), left, right], -1)
    return torch.stack(speeds) / (2 * SURGE_MAX), u


def free_run(weights: ShallowWeights, x: Tensor, u: Tensor) -> Tensor:
    """States of an open-loop simulation from x, `(*elements, windows)`, under u, `(time, windows, 4)`: `(time,
    *elements, windows)`.
    """
    a, w1, W2, b = weights
    drive = torch.einsum("...nm,twm->t...wn", W2, u) + b[..., None, :]
    states = []
    for each in drive:
        x = ((w1[..., None, :] * x[..., None] + each).relu() * a[..., None, :]).sum(-1)
        states.append(x)
    return torch.stack(states)


def learn(row: dict | float | None, x: Tensor, u: Tensor, dt: float) -> ShallowWeights:
    """Networks of every rate and seed, `(rates, seeds, …)`."""
    generator = torch.Generator().manual_seed(0)
    n, horizon = NEURONS, round(10 / dt)

    def draw(*shape: int, fan_in: int) -> Tensor:
        uniform = 2 * torch.rand((SEEDS, *shape), generator=generator, dtype=torch.float64) - 1
        return (uniform / fan_in**0.5).expand(len(RATES), *uniform.shape).clone().requires_grad_()

    weights = ShallowWeights(draw(n, fan_in=n), draw(n, fan_in=5), draw(n, 4, fan_in=5), draw(n, fan_in=5))
    step = torch.tensor(RATES, dtype=torch.float64)
    moments = [[torch.zeros_like(w), torch.zeros_like(w)] for w in weights]
    for k in range(1, UPDATES + 1):
        starts = torch.randint(0, len(x) - horizon, (WINDOWS,), generator=generator)
        index = starts + 1 + torch.arange(horizon)[:, None]  # (time, windows)
        found = free_run(weights, x[starts].expand(len(RATES), SEEDS, WINDOWS), u[index])
        loss = (found - x[index][:, None, None]).square().mean((0, -1)).sum()
        if isinstance(row, float):
            a, w1 = weights.a, weights.w1
            psi = (a.abs() + w1.abs() / (n + 1) > 1 / (n + 1)).to(a.dtype)
            loss = loss + row / 2 * (psi * (a * a + w1 * w1)).sum()
        gradients = torch.autograd.grad(loss, list(weights))
        with torch.no_grad():
            moved = []
            scale = step * 0.5 * (1 + math.cos(math.pi * k / UPDATES))
            for w, g, moment in zip(weights, gradients, moments, strict=True):
                moment[0] = 0.9 * moment[0] + 0.1 * g
                moment[1] = 0.999 * moment[1] + 0.001 * g * g
                unit = (moment[0] / (1 - 0.9**k)) / ((moment[1] / (1 - 0.999**k)).sqrt() + 1e-8)
                moved.append(w - scale.reshape(-1, *(1,) * (w.dim() - 1)) * unit)
            weights = ShallowWeights(*moved)
            if isinstance(row, dict):
                weights = project(weights, rate=0.999, **row)
        weights = ShallowWeights(*(w.detach().requires_grad_() for w in weights))
    return ShallowWeights(*(w.detach() for w in weights))


def error(weights: ShallowWeights, x: Tensor, u: Tensor) -> Tensor:
    """MAE of one open-loop simulation over a whole trajectory, m/s, `(rates, seeds)`."""
    found = free_run(weights, x[:1].expand(len(RATES), SEEDS, 1), u[1:, None])
    return 2 * SURGE_MAX * (found[..., 0] - x[1:, None, None]).abs().mean(0)


def main() -> None:
    torch.set_num_threads(1)
    lines = [*__doc__.strip().splitlines()[4:], ""]
    for dt in (0.2, 0.4, 1.0):
        (x, u), (x_tune, u_tune), (x_test, u_test) = (trajectory(h, dt, s) for h, s in ((1, 1), (0.5, 2), (0.5, 3)))
        lines += [f"## dt = {dt:g} s", "", "| constraint | rate | open-loop MAE, m/s | over seeds | / none | K |"]
        lines += ["|---|" + "---:|" * 5]
        base = None
        for name, row in ROWS.items():
            weights = learn(row, x, u, dt)
            best = error(weights, x_tune, u_tune).mean(1).nan_to_num(math.inf).argmin()
            found, K = error(weights, x_test, u_test)[best], contraction_rate(weights.a, weights.w1)[best]
            base = float(found.mean()) if base is None else base
            lines.append(
                f"| {name} | {RATES[best]:g} | {found.mean():.4f} | {found.min():.4f} … {found.max():.4f} "
                f"| {found.mean() / base:.2f} | {K.min():.3g} … {K.max():.3g} |"
            )
            print(dt, lines[-1], flush=True)
        mean = 2 * SURGE_MAX * (x_test - x.mean()).abs().mean()
        lines += [f"| *mean speed* | | {mean:.4f} | | {mean / base:.2f} | |", ""]
    publish(__file__, ["# Which boats a constrained network can represent", "", *lines])


if __name__ == "__main__":
    main()
