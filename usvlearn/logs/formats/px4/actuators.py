"""Which motor and servo of a PX4 drives what, by its parameters: https://docs.px4.io/main/en/config/actuators.html"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

TOPICS = MOTORS, SERVOS, OUTPUTS = "actuator_motors", "actuator_servos", "actuator_outputs"
FUNCTION = re.compile(r"PWM_(MAIN|AUX)_FUNC(\d{1,2})")
FIRST = {MOTORS: 101, SERVOS: 201}  # values of PWM_MAIN_FUNCn
DRIVEN = ("throttle_left", "throttle_right", "throttle", "steering", "motor_1", "motor_2")
Topics = Mapping[str, Mapping[str, np.ndarray]]  # topic -> field -> (n,)


def actuators(parameters: Mapping[str, float]) -> dict[str, tuple[str, list[int]]]:
    """name of `DRIVEN` -> the topic and the numbers, from 0, of what drives it; {} where nothing tells."""
    places = {number: parameters.get(f"CA_ROTOR{number}_PY", 0.0) for number in range(12)}
    left, right = ([number for number, y in places.items() if sign * y > 0] for sign in (-1, 1))
    if left and right:
        return {"throttle_left": (MOTORS, left), "throttle_right": (MOTORS, right)}
    ackermann = {"throttle": (MOTORS, [0]), "steering": (SERVOS, [0])}
    differential = {"motor_1": (MOTORS, [0]), "motor_2": (MOTORS, [1])}  # firmwares number them differently
    return {5.0: ackermann, 6.0: differential}.get(parameters.get("CA_AIRFRAME", 0.0), {})


def command(kind: str, number: int, parameters: Mapping[str, float], topics: Topics) -> tuple[str, np.ndarray]:
    """The topic that holds an actuator's command, and its shares of full scale; pulses in us without limits."""
    share = topics.get(kind, {}).get(f"control[{number}]")
    if share is not None and np.isfinite(share).any():
        return kind, np.nan_to_num(share.astype(np.float64))  # NaN stops a motor
    for bank, output in (each.groups() for each in map(FUNCTION.fullmatch, parameters) if each):
        topic = f"{OUTPUTS}[1]" if bank == "AUX" and f"{OUTPUTS}[1]" in topics else OUTPUTS
        pulses = topics.get(topic, {}).get(f"output[{int(output) - 1}]")
        if pulses is None or parameters[f"PWM_{bank}_FUNC{output}"] != FIRST[kind] + number:
            continue
        names = *(f"PWM_{bank}_{name}" for name in (f"MIN{output}", f"MAX{output}", "REV")), "CA_R_REV"
        low, high, backward, both = (parameters.get(name, math.nan) for name in names)
        if not high > low or not math.isfinite(backward + both):
            return topic, pulses.astype(np.float64)
        zero = (low + high) / 2 if kind == SERVOS or int(both) >> number & 1 else low
        sign = -1 if int(backward) >> (int(output) - 1) & 1 else 1
        stopped = ~(pulses > 0) | (pulses == parameters.get(f"PWM_{bank}_DIS{output}"))
        return topic, np.where(stopped, 0.0, sign * (pulses - zero) / (high - zero))
    return "", np.empty(0)  # nothing holds it
