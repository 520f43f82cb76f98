"""Orientations of a table: four columns of a quaternion are one more column, the yaw."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

NORM = 0.1  # by which the length of a quaternion may differ from 1
LETTERED = re.compile(r"(.*?)([._/ ]?)(x|y|z|w|X|Y|Z|W)")
NUMBERED = re.compile(r"(.*\bq|.*_q|q)(?:\[([0-3])\]|[._]0?([0-3])|([0-3]))", re.IGNORECASE)
ENU, NED = "enu_rad", "rad"  # by REP 103 of ROS, and of PX4


class Quaternion(NamedTuple):
    """The columns x, y, z and w of a quaternion, and the unit of its yaw by convention."""

    columns: tuple[str, str, str, str]
    unit: str


class Yaw(NamedTuple):
    """A column that was computed from a quaternion."""

    values: np.ndarray  # (rows,) float64 rad, NaN where the four numbers are no rotation
    empty: np.ndarray  # (rows,) bool, where all four cells are empty
    bad: int  # rows whose four numbers are no rotation
    first: str = ""


def quaternions(names: Sequence[str]) -> dict[str, Quaternion]:
    """Name of an orientation -> its columns. `q[0]` … `q[3]`, as PX4 writes them, begin with w."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        if found := NUMBERED.fullmatch(name):
            number = next(each for each in found.groups()[1:] if each)
            groups.setdefault((found[1], NED), {})["wxyz"[int(number)]] = name
        elif (found := LETTERED.fullmatch(name)) and found[1]:
            groups.setdefault((found[1], ENU), {})[found[3].lower()] = name
    return {
        stem: Quaternion((axes["x"], axes["y"], axes["z"], axes["w"]), unit)
        for (stem, unit), axes in groups.items()
        if len(axes) == 4 and stem not in names
    }


def yaw_of(parts: Sequence[np.ndarray], empty: Sequence[np.ndarray]) -> Yaw:
    """Yaw of quaternions, x, y, z and w, `(rows,)` each, counter-clockwise about z.

    psi = atan2(2 (w z + x y), w^2 + x^2 - y^2 - z^2)
    """
    x, y, z, w = parts
    missing = np.logical_and.reduce(empty)
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.sqrt(x * x + y * y + z * z + w * w)
        values = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
        rotation = np.abs(size - 1) <= NORM
    return Yaw(np.where(rotation, values, np.nan), missing, int((~rotation & ~missing).sum()))
