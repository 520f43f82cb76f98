"""All that is known of an identified boat, as JSON values: the content of `BOAT.json`, `BOAT.mat`, `BOAT_planar.json`.

`names` is explained in `docs/export.md#gazebo-and-mss`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import usvlearn
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.quantities import MEANING, SIDES
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.logs.alignment.mixing import Mix
from usvlearn.logs.channels.channel import COMMANDS
from usvlearn.model.export.planar_boat import AXES, PlanarBoat
from usvlearn.model.planar import UNITS as AXIS_UNITS
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.model.surge import TABLE_COMMANDS, SurgeModel

NOTE = (
    "mass contains the added mass, which speeds do not tell apart, so Xudot and xDotU are 0. These names have no drag "
    "of turning, and no loss of thrust with speed: where thrust_speed is not 0, steady speeds differ."
)


def conventions(model: SurgeModel) -> dict[str, dict[str, float]]:
    """Mass, kg, and drag of motion ahead, kg/s and kg/m, by simulator and its names; thrust at standstill, N."""
    boat, mass = model.ahead, model.mass
    linear, quadratic = mass * float(boat.linear), mass * float(boat.quadratic)
    thrust = {f"thrust_full_{side}": mass * float(boat.thrust(1.0, side)) for side in SIDES}
    return {
        "mss": {"m": mass, "Xudot": 0.0, "Xu": linear, "Xuu": quadratic, **thrust},
        "gz_sim": {"mass": mass, "xDotU": 0.0, "xU": linear, "xUabsU": quadratic, **thrust},
        "vrx": {"mass": mass, "xDotU": 0.0, "xU": -linear, "xUU": -quadratic, **thrust},
    }


FORMAT = "usvlearn boat 1"
FORCE = (
    "m dv/dt = drag_quadratic v|v| + drag_linear v + drag_cross |r| v + sum over left and right of (thrust_linear x + "
    "thrust_quadratic x|x| + thrust_speed x|v| + thrust_cubic x^3)"
)
EVEN_FORCE = " + drag_even v^2 + sum of (thrust_even_linear |x| + thrust_even_quadratic x^2 + thrust_even_speed x v)"
TABLES = (
    " + sum of thrust_table(x) + sign(v) drag_table(|v|); tables are linear between their points, and go on beyond them"
)
STEP = "with f = dv/dt, J = df/dv, z = min(dt J, 1): the speed after dt is v + dt f (exp(z) - 1)/z"
SIGNS = (
    "v: speed ahead through the water, m/s. x: command of a side as a share of full scale, -1 to 1, positive ahead. "
    "r: yaw rate, rad/s. Positive force pushes ahead: the coefficients of drag are negative, thrust ahead is positive. "
    "drag_half_speed and the curve drag are the size of the resistance, positive."
)
UNIT_OF_CURVE = {"drag": ("m/s", "N"), "steady_speed": ("1", "m/s")}  # of the others: share of full command, N


def described(boat: IdentifiedBoat) -> dict[str, Any]:
    """The document of a boat; `model` has what `SurgeModel.step` uses, at full precision, `identified` motion ahead."""
    model, identified = boat.model, boat.identified
    return {
        "format": FORMAT,
        "usvlearn": usvlearn.__version__,
        "boat": boat.name,
        "set": set_of(boat.path, boat.facts),
        "equation": equation(model),
        "step": STEP,
        "signs": SIGNS,
        **surge_of(boat),
        "identified": {
            "basis": identified.basis,
            "meaning": MEANING,
            "lacks": list(boat.lacks),
            "quantities": identified.json(),
        },
        "covariance": {
            "note": "of the parameters per unit mass, of which the intervals are made; command_lag: a share of a step",
            "parameters": list(identified.names),
            "values": identified.theta.tolist(),
            "matrix": identified.covariance.tolist(),
        },
        "curves": {
            name: dict(zip(("at_unit", "unit"), UNIT_OF_CURVE.get(name, ("1", "N")), strict=True))
            | {key: values.tolist() for key, values in curve._asdict().items()}
            for name, curve in curves(identified).items()
        },
        "commands": commands_of(boat),
        "names": {"note": NOTE, **conventions(model)},
    }


def set_of(path: Path, facts: Mapping[str, Any]) -> dict[str, str]:
    """Which checkpoint it is: its file, run and step."""
    return {"file": path.name} | {key: str(facts[key]) for key in ("run", "step") if key in facts}


def surge_of(boat: IdentifiedBoat) -> dict[str, Any]:
    """Mass, coefficients and tables of the surge."""
    model = boat.model
    return {
        "mass": {"value": model.mass, "unit": "kg", "basis": boat.identified.scale},
        "model": {name: {"value": value, "unit": UNITS[name]} for name, value in model.coefficients.items()},
        **_tables(model),
    }


def equation(model: SurgeModel) -> str:
    """The forces of a model, one line."""
    return FORCE + (EVEN_FORCE if model.even else "") + (TABLES if model.tables is not None else "")


def _tables(model: SurgeModel) -> dict[str, Any]:
    """The tables of a batch fit, and the time constant of its thrusters; {} without."""
    if model.tables is None:
        return {}
    thrust = {
        f"thrust_table_{side}": {"at": TABLE_COMMANDS.tolist(), "at_unit": "1", "value": each.tolist(), "unit": "N"}
        for side, each in model.tables.thrust.items()
    }
    drag = {
        "at": [0.0, *model.tables.speeds.tolist()], "at_unit": "m/s",
        "value": [0.0, *model.tables.drag.tolist()], "unit": "N",
    }  # fmt: skip
    lag = {
        "value": model.thruster, "unit": "s",
        "note": "x follows the command with this time constant; 0: at once, or not known",
    }  # fmt: skip
    return {"tables": thrust | {"drag_table": drag}, "thruster_time_constant": lag}


def commands_of(boat: IdentifiedBoat) -> dict[str, Any]:
    """How a logged value becomes a command: (value − zero)/span, from the checkpoint's setup; {} if that is unknown."""
    commands: dict[str, Any] = {}
    for side in COMMANDS:
        channel = None if boat.setup is None else boat.setup.channels.get(side)
        if channel is not None:
            commands[side] = channel.json() if isinstance(channel, Mix) else asdict(channel)
    return commands


PLANAR_FORMAT = "usvlearn planar boat 1"
EACH_SIDE = "sum over SIDE = left and right of (linear_SIDE x + quadratic_SIDE x|x|"
EQUATIONS = {
    "yaw": (
        "dr/dt = bias + linear r + quadratic r|r| + cross |u| r + coupling u v + other v + surge u + "
        f"{EACH_SIDE} + speed_SIDE x|u| + cubic_SIDE x^3 + even_linear_SIDE |x| + even_quadratic_SIDE x^2)"
    ),
    "sway": f"dv/dt = bias + linear v + quadratic v|v| + cross |u| v + coupling u r + other r + surge u + {EACH_SIDE})",
}
PLANAR_STEP = (
    "with f = dy/dt, J = df/dy, z = min(dt J, 1) of y = r, v or u: y after dt is y + dt f (exp(z) - 1)/z. In this "
    "order: r, from the u and v before; psi, by dt times the mean of r before and after; v, from the u and r before; "
    "u, from the mean of r before and after; north and east, by dt times the current, and dt times the mean of the "
    "velocity before and after, each turned by its psi: u cos(psi) - v sin(psi) north, u sin(psi) + v cos(psi) east"
)
PLANAR_SIGNS = (
    "u: speed ahead through the water, m/s. v: speed to starboard through the water, m/s. r: yaw rate, rad/s, "
    "clockwise seen from above. psi: heading, rad, clockwise from north, not wrapped. north, east: position, m. "
    "current: the velocity of the water over ground, m/s. x: command of a side as a share of full scale, -1 to 1, "
    "positive ahead. More command on the left than on the right turns to starboard: r becomes positive."
)
RENAMED = "In the equation of the surge, v is the speed ahead, which is u elsewhere."


def planar_described(planar: PlanarBoat) -> dict[str, Any]:
    """The document: the coefficients that `usvlearn.model.planar.PlanarModel.step` uses, at full precision."""
    boat, model = planar.boat, planar.model
    surge = {"equation": equation(boat.model), "note": RENAMED, **surge_of(boat)}
    axes = {axis: _axis(planar, axis) for axis in AXES}
    return {
        "format": PLANAR_FORMAT,
        "usvlearn": usvlearn.__version__,
        "boat": boat.name,
        "set": {"surge": set_of(boat.path, boat.facts), "planar": set_of(planar.path, planar.facts)},
        "step": PLANAR_STEP,
        "signs": PLANAR_SIGNS,
        "surge": surge,
        **{axis: each if getattr(model, axis) is not None else None for axis, each in axes.items()},
        "lacks": list(planar.lacks),
        "commands": commands_of(boat),
    }


def _axis(planar: PlanarBoat, axis: str) -> dict[str, Any]:
    coefficients, learned = getattr(planar.model, axis) or {}, planar.learned[axis]
    return {
        "equation": EQUATIONS[axis],
        "model": {name: {"value": value, "unit": AXIS_UNITS[axis][name]} for name, value in coefficients.items()},
        "learned": {
            "updates": int(learned.updates),
            "noise": {"value": learned.deviation, "unit": "rad/s" if axis == "yaw" else "m/s"},
            "command_lag": {
                "value": float(learned.mean[-1]), "unit": "1",
                "note": "share of a step by which commands acted late; the step here has none",
            },
        },
    }  # fmt: skip
