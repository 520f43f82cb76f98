"""The parameters of the servos, asked from the vehicle one by one until it has answered."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ardupilot.servos import DEFAULTS, FUNCTIONS, Limits
from usvlearn.logs.formats.ardupilot.tlog import SERVOS

OUTPUTS = 16  # servos whose function is asked for
KNOWN = re.compile(rf"SERVO([1-9]|[12]\d|3[0-2])_(FUNCTION|{'|'.join(DEFAULTS)})")
PATIENT, SELDOM = 10, 15  # times that a parameter is asked for each second; after them, every so many seconds
AT_ONCE = 20  # parameters asked for in one second: 640 bytes


class ServoParameters:
    """Which servo drives what, as the vehicle says.

    Args:
        functions: those that are needed, such as `throttle_left`; empty: nothing is asked.

    >>> from types import SimpleNamespace
    >>> servos = ServoParameters(["throttle_left"])
    >>> servos.to_ask()[:2], len(servos.to_ask())
    (['SERVO1_FUNCTION', 'SERVO2_FUNCTION'], 16)
    >>> for n in range(1, 17):
    ...     servos.learn(f"SERVO{n}_FUNCTION", 73.0 if n == 3 else 0.0)
    >>> servos.to_ask()
    ['SERVO3_MIN', 'SERVO3_TRIM', 'SERVO3_MAX', 'SERVO3_REVERSED']
    >>> for name, value in zip(servos.to_ask(), (1100.0, 1500.0, 1900.0, 0.0), strict=True):
    ...     servos.learn(name, value)
    >>> servos.to_ask(), servos.share("throttle_left", SimpleNamespace(servo3_raw=1700))
    ([], 0.5)
    """

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
        if (found := self._found.get(function)) is None:
            return None
        column, limits = found
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
