"""A boat that the equations of `usvlearn.model.fit.turning_kernel` move."""

import numpy as np

from tests.support.fitted_boats import TOP
from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, RIGHT, ROW, SIN, START, SURGE, YAW_RATE
from usvlearn.model.fit import turning_kernel as at

TRUE = {at.K1: 0.4, at.K2: 0.8, at.D0: 0.7, at.D1: 1.1, at.D2: 0.7, at.LAG: 0.2, at.LATE: 0.1, at.DEAD: 0.06,
        at.ASTERN: 0.7, at.SIDE: 0.85}  # fmt: skip


def sailed(seed: int = 0, steps: int = 3000, apart: float = 1.0, gyro: bool = False, noise: float = 0.01) -> np.ndarray:
    """A mission of a boat with the parameters `TRUE`, by Euler steps of 25 ms; the heading is wrapped."""
    rng, rows = np.random.default_rng(seed), np.zeros((steps, ROW + 2))
    mean, half = (np.repeat(rng.uniform(*ends, steps // 50 + 1), 50)[:steps] for ends in ((-0.1, 0.8), (-0.4, 0.4)))
    rows[:, LEFT], rows[:, RIGHT] = np.clip(mean + apart * half, -1, 1), np.clip(mean - apart * half, -1, 1)
    psi = r = u = 0.0
    force = np.zeros(2)
    for k in range(steps):
        command = rows[max(k - 1, 0), [LEFT, RIGHT]]  # LATE is a step
        c = np.maximum(np.abs(command) - TRUE[at.DEAD], 0) / (1 - TRUE[at.DEAD])
        tau = np.where(command > 0, 1, -TRUE[at.ASTERN]) * (TRUE[at.K1] + TRUE[at.K2] * c) * c
        for _ in range(4):
            force += 0.025 * (tau - force) / TRUE[at.LAG]
            damping = TRUE[at.D0] + TRUE[at.D1] * abs(r) + TRUE[at.D2] * abs(u) / TOP
            psi, r = psi + 0.025 * r, r + 0.025 * (force @ [1, -TRUE[at.SIDE]] - damping * r)
            u += 0.025 * (1.2 * force.sum() - 0.4 * u - 0.2 * u * abs(u))
        rows[k, SURGE:] = u, LEARN, psi, r
    rows[:, at.HEADING] = (rows[:, at.HEADING] + noise * rng.standard_normal(steps)) % (2 * np.pi)
    rows[:, YAW_RATE] = rows[:, at.RATE] + 0.1 * rng.standard_normal(steps)
    rows[:, at.RATE] = rows[:, at.RATE] + 0.005 * rng.standard_normal(steps) if gyro else np.nan
    rows[:, COS], rows[:, SIN] = np.cos(rows[:, at.HEADING]), np.sin(rows[:, at.HEADING])
    rows[:, DT], rows[0, MODE] = 0.1, START
    return rows
