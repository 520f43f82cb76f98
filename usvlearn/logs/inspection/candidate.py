"""One series of a log as a candidate for a channel: its numbers, and what they, or its format, show by themselves."""

from __future__ import annotations

import dataclasses
import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from usvlearn.logs.channels.series import Series
from usvlearn.logs.formats.ardupilot.servos import OUTPUTS
from usvlearn.logs.formats.csv.opened import ROTATION
from usvlearn.logs.formats.px4.ulog import DRIVEN, TOPICS
from usvlearn.logs.inspection.vocabulary import fit, unit_word

HELD = 7.0  # s, for which no measured speed of a boat that moves is the same, unless its sensor is slower
IS_SET = "is constant for long, and jumps or rises evenly in between, as a setpoint does and nothing that is measured"
EVIDENCE_HZ = 10.0  # values a second that relations look at
WRAP = 0.1  # by how much a jump of a heading may differ from a full turn
TURNS = {"deg": 360.0, "rad": 2 * math.pi}
LOOP = re.compile(r"(.*[ ./])?(?:([ryeu])[_.](\w+)|(\w+)[_.]([ryeu]))", re.IGNORECASE)
MEANINGS = {"r": " reference", "y": "", "e": " error", "u": " input"}  # of a control loop
UNKNOWN = {511.0, 1023.0, 102.3, 255.0, 65535.0, 32767.0, -32768.0, -128.0,
           *(sign * (10.0**k - part) for sign in (1, -1) for k in (2, 3, 4, 5) for part in (1, 0.1, 0.01))}  # fmt: skip
DIFFERENT, APART, APART_KNOWN = 20, 2.0, 0.35  # values; distances of one from all others, over their extent
ANYWHERE = (-math.inf, math.inf)
PLAIN = (  # roles, how well a name must fit, and the size up to which a number means itself; where all of them lie
    (("command", "rudder"), 1, 5000.0, (800.0, 2200.0)),  # full scale; pulses, of which 0 is none
    (("heading", "course"), 1, 360.0, (0.0, 360.0)),  # a wrap
    (("latitude", "longitude"), 2, -1.0, ANYWHERE),  # 0, 0 is no fix of a receiver
)
ANGLES = {"deg", "rad", "enu_rad", "enu_deg"}
PLACE = re.compile(r"\[\d+\]|@\S*")  # of a name: its instance and its sender
KNOWN: dict[str, dict[str, tuple[str, ...]]] = {  # format -> role -> messages and fields, the best first
    "ArduPilot DataFlash": {"heading": ("ATT Yaw", "XKF1 Yaw", "NKF1 Yaw"), "velocity": ("XKF1 VN", "NKF1 VN"),
                            "position": ("POS Lat", "GPS Lat")},
    "MAVLink telemetry": {"heading": ("ATTITUDE yaw", "GLOBAL_POSITION_INT hdg"),
                          "velocity": ("LOCAL_POSITION_NED vx", "GLOBAL_POSITION_INT vx"),
                          "position": ("LOCAL_POSITION_NED x", "GLOBAL_POSITION_INT lat")},
    "PX4 ULog": {"heading": ("vehicle_attitude q", "vehicle_local_position heading"),
                 "velocity": ("vehicle_local_position vx",),
                 "position": ("vehicle_global_position lat", "vehicle_local_position x")},
}  # fmt: skip
UNRANKED = 9  # the rank of what is not known


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """A series, its finite values, and statistics; name, field and kind as in `Series`."""

    name: str
    field: str | None
    unit: str  # as the log declares it, or as the name tells; "" where neither does
    kind: str
    time: np.ndarray  # (n,), in the order of the log
    value: np.ndarray
    spoken: str = ""  # what it is judged by in place of its name: see `of_loops`
    span: float = 1.0  # by which its numbers were divided
    missing: tuple[float, ...] = ()  # numbers that mean "unknown", and are not among the values

    @property
    def label(self) -> str:
        """What a person calls it."""
        if self.spoken:
            return self.spoken
        if self.kind == ROTATION:
            return f"{self.name} {ROTATION}"
        return self.name if self.field in (None, "data") else f"{self.name} {self.field}"

    @property
    def by_parameters(self) -> bool:
        """Whether the parameters of an autopilot say what it drives, as a share of full scale."""
        return self.field in DRIVEN and re.split(r"[\[@]", self.name)[0] in (*OUTPUTS, *TOPICS)

    @cached_property
    def intervals(self) -> np.ndarray:
        """Times between two values, s, without those of the same stamp."""
        steps = np.diff(np.sort(self.time))
        return steps[steps > 1e-6]

    @cached_property
    def interval(self) -> float:
        """The median time between two values, s; NaN of a single value."""
        return float(np.median(self.intervals)) if len(self.intervals) else math.nan

    @cached_property
    def slow(self) -> float:
        """The 98th percentile of the times between two values, s, without outages of more than 20 median intervals."""
        usual = self.intervals[self.intervals < 20 * self.interval]
        return float(np.quantile(usual, 0.98)) if len(usual) else math.nan

    @cached_property
    def gaps(self) -> int:
        """Silences of more than 5 median intervals and 1 s, within a log."""
        return int(((self.intervals > max(5 * self.interval, 1.0)) & (self.intervals < 900)).sum())

    @cached_property
    def repeats(self) -> float:
        """Share of the values that equal the one before."""
        return float((np.diff(self.value) == 0).mean()) if len(self.value) > 1 else 0.0

    @cached_property
    def extent(self) -> tuple[float, float]:
        """The least and the greatest value, without the outermost 0.1 % at each end."""
        if not len(self.value):
            return math.nan, math.nan
        low, high = np.quantile(self.value, [0.001, 0.999], method="nearest")
        return float(low), float(high)

    @property
    def size(self) -> float:
        """The greatest size of a value, without outliers."""
        return max(map(abs, self.extent))

    @property
    def is_signed(self) -> bool:
        """Whether values are below 0 by more than noise may be."""
        return self.extent[0] < -0.03 * self.size

    @property
    def varies(self) -> bool:
        return len(self.value) > 3 and self.extent[1] > self.extent[0]

    @cached_property
    def is_clock(self) -> bool:
        """Whether it only rises, at an even rate: a stamp or a counter."""
        if len(self.value) < 10:
            return False
        steps = np.diff(self.value)
        rising = steps[steps > 0]
        return len(rising) > 0.95 * len(steps) and bool(np.corrcoef(self.time[1:], np.cumsum(steps))[0, 1] > 0.999)

    @cached_property
    def wraps(self) -> str:
        """The unit in which it jumps by full turns, "deg" or "rad"; "" if it does not."""
        jumps = np.abs(np.diff(self.value))
        for unit, turn in TURNS.items():
            large = jumps > 0.6 * turn
            if large.any() and (jumps[large] < turn * 1.02).all() and np.median(jumps[large]) > turn * (1 - 2 * WRAP):
                if np.ptp(self.value) <= turn * 1.02 and np.ptp(self.value) > 0.8 * turn:
                    return unit
        return ""

    @cached_property
    def is_set(self) -> bool:
        """Whether it is constant for long, and jumps or rises evenly in between, as setpoints do and no boat."""
        (time, value), some = self.evidence, 0.02 * self.size
        time, value = (each[np.argsort(time, kind="stable")] for each in (time, value))
        first = np.flatnonzero(np.append(True, np.diff(value) != 0))  # of each value that holds
        lasts = time[np.append(first[1:], len(time)) - 1] - time[first] + self.interval
        steps, moves = np.abs(np.diff(value[first])), np.abs(value[first]) > some
        long = moves & (lasts > HELD)
        if long.sum() < 3 or lasts[long].sum() < 0.4 * lasts[moves].sum():
            return False
        even = np.mean(np.abs(np.diff(steps)) < 0.2 * steps[1:]) > 0.8 and np.median(np.diff(first)) == 1
        return bool(even or (len(first) < 3 * long.sum() and np.median(steps) > 5 * some))

    @cached_property
    def evidence(self) -> tuple[np.ndarray, np.ndarray]:
        """Times and values, at most `EVIDENCE_HZ` of them a second, for relations."""
        place = np.floor(self.time * EVIDENCE_HZ)
        chosen = np.append(True, place[1:] != place[:-1])
        return self.time[chosen], self.value[chosen]

    def scaled(self, factor: float, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """The evidence in other units."""
        time, value = self.evidence
        return time, factor * value + offset

    def source(self, **keys: Any) -> dict[str, Any]:
        """The arguments of a `Source` that reads it."""
        place: dict[str, Any] = {"name": self.name}
        if self.field is not None and self.field != "data":
            place["field"] = self.field
        return {**place, **keys, **({"missing": list(self.missing)} if self.missing else {})}

    def named(self, **changes) -> Candidate:
        return dataclasses.replace(self, **changes)


def held_at(series: tuple[np.ndarray, np.ndarray], at: np.ndarray) -> np.ndarray:
    """The value of a series, times and values, that holds at other times until its next one."""
    order = np.argsort(series[0], kind="stable")
    return series[1][order][np.clip(np.searchsorted(series[0][order], at, side="right") - 1, 0, None)]


def candidates(series: list[Series]) -> list[Candidate]:
    """The series that hold numbers, as candidates."""
    pool = []
    for each in series:
        known = np.isfinite(each.value) & np.isfinite(each.time)
        if known.any():
            label = f"{each.name} {each.field or ''}"
            unit = each.unit or unit_word(label)
            speed = max(fit(role, label) for role in ("surge", "heading", "yaw_rate")) >= 1
            if unit == "m" and each.name.endswith("_m") and speed:
                unit = ""  # measured, and no metres
            kinds = [kind[2:] for kind in PLAIN if any(fit(role, label) >= kind[1] for role in kind[0])]
            missing = missing_values(each.value[known], *(kinds or [(0.0, ANYWHERE)])[0])
            known &= ~np.isin(each.value, missing)
            measured = Candidate(each.name, each.field, unit, each.kind, each.time[known], each.value[known])
            pool.append(measured.named(missing=missing))
    return of_loops(pool)


def missing_values(value: np.ndarray, plain: float = 0.0, within: tuple[float, float] = ANYWHERE) -> tuple[float, ...]:
    """Numbers that mean "unknown": the same again and again, far beyond all others; none of a size up to `plain`.

    So is an integer below `within`, where all others lie.
    """
    numbers: list[float] = []
    values, counts = np.unique(value, return_counts=True)
    low, high = within
    while len(values) > DIFFERENT:
        below = bool(values[0] < low <= values[1] and values[0] == round(values[0]) and values[-1] <= high)
        end = 0 if below or values[1] - values[0] > values[-1] - values[-2] else -1
        rest = np.delete(values, end)
        apart, extent = abs(values[end] - rest[end]), rest[-1] - rest[0]
        number = float(values[end])
        least = APART_KNOWN if number in UNKNOWN or abs(number) >= 1e15 else APART
        beyond = below or (apart > least * extent and abs(number) > plain)
        if not (beyond and 1 < counts[end] < 0.5 * len(value)):
            break
        numbers.append(number)
        values, counts = rest, np.delete(counts, end)
    return tuple(sorted(numbers))


def of_loops(pool: list[Candidate]) -> list[Candidate]:
    """The series; those of a controller, such as r_speed, y_speed, e_speed, are judged by what these letters mean."""
    loops: dict[tuple[str, str], dict[str, Candidate]] = {}
    for each in pool:
        if split := LOOP.fullmatch(each.name if each.field in (None, "data") else f"{each.name} {each.field}"):
            head, letter, stem = split[1] or "", split[2] or split[5], split[3] or split[4]
            loops.setdefault((head, stem), {})[letter.lower()] = each
    spoken: dict[int, str] = {}
    for (head, stem), loop in loops.items():
        if {"y", "r"} <= loop.keys() or {"y", "e", "u"} <= loop.keys():
            spoken |= {id(each): f"{head}{stem}{MEANINGS[letter]}" for letter, each in loop.items()}
    return [each.named(spoken=spoken[id(each)]) if id(each) in spoken else each for each in pool]


def rank(candidate: Candidate, role: str, convention: str) -> int:
    """The place among the known messages of a role, 0 for the best; `UNRANKED` if it is none."""
    known, label = KNOWN.get(convention, {}).get(role, ()), PLACE.sub("", candidate.label)
    return known.index(label) if label in known else UNRANKED
