"""The surge of a log that has no forward speed, from the first pair of channels that it has: see `PAIRS`.

The heading is the last one that was logged before. From positions, velocities come by a Kalman filter, which uses past
ones only. Such a speed lags behind by some tenths of a second, and is over ground, as a GPS's is. The equations are
those of `docs/theory/model.md#derived-speed`.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import COURSES, DEGREES, METRES, VELOCITIES, Channel
from usvlearn.logs.channels.positions import local

PAIRS = (VELOCITIES, COURSES, DEGREES, METRES)
LIVE_PAIRS = (VELOCITIES, COURSES)  # from which `LiveSurge` computes it
PAIRS_TOLD = "both of " + ", or of ".join(" and ".join(pair) for pair in PAIRS)
HEADING_AGE = 1.0  # s, of the last heading, at most
TOGETHER = 0.02  # s, between the stamps of the two numbers of a pair, at most


def pair_of(channels: Container[str]) -> tuple[str, str] | None:
    """The pair from which the surge is computed; None if there is none."""
    return next((pair for pair in PAIRS if all(name in channels for name in pair)), None)


def derived_surge(where: str, channels: Mapping[str, Channel]) -> tuple[Channel, dict[str, int]]:
    """The surge from the first pair that is logged, and the counts of what could not be used, by cause.

    It has the window and the period of the pair's first channel. A LogFormatError if the numbers of the pair are never
    logged together, or there is no heading beside them; `where` is the log.
    """
    pair = pair_of(channels)
    assert pair is not None
    one, other = (channels[name] for name in pair)
    time, order, x, y = _together(one, other)
    dropped = {"alone": len(one.time) + len(other.time) - 2 * len(time)}
    heading, known = _heading_at(order, time, channels["heading"])
    dropped["no_heading"] = int((~known).sum())
    if pair == COURSES:
        surge, given = x * np.cos(y - heading), known
    else:
        if pair != VELOCITIES:
            x, y = filtered(time, *(local(x, y) if pair == DEGREES else (x, y)))
        surge = x * np.cos(heading) + y * np.sin(heading)
        given = known & np.isfinite(surge)
    dropped["unsure"] = int((known & ~given).sum())
    if not given.any():
        causes = ", ".join(f"{count} {cause}" for cause, count in dropped.items() if count)
        raise LogFormatError(
            f"{where}: found no speed in {pair[0]} and {pair[1]} ({causes or 'no message'}): expected both in one row "
            "or message, and a heading beside them: correct data.channels"
        )
    surge_channel = one._replace(time=time[given], value=surge[given], order=order[given])
    return surge_channel, {cause: count for cause, count in dropped.items() if count}


def _together(one: Channel, other: Channel) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, places and both values of two channels, where they stand at one place, or were posted together."""
    common, mine, others = np.intersect1d(one.order, other.order, return_indices=True)
    if len(common) < 0.5 * min(len(one.order), len(other.order)):  # posted apart, as on a MOOSDB
        mine = np.arange(len(one.order))
        others = np.searchsorted(other.order, one.order)
        others = np.clip(others, 0, len(other.order) - 1)
        before = np.maximum(others - 1, 0)
        nearer = np.abs(other.time[before] - one.time) <= np.abs(other.time[others] - one.time)
        others = np.where(nearer, before, others)
        close = np.abs(other.time[others] - one.time) <= TOGETHER
        mine, others = mine[close], others[close]
    order = np.maximum(one.order[mine], other.order[others])
    return np.maximum(one.time[mine], other.time[others]), order, one.value[mine], other.value[others]


def _heading_at(order: np.ndarray, time: np.ndarray, heading: Channel) -> tuple[np.ndarray, np.ndarray]:
    """The last heading at each place of the log, and whether it is recent or held."""
    last = np.searchsorted(heading.order, order, side="right") - 1
    age = time - heading.time[np.maximum(last, 0)]
    known = (last >= 0) & (heading.held | ((age <= HEADING_AGE) & (age >= -HEADING_AGE)))
    return heading.value[np.maximum(last, 0)], known


def filtered(time: np.ndarray, north: np.ndarray, east: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Velocities, m/s, from positions, m, in the order of the log; NaN where they are not sure, and at copies."""
    from usvlearn.logs.channels.position_kernel import velocities  # numba takes a moment to import

    velocity = velocities(*(np.ascontiguousarray(x, dtype=np.float64) for x in (time, north, east)))
    return velocity[0], velocity[1]


class LiveSurge:
    """The surge from messages that come one by one: velocities, or ground speed and course, and the last heading.

    Two values of a pair of `LIVE_PAIRS` belong together if their stamps are at most `TOGETHER` apart. A heading that is
    held stays in force, however old.
    """

    def __init__(self, pair: tuple[str, str], held: bool):
        self.pair, self._held = pair, held
        self._last: dict[str, tuple[float, float]] = {}

    def push(self, channel: str, time: float, value: float) -> float | None:
        """The surge after a message (s, SI units), m/s; None if it completes no pair, or no recent heading is known."""
        self._last[channel] = time, value
        if channel not in self.pair or len(self._last) < 3:
            return None
        (since, x), (other, y), (then, heading) = (self._last[name] for name in (*self.pair, "heading"))
        if abs(since - other) > TOGETHER or not (self._held or abs(time - then) <= HEADING_AGE):
            return None
        if self.pair == COURSES:
            return x * math.cos(y - heading)
        return x * math.cos(heading) + y * math.sin(heading)
