"""Which servo of an ArduPilot drives what, and its pulse width as a share of full scale.

The parameter SERVOn_FUNCTION names the function of servo n. ArduPilot turns a share x of full scale into a pulse width,

    p = TRIM + x (MAX - TRIM)  for x > 0,    p = TRIM + x (TRIM - MIN)  else,

after a change of the sign of x if REVERSED is 1 (SRV_Channel::pwm_from_angle). A width of 0 means no pulses, and no
thrust.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError

OUTPUTS = ("RCOU", "RCO2", "RCO3", "SERVO_OUTPUT_RAW")  # messages of pulse widths, of a log and of telemetry
FUNCTIONS = {"throttle_left": 73, "throttle_right": 74, "throttle": 70, "steering": 26}
DEFAULTS = {"MIN": 1100.0, "TRIM": 1500.0, "MAX": 1900.0, "REVERSED": 0.0}  # of ArduPilot, us
FUNCTION = re.compile(r"SERVO(\d{1,3})_FUNCTION")


class Limits(NamedTuple):
    """The pulse widths of a servo, us."""

    low: float
    trim: float
    high: float
    reversed: bool = False

    def share(self, pwm: np.ndarray) -> np.ndarray:
        """Pulse widths as shares of full scale."""
        offset = pwm - self.trim
        span = np.where(offset > 0, self.high - self.trim, self.trim - self.low)
        shares = np.divide(offset, span, out=np.zeros_like(offset), where=span > 0)
        return np.where(pwm == 0, 0.0, -shares if self.reversed else shares)


@dataclass(frozen=True)
class Servos:
    """How a format names the pulse widths: the messages of outputs, and the pattern of the field of servo `{n}`."""

    outputs: tuple[str, ...]
    columns: str

    def find(self, name: str, parameters: Mapping[str, float], where: str) -> int:
        """The number of the first servo that drives one of `FUNCTIONS`; a LogFormatError says which there are."""
        assigned: dict[int, list[int]] = {}  # function -> servos
        for parameter, value in parameters.items():
            if (match := FUNCTION.fullmatch(parameter)) and math.isfinite(value):
                assigned.setdefault(int(value), []).append(int(match[1]))
        if servos := assigned.get(FUNCTIONS[name]):
            return min(servos)
        raise LogFormatError(f"{where}: {_no_servo(name, assigned)}")

    def are_known(self, number: int, parameters: Mapping[str, float], former: Mapping[str, float]) -> bool:
        """Whether a log holds all limits of a servo, and changes none of them."""
        names = {f"SERVO{number}_{each}" for each in DEFAULTS}
        return names <= set(parameters) and not {*names, f"SERVO{number}_FUNCTION"} & set(former)

    def column(self, number: int, fields: Collection[str]) -> str | None:
        """The field that holds the pulse width of a servo; None if there is none."""
        pattern = re.compile(self.columns.format(n=number))
        return next((field for field in fields if pattern.fullmatch(field)), None)

    def limits(
        self, number: int, parameters: Mapping[str, float], where: str, former: Mapping[str, float] | None = None
    ) -> Limits:
        """The pulse widths of a servo, by default ArduPilot's, with a warning; a LogFormatError if they do not rise."""
        names = {each: f"SERVO{number}_{each}" for each in DEFAULTS}
        for name in (*names.values(), f"SERVO{number}_FUNCTION"):
            if former and name in former:
                sentence = (
                    f"{where}: {name} is {former[name]:g}, and later {parameters[name]:g}: the last value is taken for "
                )
                warnings.warn(f"{sentence}all of the log: where it ran before, cut the log there", stacklevel=6)
        if missing := [name for each, name in names.items() if name not in parameters]:
            assumed = ", ".join(f"{name} {DEFAULTS[name.split('_')[1]]:g}" for name in missing)
            warnings.warn(
                f"{where}: found no parameter for {assumed}: assumed these defaults of ArduPilot", stacklevel=6
            )
        low, trim, high, backward = (parameters.get(name, DEFAULTS[each]) for each, name in names.items())
        finite = all(map(math.isfinite, (low, trim, high, backward)))  # a vehicle may send any float
        if not finite or not low <= trim <= high or not low < high:
            reverse = "" if math.isfinite(backward) else f", SERVO{number}_REVERSED {backward:g}"
            raise LogFormatError(
                f"{where}: found SERVO{number}_MIN {low:g}, SERVO{number}_TRIM {trim:g}, SERVO{number}_MAX {high:g}"
                f"{reverse}, expected {'them to rise' if finite else 'finite numbers that rise'}: name the servo's "
                "column in place of its function, with its zero and span"
            )
        return Limits(low, trim, high, backward == 1)


def last_and_former(given: Iterable[tuple[str, float]]) -> tuple[dict[str, float], dict[str, float]]:
    """The last value of each parameter, and the value before of those that change."""
    last: dict[str, float] = {}
    former: dict[str, float] = {}
    for name, value in given:
        if name in last and last[name] != value:
            former[name] = last[name]
        last[name] = value
    return last, former


def _no_servo(name: str, assigned: Mapping[int, list[int]]) -> str:
    expected = f"expected a servo with SERVOn_FUNCTION {FUNCTIONS[name]} ({name.replace('_', ' ')}), found"
    advice = "name the servo's column, with its zero and span (1500 and 400)"
    if not assigned:
        return f"{expected} no such parameters: {advice}"
    if FUNCTIONS["throttle"] in assigned and name in ("throttle_left", "throttle_right"):
        throttle, steering = assigned[FUNCTIONS["throttle"]][0], assigned.get(FUNCTIONS["steering"], [None])[0]
        rudder = f" and steering at servo {steering} (26)" if steering is not None else ""
        sentence = f"{expected} one throttle at servo {throttle} (70){rudder}: set field: throttle for command_left"
        return f"{sentence} and for command_right"
    listed = ", ".join(f"servo {servos[0]}: {function}" for function, servos in sorted(assigned.items()) if function)
    return f"{expected} {listed[:200] or 'no function at all'}: {advice}"
