"""The parameters of the models: their names, signs and units, by the terms that a model has. Imports no torch."""

from collections.abc import Collection, Mapping
from math import factorial
from typing import Any

QUASI_STATIC = {  # parameter: its sign by physics; 0: the map is not a force
    "zeta_right_linear": 0,
    "zeta_right_quadratic": 0,
    "zeta_right_cubic": 0,
    "zeta_left_linear": 0,
    "zeta_left_quadratic": 0,
    "zeta_left_cubic": 0,
    "zeta_heading_sin": 0,
    "zeta_heading_cos": 0,
    "zeta_yaw_rate": 0,  # m/rad
}
SURGE = {
    "drag_quadratic": -1,  # c_q, kg/m
    "drag_linear": -1,  # c_l, kg/s
    "drag_cross": -1,  # c_θ̇, kg/rad
    "thrust_linear_left": 1,  # α_L, N
    "thrust_quadratic_left": 1,  # β_L, N
    "thrust_speed_left": -1,  # γ_L, N s/m
    "thrust_linear_right": 1,
    "thrust_quadratic_right": 1,
    "thrust_speed_right": -1,
}
CUBIC = {"thrust_cubic_left": 0, "thrust_cubic_right": 0}  # κ_L, κ_R, N: bends a thrust curve either way
EVEN = {  # e of the joint EKF: what does not change its sign with the speed and the commands
    "drag_even": "kg/m",
    **{f"thrust_even_{kind}_{side}": unit for side in ("left", "right")
       for kind, unit in {"linear": "N", "quadratic": "N", "speed": "N s/m"}.items()},
}  # fmt: skip
LAG, DISTURBANCE, CURRENT = "command_lag", "disturbance", ("current_north", "current_east")
UNITS = {
    "drag_quadratic": "kg/m", "drag_linear": "kg/s", "drag_cross": "kg/rad",
    **{f"thrust_{kind}_{side}": unit for side in ("left", "right")
       for kind, unit in {"linear": "N", "quadratic": "N", "speed": "N s/m", "cubic": "N"}.items()},
    **EVEN, LAG: "share of a step", DISTURBANCE: "N", **dict.fromkeys(CURRENT, "m/s"),
}  # fmt: skip

# What a model may have. "exponential" is not a term but the step that is made with the others.
TERMS: tuple[list[str], ...] = (
    [],
    *(["dynamics", *cubic, *step] for step in ([], ["exponential"]) for cubic in ([], ["cubic"])),
)

LEAST, MOST = -20.0, 1.0  # of dt Ĵ in the exponential step: identified parameters may be far off
NEAR = 0.125  # |z| below which the derivative of φ1 is its series, because the closed form cancels
SERIES = tuple((k + 1) / factorial(k + 2) for k in range(9, -1, -1))  # of the derivative of φ1, from the highest power


def signs_of(terms: Collection[str]) -> dict[str, int]:
    """The parameters of a model with these terms, in their order, each with its sign."""
    if "dynamics" not in terms:
        return QUASI_STATIC
    return SURGE | CUBIC if "cubic" in terms else SURGE


def parameters(own: Mapping[str, Any]) -> int:
    """How many parameters an estimator has, from its entries in a description."""
    return len(signs_of(own["terms"]))


def heading(own: Mapping[str, Any]) -> bool:
    """Whether its regressor asks for the heading."""
    return "dynamics" not in own["terms"]
