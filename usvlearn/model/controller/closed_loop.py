"""The closed loop over boats that are drawn from what was identified: a sampled controller, late commands, saturation.

Each boat has parameters θ ~ N(θ̄, C) and its own delay. It moves straight ahead, by the step of `usvlearn.model.surge`:

    v⁺ = v + h φ₁(h J) f,   f = q v|v| + (l + Γ ξ) v + Σ T(ξ),   J = 2 q |v| + l + Γ ξ
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import Ahead

STEP = 0.05  # s, longest of the simulation
BAND = 0.05  # of a step of the wanted speed: settled within it
SWAY = 0.1  # of a step, peak to peak in its last quarter: unstable
TRIALS = 50  # draws for each boat that is wanted


class Law(Protocol):
    """A sampled controller of several boats."""

    period: float  # s

    def start(self, boats: int) -> None:
        """Forget everything."""

    def command(self, wanted: float, speed: np.ndarray) -> np.ndarray:
        """The command of both sides, 0 … 1, from the wanted and the measured speed, m/s, `(boats,)`."""
        ...


class Responses(NamedTuple):
    """The closed loop over time."""

    time: np.ndarray  # (steps,) s
    wanted: np.ndarray  # (steps,) m/s
    speed: np.ndarray  # (steps, boats) m/s
    command: np.ndarray  # (steps, boats) share of full command, as the controller sends it


class Step(NamedTuple):
    """How the boats follow one step of the wanted speed."""

    before: float  # m/s
    after: float
    overshoot: np.ndarray  # (boats,) share of the step
    settled: np.ndarray  # (boats,) s; infinite where the speed is not within `BAND` at the end
    sways: np.ndarray  # (boats,) bool: unstable


def draws(found: Identified, count: int, seed: int = 0) -> np.ndarray:
    """Parameters of boats, `(count, m)`: the mean, the present estimate, and draws in which drag brakes.

    Raises:
        ConfigError: hardly any draw is a boat.
    """
    beside = found.beside
    assert beside is not None
    values, vectors = np.linalg.eigh(found.covariance)
    normal = np.random.default_rng(seed).standard_normal((TRIALS * count, len(found.theta)))
    every = found.theta + (normal * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    every = np.concatenate([found.theta[None], beside.now[None], every])
    boat = found.ahead(every)
    with np.errstate(invalid="ignore"):
        speeds = boat.steady_speed(1.0)
        real = boat.brakes & np.isfinite(speeds) & (speeds > 0)
    if real.sum() < count:
        raise ConfigError(
            "--boats: found hardly any boat in the intervals, in which drag brakes: learn from a longer log"
        )
    return every[real][:count]


def simulate(boat: Ahead, delay: np.ndarray, law: Law, wanted: Sequence[float], hold: float) -> Responses:
    """Boats from rest that are to have some speeds in turn.

    Args:
        boat: of parameters `(boats, m)`.
        delay: of the commands, s, `(boats,)`.
        law: the controller.
        wanted: speeds, m/s, each for `hold` s.
        hold: s.
    """
    boats = len(delay)
    substeps = math.ceil(law.period / STEP)
    h = law.period / substeps
    late = np.rint(np.clip(delay, 0.0, None) / h).astype(int)
    ticks = math.ceil(hold / law.period)
    law.start(boats)
    total = ticks * len(wanted) * substeps
    time, target = h * np.arange(1, total + 1), np.repeat(np.asarray(wanted, float), ticks * substeps)
    sent, speed, v = np.zeros((total, boats)), np.zeros((total, boats)), np.zeros(boats)
    column = np.arange(boats)
    for k in range(total):
        if k % substeps == 0:
            given = law.command(float(target[k]), v)
        sent[k] = given
        place = k - late
        xi = np.where(place >= 0, sent[np.maximum(place, 0), column], 0.0)
        v = ahead_step(boat, v, xi, h)
        speed[k] = v
    return Responses(time, target, speed, sent)


def ahead_step(boat: Ahead, v: np.ndarray, xi: np.ndarray, h: float) -> np.ndarray:
    """The speeds h s later, m/s, `(boats,)`, under the same command on both sides, 0 … 1."""
    f, slope = boat.motion(v, xi)
    z = np.minimum(h * slope, 1.0)
    small = np.abs(z) < 1e-8
    return v + h * f * np.where(small, 1.0, np.expm1(z) / np.where(small, 1.0, z))


def steps_of(responses: Responses) -> list[Step]:
    """How the boats follow each step of the wanted speed after the first, which begins at rest."""
    changes = np.flatnonzero(np.diff(responses.wanted)) + 1
    edges = [*changes.tolist(), len(responses.wanted)]
    found = []
    for begin, end in pairwise(edges):
        before, after = float(responses.wanted[begin - 1]), float(responses.wanted[begin])
        course = (responses.speed[begin:end] - before) / (after - before)  # 0 … 1
        outside = np.abs(course - 1) > BAND
        last = len(course) - 1 - outside[::-1].argmax(0)
        time = responses.time[begin:end] - responses.time[begin - 1]
        settled = np.where(outside.any(0), time[np.minimum(last + 1, len(course) - 1)], 0.0)
        late = course[3 * len(course) // 4 :]
        found.append(
            Step(
                before,
                after,
                np.maximum(course.max(0) - 1, 0.0),
                np.where(outside[-1], np.inf, settled),
                ~(np.ptp(late, axis=0) <= SWAY),
            )
        )
    return found
