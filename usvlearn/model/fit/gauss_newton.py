"""The batch fit: the parameters that simulate all missions best, by Gauss-Newton steps on (2) of `motion_kernel`.

Equation (1): `docs/theory/identification.md#batch-fit-minimum`; g, H and I₀ are ∇L, Φ and P₀⁻¹ there. Drag that pushes
and thrust that grows with speed have no boat. The variance of a speed comes from the errors of the simulation itself
(`scale_of`): the median of their sizes would be too small where a boat lies still for long.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from usvlearn.core.jit import announce
from usvlearn.core.prepared_samples import LEARN, LEFT, MODE, RIGHT, ROW, prepare_all
from usvlearn.core.prepared_samples import SURGE as SPEED
from usvlearn.core.samples import PLAUSIBLE, Sample, tree_map
from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.model.fit import motion_kernel as kernel
from usvlearn.model.fit.terms import AT, NAMES, PLACE_LAG, PLACE_TIME, Prior, prior

ROBUST = 4.0  # deviations from which on an error counts less
CURRENT = 0.3  # m/s, prior deviation of a component of the current
NOISE, NOISE_LEAST = 0.1, 0.01  # m/s, the first deviation of a speed, and the least
ROUNDS, STEPS = 3, 5  # of the variance, each with as many steps of Gauss-Newton
PASSES = 20  # of the iteration for the variance
SHRINK, SHORTEST = 0.35, 6  # of a step that makes (1) larger, so often
TOGETHER = 4  # pieces of a mission in which thrust and drag stay the same
TOLERANCE, NOTHING_MORE = 1e-2, 0.1  # of (1), a parameter: a smaller gain ends a round; of it, one not worth a step
ALIKE = 1e-3  # of the variance's root: a smaller change needs no other round
NEGATIVE = tuple(name for name, sign in SURGE.items() if sign < 0)  # drag, and the thrust that is lost with speed
LAGS, TIMES = (-0.5, 1.5), (0.02, 5.0)  # the limits of μ, and of τ, s
NO_PLACES, NOTHING, NO_MATRIX = np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 0))  # without sensitivities


@dataclass(frozen=True)
class Fit:
    """What was fitted with one set of terms."""

    terms: str  # a name of `terms.SETS`
    top: float  # top speed of the prior and of the nodes of drag, m/s
    theta: np.ndarray  # (parameters,) by `terms.NAMES`, per unit mass; those that are not fitted are 0
    known: Prior
    loss: np.ndarray  # (missions,)
    count: np.ndarray  # (missions,) measured steps
    score: np.ndarray  # (missions, m) g
    information: np.ndarray  # (missions, m, m) H
    deviation: float  # σ of a speed, m/s
    by_mission: np.ndarray | None = None  # (missions, parameters) of a boat that wears; None: they are `theta`

    @property
    def covariance(self) -> np.ndarray:
        """(Σ H + I₀)⁻¹, `(m, m)`."""
        return np.linalg.inv(self.information.sum(0) + self.known.information)

    @property
    def total(self) -> float:
        """(1)."""
        return float(self.loss.sum()) + self.known.penalty(self.theta)

    @property
    def evidence(self) -> float:
        """The logarithm of the probability of the data under the prior, by Laplace's approximation."""
        known = self.known.information
        gained = np.linalg.slogdet(self.information.sum(0) + known)[1] - np.linalg.slogdet(known)[1]
        return -self.total - float(self.count.sum()) * math.log(self.deviation) - 0.5 * float(gained)


def rows_of(samples: Sample) -> np.ndarray:
    """Prepared samples of one mission, `(time, ROW)`; leaves of `samples` are `(time,)`."""
    wide: Sample = tree_map(lambda x: np.ascontiguousarray(np.asarray(x)[:, None]), samples)
    rows = np.empty((1, len(samples.surge), ROW))
    prepare_all(*wide.inputs, *wide[1:], True, PLAUSIBLE, rows)
    return rows[0]


def scored(rows: np.ndarray) -> np.ndarray:
    """Which steps are measured and tell something: at rest friction holds the boat, bool `(time,)`."""
    moves: np.ndarray = (rows[:, [LEFT, RIGHT, SPEED]] ** 2).sum(1) > kernel.REST
    return moves & (rows[:, MODE] == LEARN)


@cache
def compile_fit() -> None:
    """Compile the kernel, unless that is done or cached on the disk."""
    one, none = np.zeros(1), np.zeros((0, ROW))
    with announce(kernel.__file__, "kernel of the fit"):
        kernel.mission(
            none, np.zeros(len(NAMES)), np.zeros(1, np.int64), 1.0, 1.0, 1.0, 1.0, np.zeros(0), one, np.zeros((1, 1)),
            np.zeros(4 * len(NAMES) + 4), np.zeros((4, 3)), np.zeros((3, 1)),
        )  # fmt: skip


class Missions:
    """The missions of one boat, as prepared samples (`rows_of`); a piece of one has the name of its mission."""

    def __init__(self, rows: Sequence[np.ndarray], top: float, names: Sequence[str] = ()):
        compile_fit()
        self.rows, self.top = list(rows), top
        self._simulated: tuple[Fit | None, list[tuple[np.ndarray, np.ndarray]]] = None, []
        self.names = list(names) or [str(k + 1) for k in range(len(rows))]
        self.steps = [int(scored(each).sum()) for each in self.rows]
        self.number = len(set(self.names))  # of missions, whose pieces `rows` may be
        # stretches of up to ten minutes, from one to the next of which a boat may wear: that of each piece
        places = [(name, self.names[:k].count(name) // TOGETHER) for k, name in enumerate(self.names)]
        self.stretches = np.array([list(dict.fromkeys(places)).index(each) for each in places], int)

    def evaluate(self, terms: str, theta: np.ndarray, deviation: float) -> Fit:
        """Simulate all missions with the sensitivities of a set of terms."""
        known = prior(terms, self.top)
        m, count = len(known.active), len(self.rows)
        score, information = np.zeros((count, m)), np.zeros((count, m, m))
        parts = [self._one(k, theta, deviation, known.active, score[k], information[k]) for k in range(count)]
        loss, steps = np.array([each[:2] for each in parts]).reshape(-1, 2).T
        information += np.tril(information, -1).transpose(0, 2, 1)
        fit = Fit(terms, self.top, theta, known, loss, steps, score, information, deviation)
        self._simulated = fit, [each[2:] for each in parts]
        return fit

    def loss(self, theta: np.ndarray, deviation: float, k: int | None = None) -> float:
        """The loss of mission k, by default of all, without sensitivities."""
        places = range(len(self.rows)) if k is None else [k]
        return float(sum(self._one(place, theta, deviation)[0] for place in places))

    def simulate(self, fit: Fit, wears: bool = False) -> list[tuple[np.ndarray, np.ndarray]]:
        """The speed of each mission, m/s, `(time,)`, NaN without a step; its current at the end, m/s north and east.

        `wears`: with the parameters of each mission, of those to which the boat was fitted.
        """
        if fit.by_mission is not None and not wears:
            return [self._one(k, fit.theta, fit.deviation)[2:] for k in range(len(self.rows))]
        if self._simulated[0] is not fit:
            thetas = [fit.theta] * len(self.rows) if fit.by_mission is None else fit.by_mission
            self._simulated = fit, [self._one(k, theta, fit.deviation)[2:] for k, theta in enumerate(thetas)]
        return self._simulated[1]

    def _one(
        self, k: int, theta: np.ndarray, deviation: float, active: np.ndarray = NO_PLACES,
        score: np.ndarray = NOTHING, information: np.ndarray = NO_MATRIX,
    ) -> tuple[float, float, np.ndarray, np.ndarray]:  # fmt: skip
        """Loss, measured steps, speeds and current of mission k; adds to `score` and `information`."""
        rows, m = self.rows[k], len(active)
        predicted, work = np.empty(len(rows)), np.zeros(4 * len(NAMES) + m + 3)
        loss, steps = kernel.mission(
            rows, theta, active, self.top, deviation**2, CURRENT, ROBUST, predicted, score, information, work,
            np.zeros((4, 3)), np.zeros((3, m)),
        )  # fmt: skip
        return loss, steps, predicted, work[-2:]

    def errors(self, fit: Fit) -> np.ndarray:
        """Errors of the simulation at all measured steps of a boat that moves, m/s, of the missions of the fit."""
        simulated = zip(self.rows, self.simulate(fit, wears=True), strict=True)
        return np.concatenate([(speed - rows[:, SPEED])[scored(rows)] for rows, (speed, _) in simulated])

    def fit(self, terms: str, start: np.ndarray | None = None, deviation: float | None = None) -> Fit:
        """The best parameters of a set of terms; it begins with `start`, or the prior where that simulates better."""
        known, rounds = prior(terms, self.top), ROUNDS if deviation is None else ROUNDS - 1
        theta, deviation = known.mean.copy(), NOISE if deviation is None else deviation
        if start is not None and np.isfinite(start).all():
            started = theta.copy()
            started[known.active] = start[known.active]
            started[PLACE_TIME] = start[PLACE_TIME] or known.mean[PLACE_TIME]
            theta = min(theta, _bounded(started), key=lambda each: self.loss(each, deviation))
        now = self.evaluate(terms, _bounded(theta), deviation)
        for _ in range(rounds):
            now, before = self._steps(now), now
            sigma = max(scale_of(self.errors(now)), NOISE_LEAST)
            if abs(sigma / now.deviation - 1) < ALIKE and before.total - now.total < TOLERANCE * len(known.active):
                return now
            now = self.evaluate(now.terms, now.theta, sigma)
        return self._steps(now)

    def without(self, k: int) -> Missions:
        """All missions but one."""
        some = [j for j in range(len(self.rows)) if j != k]
        return Missions([self.rows[j] for j in some], self.top, [self.names[j] for j in some])

    def settled(self, start: Fit) -> Fit:
        """The best parameters of the terms and σ of a fit to any missions, after some Gauss-Newton steps from it."""
        return self._steps(self.evaluate(start.terms, start.theta, start.deviation))

    def _steps(self, now: Fit) -> Fit:
        """After some Gauss-Newton steps."""
        known, enough = now.known, TOLERANCE * len(now.known.active)
        for _ in range(STEPS):
            covariance, away = now.covariance, (now.theta - known.mean)[known.active]
            slope = now.score.sum(0) + known.information @ away
            for k in range(SHORTEST):
                theta = now.theta.copy()
                theta[known.active] -= SHRINK**k * covariance @ slope
                theta = legal(theta, known, covariance)
                step = (theta - now.theta)[known.active]
                if -(slope + np.linalg.solve(covariance, step) / 2) @ step < NOTHING_MORE * enough:
                    return now
                new = None if k else self.evaluate(now.terms, theta, now.deviation)  # most often the last trial
                total = self.loss(theta, now.deviation) + known.penalty(theta) if new is None else new.total
                if total <= now.total:
                    break
            else:
                return now
            gain, now = now.total - total, new or self.evaluate(now.terms, theta, now.deviation)
            if gain < enough:
                break
        return now


def scale_of(errors: np.ndarray) -> float:
    """The standard deviation of errors with outliers: their root mean square, each cut at `ROBUST` times the result
    (Huber 1964, proposal 2).
    """
    square = errors * errors
    scale = 1.4826 * float(np.median(np.abs(errors)))
    for _ in range(PASSES):
        scale = float(np.sqrt(np.minimum(square, (ROBUST * scale) ** 2).mean()))
    return scale


def legal(theta: np.ndarray, known: Prior, covariance: np.ndarray) -> np.ndarray:
    """The nearest parameters whose drag does not push, and whose lag and time constant are within their limits."""
    places = {place: k for k, place in enumerate(known.active)}
    quadratic, even = AT["drag_quadratic"], AT["drag_even"]
    limits = [({AT[name]: 1.0}, 0.0) for name in NEGATIVE]
    if even in places:
        limits += [({quadratic: 1.0, even: sign}, 0.0) for sign in (1.0, -1.0)]
        limits += [({AT[f"thrust_speed_{side}"]: 1.0, AT[f"thrust_even_speed_{side}"]: 1.0}, 0.0) for side in SIDES]
    for place, (low, high) in ((PLACE_LAG, LAGS), (PLACE_TIME, TIMES)):
        limits += [({place: -1.0}, -low), ({place: 1.0}, high)] if place in places else []
    for _ in range(3):
        for direction, most in limits:
            d = np.zeros(len(known.active))
            for place, value in direction.items():
                d[places[place]] = value
            if (beyond := d @ theta[known.active] - most) > 0:
                theta[known.active] -= covariance @ d * (beyond / (d @ covariance @ d))
    return _bounded(theta)


def _bounded(theta: np.ndarray) -> np.ndarray:
    theta[PLACE_LAG] = min(max(theta[PLACE_LAG], LAGS[0]), LAGS[1])
    if theta[PLACE_TIME] != 0:
        theta[PLACE_TIME] = min(max(theta[PLACE_TIME], TIMES[0]), TIMES[1])
    return theta
