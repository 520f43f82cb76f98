"""Predicted speed and position under planned commands. Imports no torch.

A plan is commands, headings and yaw rates for each of the next steps. `Online.forecast` and `usvlearn.forecast` predict
the speed at the end of each step, with an interval.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError, ShapeError

LEAST_DT, MOST_DT, MOST_STEPS = 0.01, 2.0, 100_000  # s, s; steps of a plan
HEADING, YAW_RATE = 1e5, 10.0  # rad, rad/s, at most
NONE = (
    "forecast: found an estimator without forecasts, expected an ensemble that makes them: "
    "Ensemble(…, forecasts=ForecastSettings()), or one of the default configuration"
)


class Forecast(NamedTuple):
    """Predicted speeds of a plan, with 90 % intervals (the ensemble's `coverage`).

    An end is infinite where no interval is known: beyond the longest horizon after the last measured speed, before ten
    forecasts over the horizon have been compared with measurements, and after `Online.open` until the first step. The
    intervals hold for the mix of manoeuvres that was sailed: less often while commands change much, more often else.

    >>> from usvlearn import AID, Ensemble, ForecastSettings, Online
    >>> online = Online(Ensemble({"aid": AID(mass=28.0)}, forecasts=ForecastSettings()))
    >>> online.forecast([[0.5, 0.5]] * 3, headings=0.0).time.round(1).tolist()
    [0.4, 0.8, 1.2]
    """

    time: Any  # (time,) s from now, at the end of each step
    surge: Any  # (time, *batch) m/s
    low: Any  # (time, *batch) m/s
    high: Any  # (time, *batch) m/s


class Track(NamedTuple):
    """Where the boat will be under a plan, from where it is now.

    The ellipses hold the position in 90 % of the cases (the ensemble's `coverage`); `covariance` is the one whose
    ellipse of 90 % is that. It is infinite where nothing is known yet: before ten tracks have been compared with
    measured positions, and beyond the longest horizon.

    >>> one = np.ones(1)
    >>> track = Track(one, one, 0 * one, 0 * one, 0 * one, one, 0 * one, np.diag([4.0, 1.0])[None])
    >>> major, minor, bearing = track.ellipse(0.9)
    >>> float(major[0] / minor[0])
    2.0
    """

    time: Any  # (time,) s from now, at the end of each step
    surge: Any  # (time, *batch) m/s over ground, ahead
    sway: Any  # (time, *batch) m/s over ground, to starboard
    yaw_rate: Any  # (time, *batch) rad/s, clockwise
    heading: Any  # (time, *batch) rad, 0 north, clockwise; not wrapped
    north: Any  # (time, *batch) m
    east: Any  # (time, *batch) m
    covariance: Any  # (time, *batch, 2, 2) m², north and east

    def ellipse(self, level: float = 0.9) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The semi-axes, m, of the ellipse that holds the position with this probability, and the bearing of the major.

        Args:
            level: probability, no unit, 0 … 1. Other levels than 0.9 follow from it as those of a normal distribution.

        Returns:
            Major and minor semi-axis, m, and the direction of the major, rad from north, `(time, *batch)` each.

        Raises:
            ConfigError: the level is not between 0 and 1.

        >>> one = np.ones(1)
        >>> track = Track(one, one, 0 * one, 0 * one, 0 * one, one, 0 * one, np.diag([4.0, 1.0])[None])
        >>> [float(x[0].round(2)) for x in track.ellipse(0.9)]
        [4.29, 2.15, 0.0]
        """
        if isinstance(level, bool) or not isinstance(level, int | float) or not 0 < level < 1:
            raise ConfigError(f"level: found {level!r}, expected a probability between 0 and 1, both excluded")
        C = np.asarray(self.covariance, float)
        a, b, c = C[..., 0, 0], C[..., 0, 1], C[..., 1, 1]
        with np.errstate(invalid="ignore"):
            half, away = (a + c) / 2, np.hypot((a - c) / 2, b)
            bearing = np.arctan2(2 * b, a - c) / 2
        unknown = ~np.isfinite(half)
        size = -2 * math.log(1 - level)
        major, minor = (
            np.where(unknown, np.inf, np.sqrt(size * np.maximum(each, 0))) for each in (half + away, half - away)
        )
        return major, minor, np.where(unknown, 0.0, bearing)


def track_of(written: np.ndarray, dt: np.ndarray) -> Track:
    """A `Track` from what the kernel wrote, `(time, *batch, 9)`: 3 speeds, heading, 2 of the place, covariance."""
    covariance = written[..., [6, 7, 7, 8]].reshape(*written.shape[:-1], 2, 2)
    surge, sway, yaw_rate, heading, north, east = (written[..., i] for i in range(6))
    return Track(np.cumsum(dt), surge, sway, yaw_rate, heading, north, east, covariance)


def plan_inputs(commands: Any, headings: Any, yaw_rates: Any, dt: Any, batch: tuple[int, ...] = ()) -> Inputs:
    """The inputs of a plan's steps, arrays `(time, *batch)`, with `dt` in s of all steps.

    Commands are `(time, 2)` or `(time, *batch, 2)`, shares of full scale, left and right. Headings, rad at the
    beginning of each step, and yaw rates, rad/s, are a number, `(time,)` or `(time, *batch)`; without yaw rates, those
    of the headings.
    """
    h = _numbers("dt", dt)
    if h.ndim or not LEAST_DT <= h <= MOST_DT:
        raise ConfigError(f"dt: found {_shown(h)}, expected one time of {LEAST_DT:g} … {MOST_DT:g} s for all steps")
    u = _numbers("commands", commands)
    shape = (len(u) if u.ndim else 0, *batch)
    if u.shape == (shape[0], 2) and batch:
        u = np.broadcast_to(u.reshape(-1, *[1] * len(batch), 2), (*shape, 2))
    if u.shape != (*shape, 2) or not 1 <= len(u) <= MOST_STEPS:
        wide = "(time, 2)" if not batch else f"(time, 2) or (time, {', '.join(map(str, batch))}, 2)"
        raise ShapeError(f"commands: found the shape {u.shape}, expected {wide} with 1 … {MOST_STEPS} steps")
    left, right = u[..., 0], u[..., 1]
    if not _within(u, 1.0):
        for side, values in (("left", left), ("right", right)):
            _check_range("commands", values, 1.0, "shares of full scale", f" for the {side} side")
    psi = _wide("headings", headings, shape, HEADING, "rad")
    if yaw_rates is None:
        turn = np.remainder(np.diff(psi, axis=0) + math.pi, 2 * math.pi) - math.pi
        last = turn[-1:] if len(turn) else np.zeros_like(psi)
        r = np.concatenate([turn, last]) / h
    else:
        r = _wide("yaw_rates", yaw_rates, shape, YAW_RATE, "rad/s")
    return Inputs(left, right, psi, r, np.full(shape, float(h)))


def check_plan(inputs: Inputs, batch: tuple[int, ...]) -> None:
    """Raise a ConfigError unless all numbers of a plan, arrays `(time, *batch)`, are legal; a ShapeError for shapes."""
    shapes = {np.shape(x) for x in inputs}
    if (
        not all(len(shape) and shape[1:] == batch and 1 <= shape[0] <= MOST_STEPS for shape in shapes)
        or len(shapes) > 1
    ):
        wide = ", ".join(("time", *map(str, batch)))
        raise ShapeError(f"inputs: found the shapes {sorted(shapes)}, expected ({wide}), the same for all")
    limits = (1.0, "shares of full scale"), (1.0, "shares of full scale"), (HEADING, "rad"), (YAW_RATE, "rad/s")
    for name, values, (limit, unit) in zip(Inputs._fields[:4], inputs[:4], limits, strict=True):
        _check_range(name, np.asarray(values), limit, unit)
    dt = np.asarray(inputs.dt)
    if not ((dt >= LEAST_DT) & (dt <= MOST_DT)).all():
        raise ConfigError(f"dt: found {dt.min():g} … {dt.max():g}, expected {LEAST_DT:g} … {MOST_DT:g} s")


def _numbers(name: str, value: Any) -> np.ndarray:
    if value is None:
        raise ShapeError(f"{name}: found None, expected numbers")
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ShapeError(f"{name}: found {value!r:.80}, expected numbers") from error
    return array


def _wide(name: str, value: Any, shape: tuple[int, ...], limit: float, unit: str) -> np.ndarray:
    """One number, `(time,)` or `(time, *batch)` as an array `(time, *batch)`, whose numbers are within ± `limit`."""
    array = _numbers(name, value)
    if array.ndim == 0:
        if not abs(one := float(array)) <= limit:
            _check_range(name, array.reshape(1), limit, unit)
        return np.full(shape, one)
    _check_range(name, array, limit, unit)
    if array.shape == shape:
        return array
    if array.shape != shape[:1]:
        raise ShapeError(f"{name}: found the shape {array.shape}, expected one number, or {shape} as the commands have")
    return np.broadcast_to(array.reshape(-1, *[1] * (len(shape) - 1)), shape)


def _within(values: np.ndarray, limit: float) -> bool:
    """Whether all numbers are within ± `limit`, and none is NaN."""
    return not values.size or bool(-limit <= values.min() and values.max() <= limit)


def _check_range(name: str, values: np.ndarray, limit: float, unit: str, of: str = "") -> None:
    if _within(values, limit):
        return
    place = tuple(np.argwhere(~(np.abs(values) <= limit))[0])
    raise ConfigError(
        f"{name}: found {values[place]:g}{of} in step {place[0] + 1}, expected {-limit:g} … {limit:g}, {unit}"
    )


def _shown(value: np.ndarray) -> str:
    return f"{float(value):g}" if value.ndim == 0 else f"the shape {value.shape}"
