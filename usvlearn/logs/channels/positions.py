"""Positions of a log in metres, for tracks and for the speed of a log that has none."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from usvlearn.logs.channels.channel import DEGREES, METRES, Channel

EQUATOR, FLATTENING = 6378137.0, 1 / 298.257223563  # m; of the ellipsoid WGS 84
GAP = 5.0  # s between two positions, over which none is interpolated


def local(latitude: np.ndarray, longitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Metres north and east of the first position, rad, `(n,)`, on the tangent plane of the ellipsoid there."""
    squared = FLATTENING * (2 - FLATTENING)
    bent = 1 - squared * math.sin(latitude[0]) ** 2
    meridian, normal = EQUATOR * (1 - squared) / bent**1.5, EQUATOR / math.sqrt(bent)
    turned = np.remainder(longitude - longitude[0] + math.pi, 2 * math.pi) - math.pi
    return meridian * (latitude - latitude[0]), normal * math.cos(latitude[0]) * turned


def in_metres(
    latitude: tuple[np.ndarray, np.ndarray], longitude: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The times of the latitudes, s, and metres north and east of the first position, `(n,)`, as of `local`.

    Given are times and values, s and rad; the longitudes are interpolated at the times of the latitudes.
    """
    time, value = latitude
    others, turned = longitude
    return time, *local(value, np.interp(time, others, np.unwrap(turned)))


def track(channels: Mapping[str, Channel], time: np.ndarray) -> np.ndarray | None:
    """Positions at some times, m north and east of the first one, `(n, 2)`; None if a recording has none.

    They are interpolated; NaN before the first, after the last one and in gaps of more than `GAP`.
    """
    pair = next((pair for pair in (DEGREES, METRES) if all(name in channels for name in pair)), None)
    if pair is None:
        return None
    positions = np.full((len(time), 2), np.nan)
    parts = []
    for name in pair:
        stamps, first = np.unique(channels[name].time, return_index=True)
        parts.append((stamps, channels[name].value[first]))
    if any(len(stamps) == 0 for stamps, _ in parts):
        return positions
    if pair == DEGREES:
        stamps, *metres = in_metres(*parts)
        parts = [(stamps, each) for each in metres]
    for column, (stamps, value) in enumerate(parts):
        after = np.searchsorted(stamps, time)
        inside = (after > 0) & (after < len(stamps))
        k = np.clip(after, 1, max(1, len(stamps) - 1))
        near = inside & (stamps[k % len(stamps)] - stamps[k - 1] <= GAP)
        positions[near, column] = np.interp(time[near], stamps, value - value[0])
    positions[np.isnan(positions).any(1)] = np.nan
    return positions
