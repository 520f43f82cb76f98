"""All that is known of an identified boat, as JSON values: the content of `BOAT.json` and of `BOAT.mat`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import usvlearn
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.logs.alignment.mixing import Mix
from usvlearn.logs.channels.channel import COMMANDS
from usvlearn.model.export.conventions import NOTE, conventions
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.model.surge import TABLE_COMMANDS, SurgeModel

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
    """The document of a boat.

    `model` has the coefficients that `usvlearn.model.surge.SurgeModel.step` uses, at full precision. `identified` has
    the physical quantities with their 90 % intervals, where the coefficients of motion ahead are summed.
    """
    model, found = boat.model, boat.found
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
            "basis": found.basis,
            "meaning": MEANING,
            "lacks": list(boat.lacks),
            "quantities": found.json(),
        },
        "covariance": {
            "note": "of the parameters per unit mass, of which the intervals are made; command_lag: a share of a step",
            "parameters": list(found.names),
            "values": found.theta.tolist(),
            "matrix": found.covariance.tolist(),
        },
        "curves": {
            name: dict(zip(("at_unit", "unit"), UNIT_OF_CURVE.get(name, ("1", "N")), strict=True))
            | {key: values.tolist() for key, values in curve._asdict().items()}
            for name, curve in curves(found).items()
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
        "mass": {"value": model.mass, "unit": "kg", "basis": boat.found.scale},
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
    found: dict[str, Any] = {}
    for side in COMMANDS:
        each = None if boat.setup is None else boat.setup.channels.get(side)
        if each is not None:
            found[side] = each.json() if isinstance(each, Mix) else asdict(each)
    return found
