"""The planar model of a boat as a Python file that needs only CasADi, for model predictive control."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import wrap

from usvlearn.model.export.c_header import identifier
from usvlearn.model.export.casadi_text import PHI, mass_of, module_text, surge_text
from usvlearn.model.export.described import equation
from usvlearn.model.export.planar_boat import PlanarBoat
from usvlearn.model.export.planar_described import EQUATIONS, RENAMED, SIGNS, STEP
from usvlearn.model.planar import UNITS


def planar_casadi_text(planar: PlanarBoat) -> str:
    """The text of a module whose `planar_step()` returns a `casadi.Function` that equals `PlanarModel.step`."""
    boat, sways = planar.boat, planar.model.sway is not None
    sway = _numbers("sway", "mass", planar.model.sway) + "\n" if planar.model.sway is not None else ""
    equations = [*(EQUATIONS[axis] for axis in (("yaw", "sway") if sways else ("yaw",))), equation(boat.model)]
    head = [
        f"The motion of the boat {identifier(boat.name)} in the plane, identified by usvlearn.", "",
        *(line for each in [*equations, RENAMED] for line in wrap(each, 100)), "",
        *wrap(STEP, 100), "", *wrap(SIGNS, 100), "", *mass_of(boat),
        *(line for each in planar.lacks for line in wrap(each, 100)),
    ]  # fmt: skip
    body = f'''

{_numbers("yaw", "inertia", planar.model.yaw)}
{sway}

def axis_step(p, y, left, right, other, u, dt):
    """The yaw rate or the sway after dt; at y = 0 and u = 0 derivatives are those to starboard and ahead."""
    size, along = ca.if_else(y >= 0, y, -y), ca.if_else(u >= 0, u, -u)
    f = (p["bias"] + (p["linear"] + p["quadratic"] * size + p["cross"] * along) * y + p["coupling"] * (u * other)
         + p["other"] * other + p["surge"] * u)
    for s, x in (("left", left), ("right", right)):
        f += p[f"linear_{{s}}"] * x + p[f"quadratic_{{s}}"] * (x * ca.fabs(x))
        if p is YAW:
            f += (p[f"speed_{{s}}"] * (x * along) + p[f"cubic_{{s}}"] * x**3 + p[f"even_linear_{{s}}"] * ca.fabs(x)
                  + p[f"even_quadratic_{{s}}"] * x**2)
    z = ca.fmin(dt * (p["linear"] + 2 * p["quadratic"] * size + p["cross"] * along), 1)
{PHI}
    return y + dt * phi * f


def planar_step(name="planar_step"):
    """The function (state, command, current, dt) -> state after dt.

    state: u, v, m/s, r, rad/s, psi, rad, north, east, m. command: left, right, shares of full scale. current: north,
    east, m/s. dt: s.
    """
    state, command, current, dt = (ca.SX.sym(each, size) for each, size in (
        ("state", 6), ("command", 2), ("current", 2), ("dt", 1)))
    u, v, r, psi, north, east = ca.vertsplit(state)
    left, right = ca.vertsplit(command){"" if sways else chr(10) + "    v = 0  # not learned"}
    turned = axis_step(YAW, r, left, right, v, u, dt)
    after = psi + dt * (r + turned) / 2
    aside = {"axis_step(SWAY, v, left, right, r, u, dt)" if sways else "0"}
    along = surge_step()(u, left, right, (r + turned) / 2, dt)
    north += dt * current[0] + dt / 2 * (ca.cos(psi) * u - ca.sin(psi) * v + ca.cos(after) * along
                                         - ca.sin(after) * aside)
    east += dt * current[1] + dt / 2 * (ca.sin(psi) * u + ca.cos(psi) * v + ca.sin(after) * along
                                        + ca.cos(after) * aside)
    return ca.Function(
        name, [state, command, current, dt], [ca.vertcat(along, aside, turned, after, north, east)],
        ["state", "command", "current", "dt"], ["state_next"])
'''
    return module_text(head, surge_text(boat) + body)


def _numbers(axis: str, unit: str, coefficients: Mapping[str, float]) -> str:
    rows = [f"    {name!r}: {value!r},  # {UNITS[axis][name]}" for name, value in coefficients.items()]
    return "\n".join([f"{axis.upper()} = {{  # per unit {unit}", *rows, "}"])
