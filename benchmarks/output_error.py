"""Batch output-error fit of a boat to all runs at once: the baseline of the benchmarks.

Model of one step of h seconds, with w the speed through the water, u the commands and c the current of a run:

    ξ = (1 − μ) u_k + μ u_(k−1)
    f = q|w|w + l w + c_r|r|w + Σ_i (α ξ + β ξ|ξ| + γ ξ|w| + κ ξ³),   J = ∂f/∂w                       (1)
    w⁺ = w + h φ1(z) f,   z = hJ within −20 … 1,   φ1(z) = (e^z − 1)/z                                (2)
    v = w + c_N cos ψ + c_E sin ψ                                                                     (3)

All parameters are per mass. A run is simulated from the speed with which each segment starts, without any later speed;
after a step without fresh inputs a new segment starts. The fit minimises the sum of ρ(v − v_measured) over all
measured steps of all runs, where ρ is quadratic near 0 and linear far from it (`soft_l1`). Its Jacobian is exact: the
sensitivities of w are simulated along. Open-loop simulations on other runs use the mean current of those that were
learned.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.optimize import least_squares

from usvlearn.core.samples import Sample, masks
from usvlearn.estimators.regressors.terms import SURGE

NAMES = (*SURGE, "thrust_cubic_left", "thrust_cubic_right")
TERMS, LAG, SHARED, DRAG = len(NAMES), len(NAMES), len(NAMES) + 1, 3  # of all runs: the drag, the rest of θ, and μ
H, LEFT, RIGHT, LEFT_BEFORE, RIGHT_BEFORE, COS, SIN, YAW, SURGE_NOW, STEPS, LEARNS, STARTS, RUN = range(13)  # of rows
RESTING = 0.1  # m/s: where ρ bends, and the deviation of noise and model that the prior of the current is held against
CURRENT = 0.3  # m/s, prior deviation of a component of the current


class Fit(NamedTuple):
    """What was fitted."""

    parameters: dict[str, float]  # by the names of `SurgeDynamics`, per mass
    lag: float  # μ, share of a step
    current: np.ndarray  # (runs, 2) m/s towards north and east
    residual: float  # mean |v − v_measured| over the measured steps, m/s


@njit(cache=True)
def phi1(z):
    """(e^z − 1)/z and its derivative."""
    if abs(z) < 1e-3:
        return 1 + z / 2 + z * z / 6 + z**3 / 24, 0.5 + z / 3 + z * z / 8 + z**3 / 30
    p = math.expm1(z) / z
    return p, (p * z + 1 - p) / z


@njit(cache=True)
def step(w, theta, row, gradient):
    """w⁺ of (2); writes its derivatives with respect to the shared parameters, and returns that to w too."""
    h, turn, mu = row[H], abs(row[YAW]), theta[LAG]
    left_change, right_change = row[LEFT_BEFORE] - row[LEFT], row[RIGHT_BEFORE] - row[RIGHT]
    left, right = row[LEFT] + mu * left_change, row[RIGHT] + mu * right_change
    speed, sign = abs(w), 1.0 if w >= 0 else -1.0
    W = (speed * w, w, turn * w, left, left * abs(left), left * speed, right, right * abs(right), right * speed,
         left**3, right**3)  # fmt: skip
    slopes = (2 * speed, 1.0, turn, 0.0, 0.0, left * sign, 0.0, 0.0, right * sign, 0.0, 0.0)  # ∂W/∂w
    f = 0.0
    J = 0.0
    for i in range(TERMS):
        f += W[i] * theta[i]
        J += slopes[i] * theta[i]
    z = h * J
    inside = 1.0 if -20 < z < 1 else 0.0
    p, dp = phi1(min(max(z, -20.0), 1.0))
    dp *= inside
    for i in range(TERMS):
        gradient[i] = h * p * W[i] + h * h * dp * f * slopes[i]
    left_pull = theta[3] + 2 * theta[4] * abs(left) + theta[5] * speed + 3 * theta[9] * left * left  # ∂f/∂ξ
    right_pull = theta[6] + 2 * theta[7] * abs(right) + theta[8] * speed + 3 * theta[10] * right * right
    turning = sign * (theta[5] * left_change + theta[8] * right_change)  # ∂J/∂μ
    gradient[LAG] = h * p * (left_pull * left_change + right_pull * right_change) + h * h * dp * f * turning
    return w + h * p * f, 1 + h * p * J + h * h * dp * f * 2 * theta[0] * sign


@njit(cache=True)
def simulate(rows, theta, current, speeds, sensitivity):
    """v of (3) after every row; sensitivities to the shared parameters and to both components of the run's current.

    `sensitivity` is `(rows, SHARED + 2)`, or `(0, 0)` where only the speeds are wanted. A row that makes no step and
    starts no segment keeps the speed.
    """
    w, run = 0.0, -1.0
    S, gradient = np.zeros(SHARED + 2), np.zeros(SHARED)
    wanted = len(sensitivity) > 0
    for k in range(len(rows)):
        row = rows[k]
        cos, sin, c = row[COS], row[SIN], current[int(row[RUN])]
        if row[RUN] != run:
            w, run = 0.0, row[RUN]
            S[:] = 0.0
        if row[STARTS] > 0:
            w = row[SURGE_NOW] - c[0] * cos - c[1] * sin
            S[:] = 0.0
            S[SHARED], S[SHARED + 1] = -cos, -sin
        elif row[STEPS] > 0:
            w, through = step(w, theta, row, gradient)
            w = min(max(w, -30.0), 30.0)
            for i in range(SHARED + 2):
                S[i] *= through
            for i in range(SHARED):
                S[i] += gradient[i]
        speeds[k] = w + c[0] * cos + c[1] * sin
        if wanted:
            sensitivity[k] = S
            sensitivity[k, SHARED] += cos
            sensitivity[k, SHARED + 1] += sin


def rows_of(runs: Sequence[Sample], restart: bool) -> np.ndarray:
    """Rows of all runs, `(steps, 13)`."""
    parts = []
    for index, run in enumerate(runs):
        use, x = masks(run, 10.0), run.inputs
        starts = use.starts
        if restart:
            held = ~use.steps & ~use.starts
            number = np.arange(len(held))
            hold, known = (np.maximum.accumulate(np.where(at, number, -1)) for at in (held, use.learns | use.starts))
            starts = starts | (use.learns & (hold > np.append(-1, known[:-1])))  # the first speed known after a hold
        commands, opens = (x.command_left, x.command_right), starts | np.append(True, starts[:-1])
        before = [np.where(opens, u, np.append(u[:1], u[:-1])) for u in commands]
        columns = (x.dt, *commands, *before, np.cos(x.heading), np.sin(x.heading), x.yaw_rate, run.surge,
                   use.steps & ~starts, use.learns & ~starts, starts, np.full(len(x.dt), index))  # fmt: skip
        parts.append(np.nan_to_num(np.stack([np.asarray(column, float) for column in columns], -1)))
    return np.concatenate(parts)


def first_guess(top: float) -> np.ndarray:
    """Parameters of a boat with this top speed, m/s, and a time constant of 2.5 s."""
    linear, quadratic = -0.2, -0.1 / top
    force = (-linear * top - quadratic * top * top) / 2
    side = [force / 2, force / 2, 0.0]
    return np.array([quadratic, linear, 0.0, *side, *side, 0.0, 0.0, 0.0])


def fit(runs: Sequence[Sample], top: float, cubic: bool = True, current: bool = True, lag: bool = True) -> Fit:
    """The parameters that simulate all runs best."""
    rows = rows_of(runs, restart=True)
    learns, run = rows[:, LEARNS] > 0, rows[:, RUN].astype(int)
    measured, places, count = rows[learns, SURGE_NOW], run[learns], len(runs)
    free = np.array([cubic or "cubic" not in name for name in NAMES] + [lag])
    first = first_guess(top)
    speeds, sensitivity = np.empty(len(rows)), np.empty((len(rows), SHARED + 2))
    shared = int(free.sum())
    prior = RESTING / CURRENT * np.eye(2 * count)

    def split(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        theta = np.zeros(SHARED)
        theta[free] = x[:shared]
        return theta, x[shared:].reshape(count, 2) if current else np.zeros((count, 2))

    def residuals(x: np.ndarray) -> np.ndarray:
        simulate(rows, *split(x), speeds, np.empty((0, 0)))
        wrong = speeds[learns] - measured
        return np.concatenate([wrong, RESTING / CURRENT * x[shared:]])

    def jacobian(x: np.ndarray) -> np.ndarray:
        simulate(rows, *split(x), speeds, sensitivity)
        slopes = sensitivity[learns]
        full = np.zeros((len(slopes) + (2 * count if current else 0), len(x)))
        full[: len(slopes), :shared] = slopes[:, :SHARED][:, free]
        if current:
            for k in range(2):
                full[np.arange(len(slopes)), shared + 2 * places + k] = slopes[:, SHARED + k]
            full[len(slopes) :, shared:] = prior
        return full

    start = np.concatenate([first[free], np.zeros(2 * count if current else 0)])
    highest = np.full(len(start), np.inf)
    highest[:DRAG] = 1e-9
    solved = least_squares(
        residuals, start, jacobian, bounds=(-np.inf, highest), x_scale="jac", loss="soft_l1", f_scale=RESTING,
        max_nfev=100, xtol=1e-6, ftol=1e-6,
    )  # fmt: skip
    theta, flow = split(solved.x)
    residual = float(np.abs(solved.fun[: len(measured)]).mean())
    return Fit(dict(zip(NAMES, theta[:TERMS].tolist(), strict=True)), float(theta[LAG]), flow, residual)


def free_runs(fit: Fit, runs: Sequence[Sample]) -> list[np.ndarray]:
    """Predictions for other runs, `(time,)` each, m/s; only the speeds with which segments start are used."""
    rows = rows_of(runs, restart=False)
    theta, speeds = np.array([*fit.parameters.values(), fit.lag]), np.empty(len(rows))
    simulate(rows, theta, np.tile(fit.current.mean(0), (len(runs), 1)), speeds, np.empty((0, 0)))
    return np.split(speeds, np.cumsum([len(run.surge) for run in runs])[:-1])
