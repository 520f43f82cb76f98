"""The surge dynamics of a boat as a C99 header with one function."""

from __future__ import annotations

import math
import re
from textwrap import wrap

import numpy as np

from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.model.export.described import SIGNS, STEP, equation
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
    """The text of a header that needs only <math.h>.

    Its function `BOAT_surge_step(v, left, right, yaw_rate, dt)` returns the speed after dt, as `SurgeModel.step`.
    """
    name = identifier(boat.name)
    guard = f"USVLEARN_{name.upper()}_SURGE_H"
    comment = [
        f"The surge dynamics of the boat {boat.name}, identified by usvlearn.", "",
        *wrap(equation(boat.model), 110), "",
        *wrap(STEP, 110), "",
        *wrap(SIGNS, 110), "",
        *wrap(f"m = {boat.model.mass:.6g} kg, added mass included. {boat.found.scale}", 110),
        *wrap(boat.found.basis, 110), *(line for each in boat.lacks for line in wrap(each, 110)), "",
        "Identified, with 90 % intervals; the coefficients are those of motion ahead, where terms are summed:",
        "quantity                       value        from          to  unit",
        *(_row(quantity, boat.found.displayed(quantity)) for quantity in boat.found),
    ]  # fmt: skip
    lines = [
        "/*", *(f" * {line}".rstrip() for line in map(harmless, comment)), " */",
        f"#ifndef {guard}", f"#define {guard}", "", "#include <math.h>", "",
        *_table_function(boat.model, name),
        "/* The speed through the water after dt, m/s.", " *",
        " * v         speed through the water, m/s", " * left      command as a share of full scale, -1 to 1",
        " * right     likewise", " * yaw_rate  rad/s, of either sign", " * dt        s", " */",
        f"static inline double {name}_surge_step(double v, double left, double right, double yaw_rate, double dt)", "{",
        "    /* per unit mass: coefficients over m */", *_constants(boat.model),
        *_body(boat.model, name), "}", "", *_thruster(boat.model, name), f"#endif /* {guard} */", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _row(name: str, found: Quantity) -> str:
    if math.isnan(found.value):  # the interval says nothing
        return f"{name:24} {'not known yet':>35}  {found.unit}"
    return f"{name:24} {found.value:11.5g} {found.low:11.5g} {found.high:11.5g}  {found.unit}"


def identifier(name: str) -> str:
    """A name as an identifier of C and Python.

    >>> identifier("blue-boat 2"), identifier("2nd"), identifier("übung")
    ('blue_boat_2', 'boat_2nd', 'boat__bung')
    """
    found = re.sub(r"[^A-Za-z0-9_]", "_", name)[:LONGEST]
    return found if re.match(r"[A-Za-z]", found) else f"boat_{found}"


def ascii_only(text: str) -> str:
    """A text that every compiler and editor reads.

    >>> ascii_only("± 5 %")
    '+/- 5 %'
    """
    return text.replace("±", "+/-").encode("ascii", "replace").decode()


def harmless(line: str) -> str:
    r"""A line of printable ASCII in which nothing ends a comment, also not through a trigraph or a spliced line.

    >>> harmless("a*/ b*\\ c??/")
    'a./ b./ c../'
    """
    return re.sub("[*?]", ".", re.sub("[^ -~]", ".", ascii_only(line)).replace("\\", "/"))


def _constants(model: SurgeModel) -> list[str]:
    numbers = zip(model.coefficients, model.per_mass, strict=False)
    found = [f"    const double {name} = {number(value)}; /* {UNITS[name]} over kg */" for name, value in numbers]
    if model.tables is not None:
        for side, forces in model.tables.thrust.items():
            found += _array(f"thrust_table_{side}", forces / model.mass, "commands -1, -0.875 ... 1; N over kg")
        speeds = f"speeds 0, {model.tables.speeds[0]:.6g} ... {model.tables.speeds[-1]:.6g} m/s; N over kg"
        found += _array("drag_table", np.append(0.0, model.tables.drag) / model.mass, speeds)
    return found


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
