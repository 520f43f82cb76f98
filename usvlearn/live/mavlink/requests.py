"""The vehicle's clock, and requests to the vehicle: messages at a rate, and the parameters of its servos.

Stamps in `time_boot_ms` are taken as they are. A stamp that is implausible, because it is before the last one or ahead
of it by more than the time since, is held back until the next one agrees with it: then the vehicle has booted anew, or
its 32 bits began anew (after 49.7 days), or its clock was set. A single wrong stamp so changes nothing.

A message without a stamp has the time of its receipt, less the least delay of recent stamped messages. A stamp of
32 bits in us begins anew every 71.6 minutes; the turn that is meant is the one nearest to the receipt. These rules are
those of `usvlearn.logs.formats.ardupilot.tlog`, as far as they can be followed without knowing what comes later.

A request may be lost, a reboot forgets it, and a ground station may change the rate. What counts is what arrives: a
message that comes at less than half of the rate is asked for again, at first after 3 s, then ever less often.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ardupilot.servos import DEFAULTS, FUNCTIONS, Limits
from usvlearn.logs.formats.ardupilot.tlog import CLOCK_LIMIT, SERVOS, WRAP

RECENT = 60.0  # s over which the least delay is taken: clocks drift apart


class BootClock:
    """Stamps of messages, s since the vehicle's boot. Receipts are in s of any steady clock."""

    def __init__(self) -> None:
        self.last, self.boots = math.nan, 0  # the newest stamp, s; how often the clock went back
        self._received = math.nan  # when the newest stamp was received
        self._doubted = math.nan  # a stamp that was held back
        self._least, self._before = math.inf, math.inf  # least delay of this period, and of the one before
        self._begun = -math.inf  # of this period

    def stamp(self, stamp: float, received: float) -> float | None:
        """A stamp in `time_boot_ms`, in s, if it can be used; None if it is held back."""
        if math.isnan(self.last):
            self.last = stamp
        ahead = max(self.last, self.last + received - self._received)
        if not self.last - CLOCK_LIMIT <= stamp <= ahead + CLOCK_LIMIT:
            agrees = abs(stamp - self._doubted) <= CLOCK_LIMIT
            self._doubted = stamp
            if not agrees:
                return None
            self.boots += stamp < self.last
            self.last, self._least, self._before = stamp, math.inf, math.inf
        self._doubted = math.nan
        if stamp >= self.last:
            self.last, self._received = stamp, received
        self._learn_delay(received - stamp, received)
        return stamp

    def _learn_delay(self, delay: float, received: float) -> None:
        if abs(delay - self._offset()) > CLOCK_LIMIT:
            self._least = self._before = math.inf
        if received - self._begun > RECENT:
            self._least, self._before, self._begun = math.inf, self._least, received
        self._least = min(self._least, delay)

    def _offset(self) -> float:
        return min(self._least, self._before)

    def of_receipt(self, received: float) -> float:
        """The vehicle's time of a receipt, s; NaN before the first stamp."""
        return received - self._offset() if math.isfinite(self._offset()) else math.nan

    def of_micros(self, micros: int, bits: int, received: float) -> float:
        """The vehicle's time of a stamp in us of 32 or 64 bits, or that of the receipt if they do not fit, s."""
        expected = self.of_receipt(received)
        stamp = 1e-6 * micros
        if bits == 32 and math.isfinite(expected):
            stamp += WRAP * round((expected - stamp) / WRAP)
        return stamp if abs(stamp - expected) <= CLOCK_LIMIT else expected

    def now(self, clock: float) -> float:
        """The vehicle's time now, by the newest stamp, s; NaN before the first."""
        return self.last + clock - self._received


LEAST, MOST = 3.0, 60.0  # s between two requests for a message


@dataclass
class _Wish:
    """One message."""

    count: int = 0  # that have arrived since the last request
    asked: float = float("nan")  # when it was asked for
    wait: float = LEAST  # until the next look


class Intervals:
    """The rates of the messages of the autopilot."""

    def __init__(self, hz: float):  # wanted of each message
        self.hz = hz
        self._wishes: dict[int, _Wish] = {}

    def wish(self, number: int) -> None:
        """From now on, ask for this message."""
        self._wishes.setdefault(number, _Wish())

    def arrived(self, number: int) -> None:
        """A message has come."""
        if (wish := self._wishes.get(number)) is not None:
            wish.count += 1

    def again(self) -> None:
        """The vehicle has booted: ask for all of them at once."""
        self._wishes = {number: _Wish() for number in self._wishes}

    def due(self, now: float) -> list[int]:
        """The messages to ask for now; `now` in s of a steady clock."""
        numbers = []
        for number, wish in self._wishes.items():
            age = now - wish.asked
            if age < wish.wait:
                continue
            if wish.count >= 0.5 * self.hz * age:
                wish.count, wish.asked, wish.wait = 0, now, LEAST  # it comes: look again later
                continue
            wish.wait = LEAST if age != age else min(2 * wish.wait, MOST)
            wish.count, wish.asked = 0, now
            numbers.append(number)
        return numbers


OUTPUTS = 16  # servos whose function is asked for
KNOWN = re.compile(rf"SERVO([1-9]|[12]\d|3[0-2])_(FUNCTION|{'|'.join(DEFAULTS)})")
PATIENT, SELDOM = 10, 15  # times that a parameter is asked for each second; after them, every so many seconds
AT_ONCE = 20  # parameters asked for in one second: 640 bytes


class ServoParameters:
    """Which servo drives what, as the vehicle says."""

    def __init__(self, functions: Collection[str]):
        self.functions = list(dict.fromkeys(functions))
        self.problem: str | None = None  # why no command can be read, in words
        self.remarks: list[str] = []  # what was assumed
        self._values: dict[str, float] = {}
        self._asked: dict[str, int] = {}  # what has not been answered since the last boot -> how often it was asked
        self._found: dict[str, tuple[str, Limits]] = {}
        self.ask_again()

    def ask_again(self) -> None:
        """The vehicle has booted: it may have other parameters; the old ones are used until it answers."""
        names = (f"SERVO{n}_FUNCTION" for n in range(1, OUTPUTS + 1)) if self.functions else ()
        self._asked = dict.fromkeys((*names, *self._values), 0)
        self._resolve()

    def to_ask(self) -> list[str]:
        """The names to ask for in this second."""
        names = [name for name, times in self._asked.items() if times < PATIENT or times % SELDOM == 0]
        for name in self._asked:
            if name in names[:AT_ONCE] or name not in names:
                self._asked[name] += 1
        if PATIENT in self._asked.values():
            self._resolve()  # without what has not been answered
        return names[:AT_ONCE]

    def learn(self, name: str, value: float) -> None:
        """Take the value of a parameter, whoever has asked for it."""
        if not KNOWN.fullmatch(name) or not self.functions:
            return
        answered = self._asked.pop(name, None) is not None
        if answered or self._values.get(name) != value:
            self._values[name] = value
            self._resolve()

    @property
    def one_command(self) -> bool:
        """Whether one servo drives both sides."""
        left, right = (self._found.get(f"throttle_{side}") for side in ("left", "right"))
        return left is not None and left == right

    def share(self, function: str, message: Any) -> float | None:
        """The share of full scale in a SERVO_OUTPUT_RAW; None while the servo is unknown."""
        if (servo := self._found.get(function)) is None:
            return None
        column, limits = servo
        return float(limits.share(np.array([getattr(message, column)], float))[0])

    def _resolve(self) -> None:
        self._found, self.problem, self.remarks = {}, None, []
        functions = {name: value for name, value in self._values.items() if name.endswith("_FUNCTION")}
        awaited = [name for name, times in self._asked.items() if name.endswith("_FUNCTION") and times < PATIENT]
        if any(name not in functions for name in awaited):
            return  # a servo of a lower number may have the same function
        for function in self.functions:
            try:
                number = self._number(function, functions)
                names = [f"SERVO{number}_{each}" for each in DEFAULTS]
                if missing := [name for name in names if name not in self._values]:
                    self._asked |= {name: 0 for name in missing if name not in self._asked}
                    continue
                column = SERVOS.column(number, [f"servo{n}_raw" for n in range(1, OUTPUTS + 1)])
                if column is None:
                    raise LogFormatError(f"the vehicle: {function} is servo {number}, which SERVO_OUTPUT_RAW lacks")
                self._found[function] = column, SERVOS.limits(number, self._values, "the vehicle")
            except LogFormatError as error:
                self.problem = str(error)

    def _number(self, function: str, functions: dict[str, float]) -> int:
        """The servo of a function; of a boat with one throttle and a rudder, that throttle for both sides."""
        try:
            return SERVOS.find(function, functions, "the vehicle")
        except LogFormatError:
            if function not in ("throttle_left", "throttle_right"):
                raise
            try:
                number = SERVOS.find("throttle", functions, "the vehicle")
            except LogFormatError:
                number = None
            if number is None:
                raise
            self.remarks.append(
                f"{function}: no servo has function {FUNCTIONS[function]}; the throttle, servo {number}, is taken"
            )
            return number
