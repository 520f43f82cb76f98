"""The surge dynamics of a boat as a Python file that needs only CasADi, for model predictive control."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap

from usvlearn.estimators.regressors.terms import NEAR, UNITS
from usvlearn.model.export.c_header import ascii_only, identifier
from usvlearn.model.export.described import SIGNS, STEP, equation
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
    """The text of a module whose `surge_step()` returns a `casadi.Function` that equals `SurgeModel.step`.

    φ₁ is a series near 0, where its quotient and the derivative of it cancel.
    """
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
    return wrap(f"m = {boat.model.mass:.6g} kg, added mass included. {boat.found.scale}", 100)


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
