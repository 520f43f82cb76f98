"""A track as it is published: places at its horizons, in the units of those who steer, m and degrees from north."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.forecasts import Track

DECIMALS = (2, 2, 1, 2, 2, 1)


class Point(NamedTuple):
    """Where the boat will be, from where it is now."""

    north: float  # m
    east: float  # m
    heading: float  # deg, 0 north, clockwise, 0 … 360
    major: float  # m, semi-axes of the ellipse that holds the position in 90 % of the cases; infinite: not known yet
    minor: float  # m
    bearing: float  # deg, of the major one, 0 … 180

    @property
    def text(self) -> str:
        """The numbers, joined by colons; without the ellipse while it is not known.

        >>> Point(10.0, -2.5, 359.98, 2.0, 1.0, 45.0).text, Point(1.0, 2.0, 3.0, math.inf, math.inf, 0.0).text
        ('10.00:-2.50:0.0:2.00:1.00:45.0', '1.00:2.00:3.0')
        """
        known = 6 if math.isfinite(self.major) else 3
        wrapped = self._replace(heading=round(self.heading, 1) % 360, bearing=round(self.bearing, 1) % 180)
        return ":".join(f"{x:.{decimals}f}" for x, decimals in zip(wrapped[:known], DECIMALS, strict=False))


def points(track: Track, steps: Sequence[int] | None = None) -> list[Point]:
    """The places after some steps of one boat's track, numbered from 1; None: after all of them."""
    at = np.arange(len(track.time)) if steps is None else np.asarray(steps, int) - 1
    major, minor, bearing = track.ellipse()
    heading, bearing = np.degrees(track.heading) % 360, np.degrees(bearing) % 180
    columns = (track.north, track.east, heading, major, minor, bearing)
    return [Point(*map(float, row)) for row in np.stack([np.asarray(x)[at] for x in columns], -1)]
