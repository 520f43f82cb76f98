"""Boats and missions for tests of the batch fit."""

import numpy as np

from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, PREDICT, RIGHT, ROW, SIN, START, SURGE, YAW_RATE
from usvlearn.model.fit import motion_kernel as kernel
from usvlearn.model.fit.terms import NAMES, PLACE_LAG, PLACE_TIME, prior

TOP, MASS = 2.5, 28.0


def mission(steps: int = 400, seed: int = 0, dt: float = 0.2, start: float = 0.3) -> np.ndarray:
    """Rows of commands that hold for some seconds, with turns; all steps predict."""
    rng, rows = np.random.default_rng(seed), np.zeros((steps + 1, ROW))
    commands = np.repeat(rng.uniform(-0.6, 1.0, (steps // 20 + 1, 2)), 20, 0)[:steps]
    rows[1:, LEFT], rows[1:, RIGHT] = commands.T
    heading = np.cumsum(0.3 * rng.standard_normal(steps)) * dt
    rows[1:, SIN], rows[1:, COS], rows[1:, YAW_RATE] = (
        np.sin(heading),
        np.cos(heading),
        0.2 * rng.standard_normal(steps),
    )
    rows[:, DT], rows[:, MODE] = dt, PREDICT
    rows[0] = 0
    rows[0, MODE], rows[0, SURGE] = START, start
    return rows


def simulated(rows: np.ndarray, theta: np.ndarray, terms: str = "curves, even") -> np.ndarray:
    """Speeds of an open loop without a current."""
    active, out = prior(terms, TOP).active, np.empty(len(rows))
    kernel.mission(
        rows, theta, active, TOP, 1e-4, 1e-9, 4.0, out, np.zeros(len(active)), np.zeros((0, 0)),
        np.zeros(4 * len(NAMES) + len(active) + 3), np.zeros((4, 3)), np.zeros((3, len(active))),
    )  # fmt: skip
    return out


def boat(seed: int = 1) -> np.ndarray:
    """Parameters of a plausible boat with all terms."""
    rng, known = np.random.default_rng(seed), prior("curves, even", TOP)
    theta = known.mean.copy()
    theta[known.active] += (
        0.1 * np.linalg.cholesky(np.linalg.inv(known.information)) @ rng.standard_normal(len(known.active))
    )
    theta[PLACE_LAG] = theta[PLACE_TIME] = 0.0
    return theta


def log(steps: int, seed: int = 0, noise: float = 0.02) -> np.ndarray:
    """A measured mission on a grid of 0.1 s."""
    rows = mission(steps, seed, dt=0.1)
    rows[1:, SURGE] = simulated(rows, boat())[1:] + noise * np.random.default_rng(seed).standard_normal(steps)
    rows[1:, MODE] = LEARN
    return rows
