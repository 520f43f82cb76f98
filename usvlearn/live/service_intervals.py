"""Intervals of speeds and ellipses of places that assume that the present commands continue, from what happened.

The intervals of `Online.forecast` are learned from forecasts that were told the commands that came. A node does not
know what will be commanded. Its forecasts and tracks hold the commands in force, and are wrong as soon as the autopilot
changes them. So the node compares what it has published with what came later, at all moments, or where the commands
stayed. For each horizon it keeps the last 300 errors e, of places in the boat's frame as the track began. With their
mean square E = Σ eeᵀ/n (1 of speeds), the ellipse is eᵀE⁻¹e ≤ d, where d has the rank ⌈(n + 1) p⌉ among those of the
errors, and p follows the misses of what was published with one (adaptive conformal inference, Gibbs and Candès 2021,
equation 2):

    p ← p + .005 (miss − 0.1),    miss = 1 where e lies outside of what was published, else 0                     (1)

There is none while fewer than ten errors are known. One forecast over h is compared every h/5 s.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.forecasts.state import NARROWEST
from usvlearn.live.plan_requests import Point

OVERLAP = 5  # forecasts over a horizon that are under way at the same time
KEPT, MISSES, RATE = 300, 0.1, 0.005  # errors of a horizon; of (1)
LEAST, MOST = 0.5, 0.995  # p
LARGEST = (1e3, 1e4)  # of an error: m/s, m
SMALLEST = 0.05  # m, of a semi-axis
STAYED = 0.1  # of full scale: greatest change of a command that stays
NONE = np.zeros(2)


class _Under(NamedTuple):
    """A forecast that is under way."""

    due: float  # s
    expected: np.ndarray  # m/s, or m, `(size,)`
    heading: float  # rad, as it began
    inverse: np.ndarray | None  # of the shape that was published
    commands: np.ndarray


class _Horizon:
    """The errors of one horizon."""

    def __init__(self, size: int):
        self.errors, self.count = np.empty((KEPT, size)), 0  # the oldest gives way
        self.share = 1 - MISSES  # p
        self.shape: np.ndarray | None = None  # the ellipse is eᵀ shape⁻¹ e ≤ 1
        self.inverse: np.ndarray | None = None
        self.waiting: deque[_Under] = deque()
        self.last = -math.inf  # s, when the last one began that is compared

    def learn(self, error: np.ndarray, inverse: np.ndarray | None) -> None:
        if inverse is not None:
            self.share += RATE * (float(error @ inverse @ error > 1) - MISSES)  # (1)
            self.share = min(max(self.share, LEAST), MOST)
        self.errors[self.count % KEPT] = error
        self.count += 1
        self.settle()

    @property
    def known(self) -> np.ndarray:
        """The errors, `(n, size)`."""
        return self.errors[: min(self.count, KEPT)]

    def settle(self) -> None:
        if (n := len(known := self.known)) < FEW:
            return
        size = known.shape[1]
        square = known.T @ known / n + SMALLEST**2 * np.eye(size) if size > 1 else np.eye(1)
        distances = np.sort(((known @ np.linalg.inv(square)) * known).sum(1))
        least = NARROWEST**2 if size == 1 else 1e-6
        shape: np.ndarray = square * max(distances[min(math.ceil((n + 1) * self.share), n) - 1], least)
        self.shape, self.inverse = shape, np.linalg.inv(shape)


class ServiceIntervals:
    """Learns how far speeds (of size 1), or places (of size 2), are from what comes; `held`: while commands stay."""

    def __init__(self, horizons: Sequence[float], dt: float, size: int = 1, held: bool = False):  # s; s of a step
        self._dt, self._size, self._held = dt, size, held
        self._all = {horizon: _Horizon(size) for horizon in horizons}

    def take(self, time: float, found: np.ndarray, commands: np.ndarray = NONE) -> None:
        """Learn from what came by a time, s: m/s or m, NaN if nothing; and from the commands then."""
        for own in self._all.values():
            if self._held and any(np.abs(commands - each.commands).max() > STAYED for each in own.waiting):
                own.waiting = deque(x for x in own.waiting if np.abs(commands - x.commands).max() <= STAYED)
            while own.waiting and own.waiting[0].due < time + self._dt / 2:
                under = own.waiting.popleft()
                error = found - under.expected
                if time - under.due <= self._dt / 2 and np.abs(error).max() < LARGEST[self._size - 1]:
                    own.learn(turned(error, -under.heading) if self._size > 1 else error, under.inverse)

    def expect(
        self, time: float, found: Mapping[float, Any], heading: float = 0.0, commands: np.ndarray = NONE
    ) -> None:
        """Take what was forecast at a time, s: horizon -> m/s or m; of places with the heading then, rad."""
        for horizon, each in found.items():
            own, expected = self._all[horizon], np.atleast_1d(each)
            if time - own.last >= horizon / OVERLAP - self._dt / 2 and np.isfinite(expected).all():
                own.last = time
                own.waiting.append(_Under(time + horizon, expected, heading, own.inverse, commands))

    def halfwidth(self, horizon: float) -> float:
        """Of the 90 % interval of a speed, m/s; infinite while too few errors are known."""
        shape = self._all[horizon].shape
        return math.inf if shape is None else math.sqrt(shape[0, 0])

    def put(self, points: Mapping[float, Point], heading: float) -> dict[float, Point]:
        """The places with the ellipses of a heading, rad; without one while too few errors are known."""
        found = {}
        for horizon, point in points.items():
            shape = self._all[horizon].shape
            if shape is None:
                found[horizon] = point._replace(major=math.inf, minor=math.inf, bearing=math.nan)
                continue
            squares, axes = np.linalg.eigh(shape)
            bearing = math.degrees(heading + math.atan2(axes[1, 1], axes[0, 1])) % 180
            found[horizon] = point._replace(major=math.sqrt(squares[1]), minor=math.sqrt(squares[0]), bearing=bearing)
        return found

    def clear(self) -> None:
        """The time begins anew: forget the forecasts that are under way."""
        for own in self._all.values():
            own.waiting.clear()
            own.last = -math.inf

    def json(self) -> dict[str, list[float]]:
        """What was learned, as JSON values: horizon -> p, and the errors, mm precisely."""
        return {f"{h:g}": [own.share, *own.known.round(3).ravel().tolist()] for h, own in self._all.items()}

    def load(self, given: Any) -> None:
        """Continue from what `json` returned; a horizon whose numbers are not legal begins anew."""
        for horizon, own in self._all.items():
            row = given.get(f"{horizon:g}") if isinstance(given, Mapping) else None
            if not isinstance(row, list) or not 1 <= len(row) <= self._size * KEPT + 1 or len(row[1:]) % self._size:
                continue
            limit = LARGEST[self._size - 1]
            legal = all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < limit for x in row)
            if legal and LEAST <= row[0] <= MOST:
                own.share, own.count = float(row[0]), len(row[1:]) // self._size
                own.errors[: own.count] = np.reshape(row[1:], (-1, self._size))
                own.settle()


def turned(vector: np.ndarray, angle: float) -> np.ndarray:
    """A vector north, east, turned clockwise by an angle, rad."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])
