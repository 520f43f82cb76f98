"""The evidence for the checks: all runs of one boat as series, and their means over bins of a second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from usvlearn.core.samples import Fleet
from usvlearn.logs.channels.bins import HUGE, OUTAGE, Series, bin_edges, bin_means, bin_rates, cleaned, clipped
from usvlearn.logs.channels.channel import (
    COMMANDS,
    COURSES,
    DEGREES,
    METRES,
    REQUIRED,
    SURGE,
    SWAY,
    UNITS,
    VELOCITIES,
    Channel,
    Recording,
    Source,
)
from usvlearn.logs.channels.correlations import Offset, Relation, angle_offset, in_series, relate, relate_sides
from usvlearn.logs.channels.derived_surge import pair_of
from usvlearn.logs.channels.position_rates import Motion, position_on_velocity
from usvlearn.logs.channels.positions import in_metres
from usvlearn.logs.checks.finding import override

STEP = 1.0  # s, of the bins: below the time constants of hulls, and few enough that a check takes milliseconds
TURNS_WITHIN = (0.0, 5.0)  # s, from a command to the yaw rate: the yaw time constant and a delay
MOVES_WITHIN = (0.0, 20.0)  # s, from a command to the speed: likewise
LEG, MOVING = 5.0, 0.25  # s, over which a course is taken; share of the greatest speed from which it is one
LONG_ENOUGH = 60.0  # s of courses
FOLLOWS = 0.3  # correlation of the rate of position with the commands
SEARCHED = (-150.0, 150.0)  # s, in which the delay of the commands is looked for
NONE = np.empty(0), np.empty(0)
DEFAULTS = {field.name: field.default for field in fields(Source)}


@dataclass(frozen=True)
class Evidence:
    """One boat: its runs, its settings, and what alignment made of them."""

    boat: str
    recordings: Sequence[Recording]  # of this boat
    fleet: Fleet | None  # of all boats; None if nothing could be aligned
    align: Mapping[str, Any]  # options of an Aligner
    surge_max: float  # m/s, the boat's top speed
    channels: Mapping[str, Any]  # data.channels of the configuration; nothing for simulated boats
    horizons: Sequence[float] = ()  # s, of the forecasts

    def settings(self, name: str) -> dict[str, Any]:
        """The options of a channel's `Source`, as configured."""
        given = self.channels.get(name) or {}
        if not isinstance(given, Mapping):
            given = vars(given)
        return {**DEFAULTS, "name": name, **given}

    def factor(self, name: str) -> float:
        """By how much a value is greater than the number that stands in the log."""
        settings = self.settings(name)
        return UNITS[settings["unit"]][0] / (settings["span"] if isinstance(settings["span"], int | float) else 1.0)

    def logs(self, name: str) -> list[Channel]:
        """The channel of each run that has it."""
        return [one.channels[name] for one in self.recordings if name in one.channels]

    @cached_property
    def alone(self) -> list[Evidence]:
        """Each run by itself, where there are several."""
        return [replace(self, recordings=[one]) for one in self.recordings] if len(self.recordings) > 1 else []

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """All values of each channel that are numbers, SI units; empty where a required channel has none."""
        names = dict.fromkeys([*REQUIRED, *(name for one in self.recordings for name in one.channels)])
        whole = {name: np.concatenate([each.value for each in self.logs(name)] or [np.empty(0)]) for name in names}
        return {name: value[np.abs(value) < HUGE] for name, value in whole.items()}

    @cached_property
    def fastest(self) -> float:
        """The speed that 0.5 % of the values exceed, m/s; 0 if there is none."""
        speed = np.abs(self.values[SURGE])
        return float(np.quantile(speed, 0.995)) if len(speed) else 0.0

    @cached_property
    def series(self) -> dict[str, Series]:
        """All runs one behind the other, each value at the time of its effect; positions as metres north and east."""
        return {**dict.fromkeys(REQUIRED, NONE), **in_series(_series_of(one.channels) for one in self.recordings)}

    def place(self, time: float) -> tuple[str, float]:
        """The run in which a time of `series` lies, and the seconds since its first value."""
        began, run = 0.0, ""
        for one in self.recordings:
            series = in_series([_series_of(one.channels)])
            lasted = max((each[-1] for each, _ in series.values()), default=0.0)
            run = one.run
            if time <= began + lasted:
                break
            began += lasted + OUTAGE
        return run, time - began

    @cached_property
    def edges(self) -> np.ndarray:
        """The edges of the bins, s."""
        return bin_edges(STEP, *(self.series[name] for name in (SURGE, "heading")))

    def means(self, name: str) -> np.ndarray:
        """Means of a channel, `(bins,)`; commands are held between their messages."""
        means = bin_means(self.series[name], self.edges, held=name in COMMANDS)
        return clipped(means) if name == SURGE else means

    @cached_property
    def commands(self) -> tuple[np.ndarray, np.ndarray]:
        """Means of the commands left and right, `(bins,)`."""
        return self.means(COMMANDS[0]), self.means(COMMANDS[1])

    @cached_property
    def thrust(self) -> np.ndarray:
        """The mean of both commands, `(bins,)`."""
        return (self.commands[0] + self.commands[1]) / 2

    @cached_property
    def speed(self) -> np.ndarray:
        """Means of the speed, `(bins,)`, m/s."""
        return self.means(SURGE)

    @cached_property
    def turn(self) -> np.ndarray:
        """Rates of the heading, `(bins,)`, rad/s if its unit is right."""
        return clipped(bin_rates(self.series["heading"], self.edges, wraps=True))

    @cached_property
    def thrust_on_speed(self) -> Relation:
        """The speed against both commands, at the best lag that a boat can have."""
        return relate(self.thrust, self.speed, STEP, MOVES_WITHIN)

    @cached_property
    def searched(self) -> Relation:
        """Likewise, at the best of all lags."""
        return relate(self.thrust, self.speed, STEP, SEARCHED)

    @cached_property
    def turns(self) -> Relation:
        """The turn against the difference of the commands."""
        return relate(self.commands[0] - self.commands[1], self.turn, STEP, TURNS_WITHIN)

    @cached_property
    def course(self) -> Offset:
        """By how much the course over ground differs from the heading while the boat moves ahead.

        It comes from positions; without them from the course and speed over ground, or from velocities.
        """
        edges = self.moving_edges(LEG)
        north, east = self.velocity(edges)
        at = (edges[:-1] + edges[1:]) / 2
        ahead = bin_means(self.series[SURGE], edges) if len(edges) else at
        computed = self.speeds != (SURGE,)  # with a wrong heading such a surge has a wrong sign
        moving = (np.hypot(north, east) > MOVING * min(self.surge_max, self.fastest)) & (computed | (ahead > 0))
        return angle_offset((at[moving], np.arctan2(east, north)[moving]), self.series["heading"], LEG)

    def moving_edges(self, step: float, *others: Series) -> np.ndarray:
        """The edges of bins, s, in which the velocity over ground and other series are known."""
        return bin_edges(step, *self._moved, *others)

    def velocity(self, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The velocity over ground to the north and to the east, `(bins,)`, m/s."""
        measured = bin_rates if self.has_position else bin_means
        first, second = self._moved
        return measured(first, edges), measured(second, edges)

    @property
    def _moved(self) -> tuple[Series, Series]:
        """Positions north and east; without them velocities over ground."""
        if not self.has_position and all(name in self.series for name in COURSES):
            (time, speed), (stamps, course) = (cleaned(self.series[name]) for name in COURSES)
            if len(time) and len(stamps):
                turned = np.interp(time, stamps, np.unwrap(course))
                return (time, speed * np.cos(turned)), (time, speed * np.sin(turned))
        names = METRES if self.has_position else VELOCITIES
        return self.series.get(names[0], NONE), self.series.get(names[1], NONE)

    def rate(self, step: float) -> np.ndarray:
        """The size of the rate of position over bins of so many s, m/s, NaN where it is not known."""
        edges = self.edges if step == STEP else bin_edges(step, *(self.series[name] for name in METRES))
        return np.hypot(*(bin_rates(self.series[name], edges) for name in METRES))

    @property
    def has_position(self) -> bool:
        return all(name in self.series for name in METRES)

    @property
    def places(self) -> tuple[str, str]:
        """The channels of the position as they are logged; `METRES` if there is none."""
        return DEGREES if all(name in self.series for name in DEGREES) else METRES

    @property
    def speeds(self) -> tuple[str, ...]:
        """The channels that hold the size of the speed; () if it is computed from the position itself."""
        if SURGE in self.channels or not self.channels:
            return (SURGE,)
        pair = pair_of(self.channels)
        return VELOCITIES if pair == VELOCITIES else COURSES[:1] if pair == COURSES else ()

    @cached_property
    def size(self) -> Series:
        """The speed whose unit is configured: the surge, that over ground, or the size of the velocity, m/s."""
        if self.speeds == VELOCITIES:
            (time, north), (stamps, east) = (cleaned(self.series.get(name, NONE)) for name in VELOCITIES)
            return (time, np.hypot(north, np.interp(time, stamps, east))) if len(time) and len(stamps) else NONE
        return self.series.get((self.speeds or (SURGE,))[0], NONE)

    @cached_property
    def over_ground(self) -> tuple[Series, Series]:
        """The measured velocity to the north and to the east, from surge, sway and heading, m/s.

        The sway counts as 0 where it is not logged; it is also known from velocities to the north and to the east.
        """
        time, ahead = cleaned(self.series[SURGE])
        turned = cleaned(self.series["heading"])
        if not len(time) or not len(turned[0]):
            return NONE, NONE
        heading = np.interp(time, turned[0], np.unwrap(turned[1]))
        aside = np.zeros(len(time))
        if SWAY in self.series:
            aside = np.interp(time, *cleaned(self.series[SWAY]))
        elif all(name in self.series for name in VELOCITIES):
            north, east = (np.interp(time, *cleaned(self.series[name])) for name in VELOCITIES)
            aside = east * np.cos(heading) - north * np.sin(heading)
        velocity = (ahead + 1j * aside) * np.exp(1j * heading)
        return (time, velocity.real), (time, velocity.imag)

    @cached_property
    def motion(self) -> Motion:
        """The rate of the position against the measured velocity."""
        north, east = (self.series.get(name, NONE) for name in METRES)
        return position_on_velocity((north, east), self.over_ground, LEG)

    @property
    def sense(self) -> float | None:
        """1 if the heading turns with the course, -1 if against it, None where that is not known."""
        course = self.course
        clear = course.seconds >= LONG_ENOUGH and course.concentration > 0.8 and course.rival < 0.6
        return course.sign if clear else None

    def sides(self, part: slice = slice(None)) -> tuple[tuple[Relation, Relation], tuple[Relation, Relation]]:
        """The turn, and the speed, against the command of each side, over some of the bins."""
        left, right = (side[part] for side in self.commands)
        return (
            relate_sides(left, right, self.turn[part], STEP, TURNS_WITHIN),
            relate_sides(left, right, self.speed[part], STEP, MOVES_WITHIN),
        )


def without(e: Evidence, name: str) -> str:
    """The overrides that leave a channel out, where nothing needs it, or others do its work; else "".

    The heading stands in for a yaw rate, and a position whose rate follows the commands for a speed.
    """
    names: tuple[str, ...] = (name,) if name == "yaw_rate" else ()
    if name in (*METRES, *DEGREES):
        names = e.places if e.speeds else ()
    elif name == SURGE and e.speeds == (SURGE,) and e.has_position:
        moved = relate(e.thrust, e.rate(STEP), STEP, MOVES_WITHIN)
        names = (SURGE,) if moved.correlation > FOLLOWS else ()
    return " ".join(override(each, {"name": None}) for each in names) if e.channels else ""


def spread(values: np.ndarray) -> float:
    """The standard deviation of those that are known; 0 if none is."""
    known = values[np.isfinite(values)]
    return float(known.std()) if len(known) else 0.0


def angular(e: Evidence, name: str) -> str:
    """The unit of a heading or a yaw rate; "1" is SI."""
    unit = e.settings(name)["unit"]
    return ("rad" if name == "heading" else "rad/s") if unit == "1" else unit


def mirrored(unit: str) -> str:
    """The unit of the other sense."""
    return unit.removeprefix("enu_") if unit.startswith("enu_") else f"enu_{unit}"


def _series_of(channels: Mapping[str, Channel]) -> dict[str, Series]:
    """The channels of a run as pairs of time and value."""
    series = {name: (each.time + each.delay, each.value) for name, each in channels.items()}
    if all(name in series for name in DEGREES):
        latitude, longitude = (cleaned(series[name]) for name in DEGREES)
        if len(latitude[0]) and len(longitude[0]):
            time, *metres = in_metres(latitude, longitude)
            series |= {name: (time, each) for name, each in zip(METRES, metres, strict=True)}
    return series
