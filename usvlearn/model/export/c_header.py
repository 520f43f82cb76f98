"""The dynamics of a boat as C99 headers with one function each: of its surge, and of its motion in the plane."""

from __future__ import annotations

import math
import re
from textwrap import wrap

import numpy as np

from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.model.export.described import EQUATIONS, PLANAR_SIGNS, PLANAR_STEP, SIGNS, STEP, equation
from usvlearn.model.export.planar_boat import PlanarBoat
from usvlearn.model.planar import UNITS as AXIS_UNITS
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.model.surge import TABLE_COMMANDS, SurgeModel, Tables

LONGEST = 60  # characters of an identifier
EVEN_TERMS = {
    "f": [
        "    f += drag_even * v * v;",
        "    f += (thrust_even_linear_left * a_left + thrust_even_quadratic_left * left * left",
        "          + thrust_even_speed_left * left * v);",
        "    f += (thrust_even_linear_right * a_right + thrust_even_quadratic_right * right * right",
        "          + thrust_even_speed_right * right * v);",
    ],
    "J": [
        "    J += 2.0 * drag_even * v;",
        "    J += thrust_even_speed_left * left + thrust_even_speed_right * right;",
    ],
}


def c_header(boat: IdentifiedBoat) -> str:
    """A header that needs only <math.h>: `BOAT_surge_step(v, left, right, yaw_rate, dt)`, as `SurgeModel.step`."""
    name = identifier(boat.name)
    comment = [
        f"The surge dynamics of the boat {boat.name}, identified by usvlearn.", "",
        *wrap(equation(boat.model), 110), "",
        *wrap(STEP, 110), "",
        *wrap(SIGNS, 110), "",
        *wrap(f"m = {boat.model.mass:.6g} kg, added mass included. {boat.identified.scale}", 110),
        *wrap(boat.identified.basis, 110), *(line for each in boat.lacks for line in wrap(each, 110)), "",
        "Identified, with 90 % intervals; the coefficients are those of motion ahead, where terms are summed:",
        "quantity                       value        from          to  unit",
        *(_row(quantity, boat.identified.displayed(quantity)) for quantity in boat.identified),
    ]  # fmt: skip
    body = [
        *_table_function(boat.model, name),
        "/* The speed through the water after dt, m/s.", " *",
        " * v         speed through the water, m/s", " * left      command as a share of full scale, -1 to 1",
        " * right     likewise", " * yaw_rate  rad/s, of either sign", " * dt        s", " */",
        f"static inline double {name}_surge_step(double v, double left, double right, double yaw_rate, double dt)", "{",
        "    /* per unit mass: coefficients over m */", *_constants(boat.model),
        *_body(boat.model, name), "}", "", *_thruster(boat.model, name),
    ]  # fmt: skip
    return _header(name, "SURGE", comment, body)


def _header(name: str, kind: str, comment: list[str], body: list[str]) -> str:
    """The text of a header with a comment at its top."""
    guard = f"USVLEARN_{name.upper()}_{kind}_H"
    lines = [
        "/*", *(f" * {line}".rstrip() for line in map(harmless, comment)), " */",
        f"#ifndef {guard}", f"#define {guard}", "", "#include <math.h>", "", *body, f"#endif /* {guard} */", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _row(name: str, quantity: Quantity) -> str:
    if math.isnan(quantity.value):  # the interval says nothing
        return f"{name:24} {'not known yet':>35}  {quantity.unit}"
    return f"{name:24} {quantity.value:11.5g} {quantity.low:11.5g} {quantity.high:11.5g}  {quantity.unit}"


def identifier(name: str) -> str:
    """A name as an identifier of C and Python."""
    word = re.sub(r"[^A-Za-z0-9_]", "_", name)[:LONGEST]
    return word if re.match(r"[A-Za-z]", word) else f"boat_{word}"


def ascii_only(text: str) -> str:
    """A text that every compiler and editor reads."""
    return text.replace("±", "+/-").encode("ascii", "replace").decode()


def harmless(line: str) -> str:
    r"""A line of printable ASCII in which nothing ends a comment, also not through a trigraph or a spliced line."""
    return re.sub("[*?]", ".", re.sub("[^ -~]", ".", ascii_only(line)).replace("\\", "/"))


def _constants(model: SurgeModel) -> list[str]:
    numbers = zip(model.coefficients, model.per_mass, strict=False)
    lines = [f"    const double {name} = {number(value)}; /* {UNITS[name]} over kg */" for name, value in numbers]
    if model.tables is not None:
        for side, forces in model.tables.thrust.items():
            lines += _array(f"thrust_table_{side}", forces / model.mass, "commands -1, -0.875 ... 1; N over kg")
        speeds = f"speeds 0, {model.tables.speeds[0]:.6g} ... {model.tables.speeds[-1]:.6g} m/s; N over kg"
        lines += _array("drag_table", np.append(0.0, model.tables.drag) / model.mass, speeds)
    return lines


def _array(name: str, values: np.ndarray, what: str) -> list[str]:
    rows = wrap(", ".join(map(number, values)), 100)
    return [
        f"    static const double {name}[{len(values)}] = {{ /* at {what} */",
        *(f"        {x}" for x in rows),
        "    };",
    ]


def _table_function(model: SurgeModel, name: str) -> list[str]:
    """A function that reads a table between its points, where the model has tables."""
    if model.tables is None:
        return []
    return [
        "/* A table of equally spaced values, `at` spacings from its first; straight lines, also beyond both ends. */",
        f"static inline double {name}_table(const double *values, int count, double at, double *slope)", "{",
        "    const int k = at > 0.0 ? (at < count - 2 ? (int)at : count - 2) : 0;",
        "    *slope = values[k + 1] - values[k];",
        "    return values[k] + (at - k) * *slope;", "}", "",
    ]  # fmt: skip


def _thruster(model: SurgeModel, name: str) -> list[str]:
    """The command that acts while a thruster follows, where its time constant is known."""
    if not model.thruster:
        return []
    return [
        "/* The mean command that acts in a step of dt: the thruster follows a command with a time constant, and",
        " * *state, at first 0, is where it is. The function above takes the result; each side has its own state. */",
        f"static inline double {name}_thruster(double *state, double command, double dt)", "{",
        f"    const double tau = {number(model.thruster)}, away = *state - command; /* s */",
        "    const double share = exp(-dt / tau);",
        "    *state = command + away * share;",
        "    return command + away * tau / dt * (1.0 - share);", "}", "",
    ]  # fmt: skip


def number(value: float) -> str:
    """A literal that is read as the same number."""
    return repr(float(value))


def _body(model: SurgeModel, name: str) -> list[str]:
    """The step, in the order in which `usvlearn.estimators.joint.kernel.flow` adds."""
    return [
        "    const double speed = fabs(v), turn = fabs(yaw_rate), sign = v >= 0.0 ? 1.0 : -1.0;",
        "    const double a_left = fabs(left), a_right = fabs(right);",
        "    double f = drag_quadratic * speed * v + drag_linear * v + drag_cross * turn * v;",
        "    double J = 2.0 * drag_quadratic * speed + drag_linear + drag_cross * turn;",
        f"    double z, phi{', slope' if model.tables is not None else ''};", "",
        "    f += left * (thrust_linear_left + thrust_quadratic_left * a_left + thrust_speed_left * speed",
        "                 + thrust_cubic_left * left * left);",
        "    f += right * (thrust_linear_right + thrust_quadratic_right * a_right + thrust_speed_right * speed",
        "                  + thrust_cubic_right * right * right);",
        "    J += (thrust_speed_left * left + thrust_speed_right * right) * sign;",
        *(EVEN_TERMS["f"] + EVEN_TERMS["J"] if model.even else []),
        *(_tables(model.tables, name) if model.tables is not None else []),
        "    z = dt * J;",
        "    z = z > 1.0 ? 1.0 : z;",
        "    phi = z == 0.0 ? 1.0 : expm1(z) / z;",
        "    return v + dt * phi * f;",
    ]  # fmt: skip


def _tables(tables: Tables, name: str) -> list[str]:
    """What the tables add to f and J."""
    middle = len(TABLE_COMMANDS) // 2
    apart = number(tables.speeds[0])
    lines = [
        f"    f += {name}_table(thrust_table_{side}, {len(TABLE_COMMANDS)}, {middle}.0 * {side} + {middle}.0, &slope);"
        for side in SIDES
    ]
    return [
        *lines,
        f"    f += sign * {name}_table(drag_table, {len(tables.drag) + 1}, speed / {apart}, &slope);",
        f"    J += slope / {apart};",
    ]  # fmt: skip


THRUST = {
    "sway": ("linear_SIDE * SIDE + quadratic_SIDE * (SIDE * fabs(SIDE))",),
    "yaw": (
        "linear_SIDE * SIDE + quadratic_SIDE * (SIDE * fabs(SIDE)) + speed_SIDE * (SIDE * along)",
        "cubic_SIDE * (SIDE * SIDE * SIDE) + even_linear_SIDE * fabs(SIDE)",
        "even_quadratic_SIDE * (SIDE * SIDE)",
    ),
}


def planar_c_header(planar: PlanarBoat) -> str:
    """A header beside `BOAT_surge.h`: `BOAT_planar_step(state, left, right, current_north, current_east, dt)`."""
    name, boat = identifier(planar.boat.name), planar.boat
    sways = planar.model.sway is not None
    axes = ("yaw", "sway") if sways else ("yaw",)
    comment = [
        f"The motion of the boat {boat.name} in the plane, identified by usvlearn.", "",
        *(line for axis in axes for line in wrap(EQUATIONS[axis], 110)),
        f"du/dt is in {name}_surge.h, where u is named v.", "",
        *wrap(PLANAR_STEP, 110), "",
        *wrap(PLANAR_SIGNS, 110), "",
        *(f"The {'yaw rate' if axis == 'yaw' else 'sway'} was learned from {planar.learned[axis].updates:.0f} "
          "measurements." for axis in axes),
        *(line for each in planar.lacks for line in wrap(each, 110)),
    ]  # fmt: skip
    sway = f"{name}_sway_step(s.v, left, right, s.r, s.u, dt)" if sways else "0.0"
    body = [
        f'#include "{name}_surge.h"', "",
        "typedef struct {",
        "    double u;     /* speed ahead through the water, m/s */",
        "    double v;     /* speed to starboard through the water, m/s */",
        "    double r;     /* yaw rate, clockwise, rad/s */",
        "    double psi;   /* heading, clockwise from north, rad; not wrapped */",
        "    double north; /* position, m */",
        "    double east;  /* position, m */",
        f"}} {name}_planar_state;", "",
        "/* What dt adds to y, where f = dy/dt and J = df/dy. */",
        f"static inline double {name}_added(double f, double J, double dt)", "{",
        "    const double z = dt * J > 1.0 ? 1.0 : dt * J;",
        "    return dt * (z == 0.0 ? 1.0 : expm1(z) / z) * f;", "}", "",
        *(line for axis in axes for line in _axis(planar, axis, name)),
        "/* The state after dt.", " *",
        " * s              state before", " * left           command as a share of full scale, -1 to 1",
        " * right          likewise", " * current_north  velocity of the water, m/s", " * current_east   likewise",
        " * dt             s", " */",
        f"static inline {name}_planar_state {name}_planar_step(",
        f"    {name}_planar_state s, double left, double right, double current_north, double current_east, double dt)",
        "{",
        f"    {name}_planar_state n;",
        "    double c, d;",
        *([] if sways else ["    s.v = 0.0; /* not learned */"]),
        f"    n.r = {name}_yaw_step(s.r, left, right, s.v, s.u, dt);",
        "    n.psi = s.psi + dt * (s.r + n.r) / 2.0;",
        f"    n.v = {sway};",
        f"    n.u = {name}_surge_step(s.u, left, right, (s.r + n.r) / 2.0, dt);",
        "    c = cos(s.psi) * s.u - sin(s.psi) * s.v + cos(n.psi) * n.u - sin(n.psi) * n.v; /* twice the mean */",
        "    d = sin(s.psi) * s.u + cos(s.psi) * s.v + sin(n.psi) * n.u + cos(n.psi) * n.v;",
        "    n.north = s.north + dt * current_north + dt / 2.0 * c;",
        "    n.east = s.east + dt * current_east + dt / 2.0 * d;",
        "    return n;", "}", "",
    ]  # fmt: skip
    return _header(name, "PLANAR", comment, body)


def _axis(planar: PlanarBoat, axis: str, name: str) -> list[str]:
    """The step of the yaw rate or of the sway, in the order in which `usvlearn.estimators.axis.kernel.flow` adds."""
    y, o, what = ("r", "v", "yaw rate after dt, rad/s") if axis == "yaw" else ("v", "r", "sway after dt, m/s")
    coefficients = getattr(planar.model, axis).items()
    return [
        f"/* The {what}. */",
        f"static inline double {name}_{axis}_step(double {y}, double left, double right, double {o}, double u, "
        "double dt)", "{",
        *(f"    const double {each} = {number(value)}; /* {AXIS_UNITS[axis][each]} */" for each, value in coefficients),
        f"    const double size = fabs({y}), along = fabs(u);",
        f"    double f = bias + (linear + quadratic * size + cross * along) * {y} + coupling * (u * {o})",
        f"               + other * {o} + surge * u;",
        *(f"    f += {each};".replace("SIDE", side) for side in ("left", "right") for each in THRUST[axis]),
        f"    return {y} + {name}_added(f, linear + 2.0 * quadratic * size + cross * along, dt);", "}", "",
    ]  # fmt: skip
