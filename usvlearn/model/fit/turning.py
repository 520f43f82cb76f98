"""Turning: a fit of (1) of `turning_kernel` to the headings of all missions, and its quantities with 90 % intervals.

Gauss-Newton steps minimise Σ L + ½ |(θ − θ₀)/σ₀|² over pieces of 150 s, with θ₀ and σ₀ in `PRIOR`. The speed is that of
the log, less the current of the fitted surge. Intervals are on the log scale, with the variance of `intervals`; their
own error contains that of the speed in a turn, which the fitted surge tells.

The derivation is in `docs/theory/identification.md#batch-fit-turning`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.jit import announce
from usvlearn.core.prepared_samples import COS, LEARN, MODE, PREDICT, ROW, SIN, SURGE, YAW_RATE
from usvlearn.estimators.axis.turning_intervals import HARDLY, TOLD, VAGUE, joined, on_log_scale
from usvlearn.estimators.axis.turning_quantities import INNER, OF_FIT, QUANTITIES, balance
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.quantities import COMMANDS
from usvlearn.model.fit import turning_kernel as at
from usvlearn.model.fit.boat import FittedBoat, Turning
from usvlearn.model.fit.gauss_newton import Fit
from usvlearn.model.fit.intervals import spread
from usvlearn.model.fit.logs import DT as GRID
from usvlearn.model.fit.pieces import SECONDS
from usvlearn.model.fit.terms import AT, Prior

POSITIVE = [at.D0, at.D1, at.D2, at.LAG, at.DEAD, at.ASTERN, at.SIDE, at.PROCESS, at.COMPASS, at.GYRO]
PRIOR = {  # θ₀ and σ₀; of POSITIVE for the logarithm
    at.K1: (0.5, 3.0), at.K2: (0.5, 3.0), at.LOSS: (0.0, 1.0), at.RUDDER: (0.0, 1.0), at.BIAS: (0.0, 0.3),
    at.D0: (0.0, 1.5), at.D1: (0.0, 1.5), at.D2: (0.3, 1.5), at.LAG: (-1.6, 1.5), at.LATE: (0.0, 0.2),
    at.DEAD: (-3.0, 0.6), at.ASTERN: (-0.3, 0.3), at.SIDE: (0.0, 0.25), at.ZERO: (0.0, 0.02),
    at.PROCESS: (-5.0, 3.0), at.COMPASS: (-8.0, 3.0), at.GYRO: (-10.0, 3.0), at.OFFSET: (0.0, 0.02),
}  # fmt: skip
MEAN, DEVIATION = np.array([PRIOR[j] for j in range(at.PARAMETERS)]).T
ALIKE = (np.isin(np.arange(at.PARAMETERS), [at.LAG, at.D0]) / 0.5)[:, None]  # thrusters of slow boats are slow
KNOWN = Prior(MEAN, np.arange(at.PARAMETERS), np.diag(DEVIATION**-2) + ALIKE @ ALIKE.T)
MOST = 100  # pieces that are fitted: of longer logs, so many that are evenly spread
STEPS, SHORTEST, TOLERANCE = 40, 8, 1e-2  # of Gauss-Newton; how often one is halved; the gain that ends it
STEP, HALVINGS, FASTEST = 1e-4, 40, 3.0  # deviations of a central difference; of an interval of speeds; top speeds
OWN_ERROR = dict.fromkeys(QUANTITIES, 0.02) | {
    "yaw_rate_full_difference": 0.05, "yaw_time_constant": 0.06, "yaw_time_constant_rest": 0.12,
}  # fmt: skip
SWAPPED = 0.8  # own error of a time constant, by the square of its ratio to LAG, with which it may be swapped
OWN_DEAD, VAGUE_DEAD = (0.001, 0.03), 0.04  # own error of a dead zone, and relative; a half-width that tells none
OWN_LAG, VAGUE_LAG = (0.06, 0.35), 0.6  # likewise of the lag of the thrust, s
NO_DEAD = "The dead zone does not show: dead_zone is not known. Let the boat turn by commands from 0 to 20 %."
SPEED_ERROR = {"full": 0.02, "half": 0.03, "quarter": 0.1, "difference": 0.6}  # of the speed in a turn, relative


def natural(theta: np.ndarray) -> np.ndarray:
    """The parameters of the kernel, `(..., m)`."""
    p = np.array(theta, float)
    p[..., POSITIVE] = np.exp(np.clip(p[..., POSITIVE], -30, 10))
    return p


def prepared(rows: np.ndarray, top: float, current: Sequence[float] | np.ndarray = (0.0, 0.0)) -> np.ndarray:
    """A mission of `logs.missions_of` as the kernel reads it, without its current, m/s north and east."""
    table = rows.copy()
    last = np.maximum.accumulate((rows[:, MODE] == LEARN) * np.arange(len(rows)))
    table[:, SURGE] = (rows[last, SURGE] - rows[:, COS] * current[0] - rows[:, SIN] * current[1]) / top
    return table


def evaluate(theta: np.ndarray, pieces: Sequence[np.ndarray]) -> Fit:
    """The sum and its derivatives for some parameters."""
    p, count, m = natural(theta), len(pieces), at.PARAMETERS
    loss, score, information, work = np.zeros(count), np.zeros((count, m)), np.zeros((count, m, m)), np.zeros((12, m))
    with announce(at.__file__, "kernel of turning"):
        for k, rows in enumerate(pieces):
            loss[k] = at.turned(rows, p, score[k], information[k], np.zeros((len(rows), 2)), work)
    slopes = np.where(np.isin(np.arange(m), POSITIVE), p, 1.0)
    information = (information + np.tril(information, -1).transpose(0, 2, 1)) * np.outer(slopes, slopes)
    return Fit("turning", math.nan, theta, KNOWN, loss, np.ones(count), score * slopes, information, math.nan)


def fitted(missions: Iterable[np.ndarray], start: np.ndarray = MEAN) -> Fit:
    """The fit to some missions of `prepared`."""
    pieces = [part for rows in missions for part in np.array_split(rows, max(round(len(rows) * GRID / SECONDS), 1))]
    pieces = [pieces[k] for k in np.unique(np.linspace(0, len(pieces) - 1, MOST).astype(int))]
    fit = evaluate(start, pieces)
    for _ in range(STEPS):
        move = -fit.covariance @ (fit.score.sum(0) + KNOWN.information @ (fit.theta - MEAN))
        trials = (evaluate(fit.theta + 0.5**k * move, pieces) for k in range(SHORTEST))
        better = next((each for each in trials if each.total < fit.total), fit)
        gain, fit = fit.total - better.total, better
        if gain < TOLERANCE:
            break
    return fit


def first_fit(missions: Mapping[str, np.ndarray], top: float) -> tuple[dict[str, np.ndarray], Fit | None]:
    """The missions with E|r| in place of slopes of headings, and the fit to speeds over ground; None: no headings."""
    if not all(rows.shape[1] > ROW for rows in missions.values()):
        return dict(missions), None
    fit, by_name, m = fitted(prepared(rows, top) for rows in missions.values()), {}, at.PARAMETERS
    for name, rows in missions.items():
        r, by_name[name] = np.zeros((len(rows), 2)), rows.copy()
        at.turned(prepared(rows, top), natural(fit.theta), np.zeros(m), np.zeros((m, m)), r, np.zeros((12, m)))
        use = (rows[:, MODE] >= PREDICT) & np.isfinite(r[:, 0]) & np.isnan(rows[:, at.RATE])
        size, wide = np.abs(r[use, 0]), np.sqrt(2 * r[use, 1])
        erf = np.array([math.erf(x) for x in size / wide])
        expected = wide / math.sqrt(math.pi) * np.exp(-((size / wide) ** 2)) + size * erf
        by_name[name][use, YAW_RATE] = np.copysign(expected, r[use, 0])
    return by_name, fit


def push(p: np.ndarray, xi: np.ndarray, u: np.ndarray | float) -> np.ndarray:
    """τ of (1) of the kernel, rad/s², of commands at speeds u over the top speed; p is `(m, …)`."""
    c = np.maximum(np.abs(xi) - p[at.DEAD], 0.0) / (1 - p[at.DEAD])
    moment: np.ndarray = np.where(xi > 0, c, -p[at.ASTERN] * c) * (p[at.K1] + p[at.LOSS] * u + p[at.K2] * c)
    return moment


def rate(p: np.ndarray, left: np.ndarray, right: np.ndarray, u: np.ndarray) -> np.ndarray:
    """The steady yaw rate, rad/s; arguments as of `push`."""
    turn = push(p, left, u) - p[at.SIDE] * push(p, right, u) + p[at.RUDDER] * u * u * (left - right) + p[at.BIAS]
    return np.asarray(balance(-p[at.D1], -(p[at.D0] + p[at.D2] * u), turn))


def explained(fit: Fit, missions: Sequence[np.ndarray]) -> float:
    """The share of the yaw rate's mean square that the commands explain, without any heading measured on the way."""
    p, m, missed, whole = natural(fit.theta), at.PARAMETERS, 0.0, 0.0
    for rows in missions:
        alone, rates = rows.copy(), np.zeros((2, len(rows), 2))
        begun = np.cumsum(np.isfinite(rows[:, at.HEADING])) > 1
        alone[begun & np.append(False, rows[:-1, MODE] >= PREDICT), at.HEADING :] = np.nan
        for each, out in zip((rows, alone), rates, strict=True):
            at.turned(each, p, np.zeros(m), np.zeros((m, m)), out, np.zeros((12, m)))
        measured, predicted = rates[:, np.isfinite(rates[..., 0]).all(0), 0]
        missed, whole = missed + np.sum((measured - predicted) ** 2), whole + np.sum(measured**2)
    return float(1 - missed / whole) if whole else 0.0


def quantities(theta: np.ndarray, boat: FittedBoat, faster: np.ndarray) -> dict[str, np.ndarray]:
    """The quantities of turning by name, `(n,)`, of θ, `(n, m)`, with speeds times exp(`faster`), `(n,)`. The surge has
    the speed of one command with the thrust of both sides; under full difference the boat creeps ahead.
    """
    p, surge, top = natural(theta).T, boat.ahead(boat.theta), boat.top
    outer, inner = np.array([[1.0, -1.0], *([x, INNER * x] for x in COMMANDS.values())]).T
    left, right = np.stack([outer, inner])[..., None], np.stack([inner, outer])[..., None]  # to starboard, to port
    mean = np.maximum(push(p, left, 0.0) + p[at.SIDE] * push(p, right, 0.0), 0.0) / (1 + p[at.SIDE])
    both = p[at.DEAD] + (1 - p[at.DEAD]) * balance(-p[at.K2], -p[at.K1], mean)
    both = np.where((both > 0) & (both < 1.2), both, (left + right) / 2)  # without a curve, as of a rudder alone
    low, high = np.zeros(both.shape), np.full(both.shape, FASTEST * top)
    for _ in range(HALVINGS):
        u = (low + high) / 2
        up = (
            surge.motion(u, both)[0]
            + boat.every(boat.theta)[AT["drag_cross"]] * np.abs(rate(p, left, right, u / top)) * u
            > 0
        )
        low, high = np.where(up, u, low), np.where(up, high, u)
    u, r = u * np.exp(faster), rate(p, left, right, u * np.exp(faster) / top)
    constants = [1 / (p[at.D0] + p[at.D2] * speed / top) for speed in (boat["steady_speed_half"].value, 0.0)]
    return dict(zip(QUANTITIES, [*(r[0] - r[1]) / 2, *((u[0] + u[1]) / (r[0] - r[1]))[1:], *constants], strict=True))


def with_turning(boat: FittedBoat, fit: Fit, missions: Sequence[np.ndarray] = ()) -> FittedBoat:
    """The fitted boat with the quantities of turning behind those of the surge; NaN if it hardly turned."""
    m, steps, P, lag = at.PARAMETERS, STEP * np.diag(DEVIATION), spread(fit), natural(fit.theta)[at.LAG]
    known, vague = {}, False
    shifted = fit.theta + np.concatenate([np.zeros((1, m)), steps, -steps, np.zeros((1, m))])
    for name, values in quantities(shifted, boat, STEP * (np.arange(2 * m + 2) > 2 * m)).items():
        value, command = float(values[0]), name.rpartition("_")[2]
        slopes, error = (values[1 : m + 1] - values[m + 1 : -1]) / (2 * steps.diagonal()), SPEED_ERROR.get(command, 0.0)
        if command in COMMANDS:
            speed = boat[f"steady_speed_{command}"]
            error = math.hypot(error, (speed.high - speed.low) / (2 * NINETY * speed.value))
        variance = float(slopes @ P @ slopes) + ((values[-1] - value) / STEP * error) ** 2
        model_error = OWN_ERROR[name] + (SWAPPED * (lag / value) ** 2 if "constant" in name else 0.0)
        known[name] = on_log_scale(value, variance, model_error, QUANTITIES[name])
        vague |= name == TOLD and not variance < (VAGUE * value) ** 2
    if vague:
        known = {name: on_log_scale(math.nan, 0.0, 0.0, unit) for name, unit in QUANTITIES.items()}
    boat, dead = joined(boat, known, (HARDLY,) if vague else ()), natural(fit.theta)[at.DEAD]
    for name, place, value, errors, most in (
        ("thrust_lag", at.LAG, lag, OWN_LAG, VAGUE_LAG), ("dead_zone", at.DEAD, dead, OWN_DEAD, VAGUE_DEAD),
    ):  # fmt: skip
        half = NINETY * math.hypot(value * math.sqrt(P[place, place]), errors[0], errors[1] * value)
        value = math.nan if vague or not half < most else float(value)
        known[name] = Quantity(value, max(value - half, 0.0), value + half, OF_FIT[name])
    lacks = (NO_DEAD,) if math.isnan(value) else ()
    own_quantities = {name: known[name] for name in ("thrust_lag", "dead_zone")}
    turning = None if vague else Turning(fit.theta, P, explained(fit, missions))
    return replace(boat, quantities=boat.quantities | own_quantities, lacks=(*boat.lacks, *lacks), turning=turning)
