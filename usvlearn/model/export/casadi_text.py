"""The dynamics of a boat as Python files that need only CasADi, for model predictive control."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap

from usvlearn.estimators.regressors.terms import NEAR, UNITS
from usvlearn.model.export.c_header import ascii_only, identifier
from usvlearn.model.export.described import EQUATIONS, PLANAR_SIGNS, PLANAR_STEP, RENAMED, SIGNS, STEP, equation
from usvlearn.model.export.planar_boat import PlanarBoat
from usvlearn.model.planar import UNITS as AXIS_UNITS
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.model.surge import TABLE_COMMANDS, Tables

SERIES = 12  # terms of φ₁ near 0: the rest is below 10⁻¹⁹
EVEN = """
    f += p["drag_even"] * v**2 + sum(
        p[f"thrust_even_linear_{s}"] * ca.fabs(x) + p[f"thrust_even_quadratic_{s}"] * x**2
        + p[f"thrust_even_speed_{s}"] * x * v for s, x in sides)
    J += 2 * p["drag_even"] * v + sum(p[f"thrust_even_speed_{s}"] * x for s, x in sides)"""

PHI = f"""\
    near = ca.fabs(z) < {NEAR}
    series = 0
    for k in range({SERIES}, 1, -1):  # 1 + z/2 (1 + z/3 (1 + ...))
        series = (1 + z * series) / k
    far = ca.if_else(near, 1, z)  # the branch that is not taken stays finite, its derivative too
    phi = ca.if_else(near, 1 + z * series, ca.expm1(far) / far)"""
TABLES = """
    for s, x in sides:
        f += table(THRUST[s], -1, COMMANDS_APART, x)[0]
    height, slope = table(DRAG, 0, SPEEDS_APART, speed)
    f += ca.if_else(v >= 0, 1, -1) * height
    J += slope"""
TABLE_FUNCTION = '''

def table(values, first, apart, at):
    """The height and the slope of a table of equally spaced values; straight lines, also beyond both ends."""
    k = ca.fmin(ca.fmax(ca.floor((at - first) / apart), 0), len(values) - 2)
    height = slope = 0
    for i, (low, high) in enumerate(zip(values, values[1:])):
        here = k == i
        slope += ca.if_else(here, (high - low) / apart, 0)
        height += ca.if_else(here, low + (high - low) / apart * (at - first - i * apart), 0)
    return height, slope

'''


def casadi_text(boat: IdentifiedBoat) -> str:
    """The text of a module whose `surge_step()` returns a `casadi.Function` that equals `SurgeModel.step`."""
    head = [
        f"The surge dynamics of the boat {identifier(boat.name)}, identified by usvlearn.", "",
        *wrap(equation(boat.model), 100), "", *wrap(STEP, 100), "", *wrap(SIGNS, 100), "", *mass_of(boat),
    ]  # fmt: skip
    return module_text(head, surge_text(boat))


def module_text(head: Sequence[str], body: str) -> str:
    """A module of ASCII with the lines of its docstring."""
    return "\n".join(map(ascii_only, ['"""' + head[0], *head[1:], '"""', *body.rstrip().splitlines()])) + "\n"


def mass_of(boat: IdentifiedBoat) -> list[str]:
    """The mass, for a docstring."""
    return wrap(f"m = {boat.model.mass:.6g} kg, added mass included. {boat.identified.scale}", 100)


def surge_text(boat: IdentifiedBoat) -> str:
    """The import of CasADi, the coefficients, and `surge_step`."""
    even, tables = boat.model.even, boat.model.tables
    coefficients = zip(boat.model.coefficients, boat.model.per_mass, strict=False)
    return f'''
import casadi as ca

PER_MASS = {{  # coefficients over the mass
{chr(10).join(f"    {name!r}: {float(value)!r},  # {UNITS[name]} over kg" for name, value in coefficients)}
}}
{"" if tables is None else _tables(tables, boat.model.mass)}

def surge_step(name="surge_step"):
    """The function (v, left, right, yaw_rate, dt) -> speed after dt, m/s; all are scalars in SI units."""
    v, left, right, yaw_rate, dt = (ca.SX.sym(each) for each in ("v", "left", "right", "yaw_rate", "dt"))
    p, sides = PER_MASS, (("left", left), ("right", right))
    speed, turn = ca.if_else(v >= 0, v, -v), ca.fabs(yaw_rate)  # at v = 0 the derivative is that of motion ahead
    f = p["drag_quadratic"] * speed * v + p["drag_linear"] * v + p["drag_cross"] * turn * v + sum(
        x * (p[f"thrust_linear_{{s}}"] + p[f"thrust_quadratic_{{s}}"] * ca.fabs(x) + p[f"thrust_speed_{{s}}"] * speed
             + p[f"thrust_cubic_{{s}}"] * x**2) for s, x in sides)
    J = 2 * p["drag_quadratic"] * speed + p["drag_linear"] + p["drag_cross"] * turn + ca.if_else(v >= 0, 1, -1) * sum(
        p[f"thrust_speed_{{s}}"] * x for s, x in sides){EVEN if even else ""}{TABLES if tables else ""}
    z = ca.fmin(dt * J, 1)
{PHI}
    return ca.Function(
        name, [v, left, right, yaw_rate, dt], [v + dt * phi * f],
        ["v", "left", "right", "yaw_rate", "dt"], ["v_next"])
'''


def _tables(tables: Tables, mass: float) -> str:
    """The tables per unit mass, and the function that reads them."""
    thrust = {side: (each / mass).tolist() for side, each in tables.thrust.items()}
    numbers = [
        f"THRUST = {thrust!r}  # at commands of -1, -0.875 ... 1; N over kg",
        f"DRAG = {[0.0, *(tables.drag / mass).tolist()]!r}  # at speeds of 0, SPEEDS_APART ...; N over kg",
        f"COMMANDS_APART, SPEEDS_APART = {float(TABLE_COMMANDS[1] - TABLE_COMMANDS[0])!r}, {float(tables.speeds[0])!r}",
    ]
    return "\n".join(numbers) + TABLE_FUNCTION


def planar_casadi_text(planar: PlanarBoat) -> str:
    """The text of a module whose `planar_step()` returns a `casadi.Function` that equals `PlanarModel.step`."""
    boat, sways = planar.boat, planar.model.sway is not None
    sway = _numbers("sway", "mass", planar.model.sway) + "\n" if planar.model.sway is not None else ""
    equations = [*(EQUATIONS[axis] for axis in (("yaw", "sway") if sways else ("yaw",))), equation(boat.model)]
    head = [
        f"The motion of the boat {identifier(boat.name)} in the plane, identified by usvlearn.", "",
        *(line for each in [*equations, RENAMED] for line in wrap(each, 100)), "",
        *wrap(PLANAR_STEP, 100), "", *wrap(PLANAR_SIGNS, 100), "", *mass_of(boat),
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
    rows = [f"    {name!r}: {value!r},  # {AXIS_UNITS[axis][name]}" for name, value in coefficients.items()]
    return "\n".join([f"{axis.upper()} = {{  # per unit {unit}", *rows, "}"])
