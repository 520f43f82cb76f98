"""How well a fit describes its missions, as JSON: errors, their correlations, the curves, and where the boat sailed.

An error is simulated − measured. What is shown is that of MATLAB's `compare` and `resid`, and of WPILib's SysId: the
fit of each mission, its worst minute, the autocorrelation of the errors, and their correlation with the commands
(`usvlearn.model.fit.correlations`). For both correlations errors are cut at `ROBUST` deviations: larger ones count
less in the fit, too. The curves are thrust at standstill of each side, and drag; with their values in place of G, and
`OWN_ERROR` times them as own error, their variance is (1) of `docs/theory/identification.md#batch-fit-intervals`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.prepared_samples import DT, LEFT, MODE, PREDICT, RIGHT, SURGE
from usvlearn.display.json_values import finite
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.estimators.regressors.terms import SURGE as COEFFICIENTS
from usvlearn.evaluation.metrics import MINUTE, worst_minute
from usvlearn.evaluation.metrics import fit as per_cent
from usvlearn.model.fit.correlations import autocorrelation, cross_correlation
from usvlearn.model.fit.gauss_newton import LAGS, NEGATIVE, ROBUST, TIMES, Fit, Missions, scored
from usvlearn.model.fit.intervals import OWN_ERROR, spread
from usvlearn.model.fit.motion_kernel import REST
from usvlearn.model.fit.quantities import CurvedAhead
from usvlearn.model.fit.terms import PLACE_LAG, PLACE_TIME

AROUND = 30.0  # s, what is shown before and after a worst minute
SHOWN = 6  # missions whose worst minutes are kept as courses, those with the largest errors
EVERY = 0.5  # s, between two steps of a course
DIGITS = 5  # significant, of what is saved
COMMANDS = np.linspace(-1.0, 1.0, 81)  # of the curves of thrust
SPEEDS = 61  # points of the curve of drag
COMMAND_BINS, SPEED_BINS = np.linspace(-1.0, 1.0, 41), 30  # of the seconds beside the curves
FASTEST = 0.999  # quantile of the speed that ends the curve of drag
TINY = 1e-6  # of the drag at half speed: a smaller force is rounding
SLOW, LESS = 0.25, 0.5  # time constants of the surge, beyond which thrusters are slow; of their lag, what is too little
LATE = 0.2  # s: a thrust that follows so late does not begin before its command
FOLLOW = 1.5  # 99 % bounds, beyond which errors follow a command: with that many lags, some are beyond one by chance


class Simulated(NamedTuple):
    """A mission beside its simulation."""

    name: str
    time: np.ndarray  # (time,) s since the start of the log
    measured: np.ndarray  # (time,) m/s; NaN where there is none, or the boat rests
    speed: np.ndarray  # (time,) m/s, simulated; NaN where no step is made
    left: np.ndarray  # (time,) command; NaN where unknown
    right: np.ndarray  # (time,)
    moves: np.ndarray  # (time,) bool: a step is made in which the boat does not rest
    current: np.ndarray  # (2,) m/s north and east, at the end

    @property
    def error(self) -> np.ndarray:
        """Simulated − measured, m/s; NaN where a step does not count."""
        return self.speed - self.measured


def diagnostics(missions: Missions, fit: Fit, mass: float, others: Sequence[Fit] = ()) -> dict[str, Any]:
    """All of it for one boat, as JSON values, None if unknown; `others`, fits about as good, widen the bands."""
    pieces: dict[str, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}  # of each mission
    for name, part, (speed, current) in zip(missions.names, missions.rows, missions.simulate(fit, True), strict=True):
        pieces.setdefault(name, []).append((part, speed, current))
    every = [
        simulated(name, np.concatenate([x[0] for x in each]), np.concatenate([x[1] for x in each]), each[-1][2])
        for name, each in pieces.items()
    ]
    dt = float(np.median(np.concatenate([rows[rows[:, DT] > 0, DT] for rows in missions.rows])))
    most = ROBUST * fit.deviation  # beyond, an outlier would hide what is correlated
    errors = [np.clip(each.error, -most, most) for each in every]
    pushes = {
        "mean": [(each.left + each.right) / 2 for each in every],
        "difference": [each.left - each.right for each in every],
    }
    rows = [_mission(each, dt) for each in every]
    worst = sorted((k for k in range(len(rows)) if rows[k]["worst"]), key=lambda k: -rows[k]["worst"]["mae"])
    return finite({
        "missions": rows,
        "worst": [_course(every[k], dt, rows[k]["worst"]["start"]) for k in worst[:SHOWN]],
        "autocorrelation": autocorrelation(errors, dt)._asdict(),
        "cross_correlation": {name: cross_correlation(errors, u, dt)._asdict() for name, u in pushes.items()},
        **_curves(every, fit, mass, others, dt),
    }, DIGITS)  # fmt: skip


def doubts(
    fit: Fit, given: Mapping[str, Quantity], cross: Mapping[str, Any], online: Mapping[str, Quantity] | None,
    lag: float = 0.0,
) -> tuple[str, ...]:  # fmt: skip
    """What speaks against the use of a fit, a sentence each with what to do; `lag` of the thrust, s, as of turns."""
    said, least = [], TINY * abs(given["drag_half_speed"].value)
    pushes = [name for name in NEGATIVE if name in given and name.startswith("drag") and given[name].value > least]
    if pushes or not CurvedAhead(fit.theta, fit.top).brakes:
        said.append(
            f"The drag would push the boat, or falls with speed ({', '.join(pushes) or 'its curve'}): the logs do not "
            "tell it. Check the speed channel, or give longer logs, with turns and commands from low to full."
        )
    if fit.theta[PLACE_LAG] >= LAGS[1] or fit.theta[PLACE_TIME] >= TIMES[1]:
        said.append(
            "The lag of the thrust is at its bound: the speed follows the commands later than the fit allows. Find the "
            "delay by usvlearn inspect, set data.channels.command_left.delay and command_right.delay, and train again."
        )
    if fit.theta[PLACE_LAG] <= LAGS[0] and fit.theta[PLACE_TIME] > LATE:
        said.append(
            f"The thrust would lag its command by {fit.theta[PLACE_TIME]:.1f} s, yet begin before it: slow thrusters "
            "and boats are not told apart. Log steps of both commands together, straight ahead, and fit these alone."
        )
    if lag > SLOW * given["time_constant"].value and fit.theta[PLACE_TIME] < LESS * lag:
        said.append(
            f"The thrust follows the commands by {lag:.1f} s in turns, but by {fit.theta[PLACE_TIME]:.1f} s ahead: "
            "steering makes drag, thrust and time constant wrong then. Log steps of both commands together, straight "
            "ahead, and fit these logs alone."
        )
    for name, what in (("mean", "mean command"), ("difference", "difference of the commands")):
        lags, values, bounds = (np.array(cross[name][key], float) for key in ("lags", "values", "bounds"))
        over = np.nan_to_num(np.abs(values) / bounds)[lags >= 0]
        if over.max(initial=0.0) > FOLLOW:
            said.append(
                f"The errors of the simulation follow the {what}, most after {lags[lags >= 0][over.argmax()]:g} s: the "
                "model lacks something. Check the commands' delay, zero and sides, and the rate of the speed."
            )
    apart = [
        name for name, each in given.items()
        if online is not None and name in online and name not in COEFFICIENTS
        and (online[name].low > each.high or online[name].high < each.low)
    ]  # fmt: skip
    if apart:
        said.append(
            f"The intervals of fit and online estimate do not meet for {', '.join(apart[:SHOWN])}: one is wrong, or "
            "the boat has changed. Fit the missions before and after a change apart."
        )
    return tuple(said)


def simulated(name: str, rows: np.ndarray, speed: np.ndarray, current: np.ndarray) -> Simulated:
    """A mission beside its simulation, from prepared samples `(time, ROW)`."""
    dt, steps = float(rows[:, DT].max()), rows[:, MODE] >= PREDICT
    left, right = (np.where(steps, rows[:, place], np.nan) for place in (LEFT, RIGHT))
    with np.errstate(invalid="ignore"):
        moves = left**2 + right**2 + speed**2 > REST
    counts = scored(rows) & np.isfinite(speed)
    return Simulated(
        name, dt * np.arange(len(rows)), np.where(counts, rows[:, SURGE], np.nan), speed, left, right, moves, current
    )


def _mission(each: Simulated, dt: float) -> dict[str, Any]:
    """A mission in numbers."""
    known = np.isfinite(each.error)
    error, speed, minute = each.error[known], each.measured[known], worst_minute(each.time, each.error)
    facts: dict[str, Any] = {"name": each.name, "steps": int(known.sum()), "minutes": float(each.moves.sum()) * dt / 60}
    if minute is None:
        return facts | {"mae": None, "fit": None, "bias": None, "current": None, "worst": None}
    start, end = minute
    return facts | {
        "mae": float(np.abs(error).mean()),
        "fit": per_cent(float((error**2).sum()), float(((speed - speed.mean()) ** 2).sum())),
        "bias": float(error.mean()),
        "current": list(each.current),
        "worst": {"start": float(each.time[start]), "mae": float(np.nanmean(np.abs(each.error[start:end])))},
    }


def _course(each: Simulated, dt: float, start: float) -> dict[str, Any]:
    """The worst minute and what is around it, in means over `EVERY` seconds."""
    first, last = np.searchsorted(each.time, [start - AROUND, start + MINUTE + AROUND])
    step = max(1, round(EVERY / dt))
    count = -(-(last - first) // step)

    def thinned(x: np.ndarray) -> np.ndarray:
        part = np.full(count * step, np.nan)
        part[: last - first] = x[first:last]
        part = part.reshape(count, step)
        known = np.isfinite(part).sum(1)
        return np.where(known > 0, np.nansum(part, 1) / np.maximum(known, 1), np.nan)

    series = {"measured": each.measured, "simulated": each.speed, "left": each.left, "right": each.right}
    return {"name": each.name, "start": start, "time": thinned(each.time)} | {k: thinned(x) for k, x in series.items()}


def _curves(every: Sequence[Simulated], fit: Fit, mass: float, others: Sequence[Fit], dt: float) -> dict[str, Any]:
    """The curves with their bands, and the seconds that the boat sailed at such commands and speeds."""
    speed = np.concatenate([np.abs(each.speed[each.moves]) for each in every])
    highest = float(np.quantile(speed, FASTEST)) if len(speed) else fit.top
    curves, sailed, speeds = {}, {}, np.linspace(0.0, highest, SPEEDS)
    for side in SIDES:

        def thrust(boat: CurvedAhead, side: str = side) -> np.ndarray:
            force: np.ndarray = boat.thrust(COMMANDS, side)
            return force

        curves[f"thrust_{side}"] = {"at": COMMANDS} | band(fit, mass, others, thrust)
        used = np.concatenate([getattr(each, side)[each.moves] for each in every])
        sailed[side] = _seconds(used, COMMAND_BINS, dt)
    curves["drag"] = {"at": speeds} | band(fit, mass, others, lambda boat: boat.drag(speeds))
    sailed["speed"] = _seconds(speed, np.linspace(0.0, highest, SPEED_BINS + 1), dt)
    return {"curves": curves, "sailed": sailed}


def band(
    fit: Fit, mass: float, others: Sequence[Fit], force: Callable[[CurvedAhead], np.ndarray]
) -> dict[str, np.ndarray]:
    """A curve of forces, m/s², `(points,)`, linear in the parameters, in N with its 90 % band."""

    def curve(theta: np.ndarray) -> np.ndarray:
        return mass * force(CurvedAhead(theta, fit.top))

    value, units = curve(fit.theta), np.eye(len(fit.theta))
    slopes = np.stack([curve(units[k]) for k in fit.known.active])  # (m, points)
    apart = np.max([np.zeros_like(value), *(np.abs(curve(each.theta) - value) for each in others)], axis=0)
    variance = np.einsum("mi,mn,ni->i", slopes, spread(fit), slopes) + apart**2 + (OWN_ERROR * value) ** 2
    half = NINETY * np.sqrt(np.maximum(variance, 0.0))
    return {"value": value, "low": value - half, "high": value + half}


def _seconds(x: np.ndarray, edges: np.ndarray, dt: float) -> dict[str, np.ndarray]:
    """The seconds in each bin; what is beyond the edges counts in the last ones."""
    return {"edges": edges, "seconds": dt * np.histogram(np.clip(x, edges[0], edges[-1]), edges)[0]}
