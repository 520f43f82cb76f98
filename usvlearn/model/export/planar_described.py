"""The planar model of a boat as JSON values: the content of `BOAT_planar.json`."""

from __future__ import annotations

from typing import Any

import usvlearn
from usvlearn.model.export.described import commands_of, equation, set_of, surge_of
from usvlearn.model.export.planar_boat import AXES, PlanarBoat
from usvlearn.model.planar import UNITS

FORMAT = "usvlearn planar boat 1"
SIDES = "sum over SIDE = left and right of (linear_SIDE x + quadratic_SIDE x|x|"
EQUATIONS = {
    "yaw": (
        "dr/dt = bias + linear r + quadratic r|r| + cross |u| r + coupling u v + other v + surge u + "
        f"{SIDES} + speed_SIDE x|u| + cubic_SIDE x^3 + even_linear_SIDE |x| + even_quadratic_SIDE x^2)"
    ),
    "sway": f"dv/dt = bias + linear v + quadratic v|v| + cross |u| v + coupling u r + other r + surge u + {SIDES})",
}
STEP = (
    "with f = dy/dt, J = df/dy, z = min(dt J, 1) of y = r, v or u: y after dt is y + dt f (exp(z) - 1)/z. In this "
    "order: r, from the u and v before; psi, by dt times the mean of r before and after; v, from the u and r before; "
    "u, from the mean of r before and after; north and east, by dt times the current, and dt times the mean of the "
    "velocity before and after, each turned by its psi: u cos(psi) - v sin(psi) north, u sin(psi) + v cos(psi) east"
)
SIGNS = (
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
        "format": FORMAT,
        "usvlearn": usvlearn.__version__,
        "boat": boat.name,
        "set": {"surge": set_of(boat.path, boat.facts), "planar": set_of(planar.path, planar.facts)},
        "step": STEP,
        "signs": SIGNS,
        "surge": surge,
        **{axis: each if getattr(model, axis) is not None else None for axis, each in axes.items()},
        "lacks": list(planar.lacks),
        "commands": commands_of(boat),
    }


def _axis(planar: PlanarBoat, axis: str) -> dict[str, Any]:
    coefficients, learned = getattr(planar.model, axis) or {}, planar.learned[axis]
    return {
        "equation": EQUATIONS[axis],
        "model": {name: {"value": value, "unit": UNITS[axis][name]} for name, value in coefficients.items()},
        "learned": {
            "updates": int(learned.updates),
            "noise": {"value": learned.deviation, "unit": "rad/s" if axis == "yaw" else "m/s"},
            "command_lag": {
                "value": float(learned.mean[-1]), "unit": "1",
                "note": "share of a step by which commands acted late; the step here has none",
            },
        },
    }  # fmt: skip
