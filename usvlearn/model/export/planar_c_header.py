"""The planar model of a boat as a C99 header with one function, beside the header of its surge."""

from __future__ import annotations

from textwrap import wrap

from usvlearn.model.export.c_header import harmless, identifier, number
from usvlearn.model.export.planar_boat import PlanarBoat
from usvlearn.model.export.planar_described import EQUATIONS, SIGNS, STEP
from usvlearn.model.planar import UNITS

THRUST = {
    "sway": ("linear_SIDE * SIDE + quadratic_SIDE * (SIDE * fabs(SIDE))",),
    "yaw": (
        "linear_SIDE * SIDE + quadratic_SIDE * (SIDE * fabs(SIDE)) + speed_SIDE * (SIDE * along)",
        "cubic_SIDE * (SIDE * SIDE * SIDE) + even_linear_SIDE * fabs(SIDE)",
        "even_quadratic_SIDE * (SIDE * SIDE)",
    ),
}


def planar_c_header(planar: PlanarBoat) -> str:
    """The text of a header that needs only <math.h> and `BOAT_surge.h`.

    Its function `BOAT_planar_step(state, left, right, current_north, current_east, dt)` returns the state after dt, as
    `PlanarModel.step`.
    """
    name, boat = identifier(planar.boat.name), planar.boat
    guard, sways = f"USVLEARN_{name.upper()}_PLANAR_H", planar.model.sway is not None
    axes = ("yaw", "sway") if sways else ("yaw",)
    comment = [
        f"The motion of the boat {boat.name} in the plane, identified by usvlearn.", "",
        *(line for axis in axes for line in wrap(EQUATIONS[axis], 110)),
        f"du/dt is in {name}_surge.h, where u is named v.", "",
        *wrap(STEP, 110), "",
        *wrap(SIGNS, 110), "",
        *(f"The {'yaw rate' if axis == 'yaw' else 'sway'} was learned from {planar.learned[axis].updates:.0f} "
          "measurements." for axis in axes),
        *(line for each in planar.lacks for line in wrap(each, 110)),
    ]  # fmt: skip
    sway = f"{name}_sway_step(s.v, left, right, s.r, s.u, dt)" if sways else "0.0"
    lines = [
        "/*", *(f" * {line}".rstrip() for line in map(harmless, comment)), " */",
        f"#ifndef {guard}", f"#define {guard}", "", "#include <math.h>", "", f'#include "{name}_surge.h"', "",
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
        "    return n;", "}", "", f"#endif /* {guard} */", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _axis(planar: PlanarBoat, axis: str, name: str) -> list[str]:
    """The step of the yaw rate or of the sway, in the order in which `usvlearn.estimators.axis.kernel.flow` adds."""
    y, o, what = ("r", "v", "yaw rate after dt, rad/s") if axis == "yaw" else ("v", "r", "sway after dt, m/s")
    coefficients = getattr(planar.model, axis).items()
    return [
        f"/* The {what}. */",
        f"static inline double {name}_{axis}_step(double {y}, double left, double right, double {o}, double u, "
        "double dt)", "{",
        *(f"    const double {each} = {number(value)}; /* {UNITS[axis][each]} */" for each, value in coefficients),
        f"    const double size = fabs({y}), along = fabs(u);",
        f"    double f = bias + (linear + quadratic * size + cross * along) * {y} + coupling * (u * {o})",
        f"               + other * {o} + surge * u;",
        *(f"    f += {each};".replace("SIDE", side) for side in ("left", "right") for each in THRUST[axis]),
        f"    return {y} + {name}_added(f, linear + 2.0 * quadratic * size + cross * along, dt);", "}", "",
    ]  # fmt: skip
