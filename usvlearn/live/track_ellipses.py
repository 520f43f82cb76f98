"""Ellipses for tracks, from what happened in service.

A track assumes that the present commands continue. As for forecasts (`held_command_intervals`), the node compares the
places that it has published with where the boat was later, of all tracks, and of those during which the commands
stayed. For each horizon it keeps the last 300 errors e, in the boat's frame as the track began. With their mean square
E = Σ eeᵀ/n, the ellipse is eᵀE⁻¹e ≤ d, where d has the rank ⌈(n + 1) p⌉ among those of the errors, and p follows the
misses, (1) of `held_command_intervals`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.live.held_command_intervals import KEPT, LEAST, MISSES, MOST, OVERLAP, RATE
from usvlearn.live.plan_requests import Point

STAYED = 0.1  # of full scale: greatest change of a command that stays
LARGEST = 1e4  # m, of an error
SMALLEST = 0.05  # m, of a semi-axis


class _Under(NamedTuple):
    due: float  # s
    origin: np.ndarray  # m
    heading: float  # rad, as it began
    place: np.ndarray  # m, from the origin
    shape: np.ndarray | None  # that was published
    commands: np.ndarray


class _Horizon:
    """The errors of one horizon."""

    def __init__(self) -> None:
        self.errors: deque[np.ndarray] = deque(maxlen=KEPT)
        self.share, self.shape = 1 - MISSES, None  # type: float, np.ndarray | None

    def learn(self, error: np.ndarray, shape: np.ndarray | None) -> None:
        if shape is not None:
            miss = float(error @ np.linalg.solve(shape, error)) > 1
            self.share = min(max(self.share + RATE * (miss - MISSES), LEAST), MOST)
        self.errors.append(error)
        n = len(self.errors)
        if n >= FEW:
            all_of = np.array(self.errors)
            square = all_of.T @ all_of / n + SMALLEST**2 * np.eye(2)
            distances = np.sort(np.einsum("ki,ij,kj->k", all_of, np.linalg.inv(square), all_of))
            self.shape = square * max(distances[min(math.ceil((n + 1) * self.share), n) - 1], 1e-6)


class TrackEllipses:
    """Learns how far tracks are from where the boat comes; `held`: of those alone during which the commands stayed."""

    def __init__(self, horizons: Sequence[float], dt: float, held: bool = False):
        self._dt, self._held = dt, held
        self._known = {horizon: _Horizon() for horizon in horizons}
        self._waiting: dict[float, deque[_Under]] = {horizon: deque() for horizon in horizons}
        self._last = dict.fromkeys(horizons, -math.inf)  # s, when the last one began that is compared

    def take(self, time: float, place: np.ndarray, commands: np.ndarray) -> None:
        """Learn from where the boat is at the end of a step: s, m `(2,)`, and the commands during it `(2,)`."""
        for horizon, waiting in self._waiting.items():
            if self._held:
                stay = [each for each in waiting if np.abs(commands - each.commands).max() <= STAYED]
                waiting.clear()
                waiting.extend(stay)
            while waiting and waiting[0].due < time + self._dt / 2:
                under = waiting.popleft()
                error = place - under.origin - under.place
                if time - under.due <= self._dt / 2 and np.abs(error).max() < LARGEST:
                    self._known[horizon].learn(turned(error, -under.heading), under.shape)

    def expect(
        self, time: float, place: np.ndarray, heading: float, points: Mapping[float, Point], commands: np.ndarray
    ) -> None:
        """Take the places of a track that begins at a time, s, and place, m `(2,)`, with a heading, rad."""
        for horizon, point in points.items():
            ahead = np.array([point.north, point.east])
            if time - self._last[horizon] >= horizon / OVERLAP - self._dt / 2 and np.isfinite((*place, *ahead)).all():
                self._last[horizon] = time
                shape = self._known[horizon].shape
                self._waiting[horizon].append(_Under(time + horizon, place, heading, ahead, shape, commands))

    def put(self, points: Mapping[float, Point], heading: float) -> dict[float, Point]:
        """The places with the ellipses of a heading, rad; without one while too few errors are known."""
        found = {}
        for horizon, point in points.items():
            shape = self._known[horizon].shape
            if shape is None:
                found[horizon] = point._replace(major=math.inf, minor=math.inf, bearing=math.nan)
                continue
            squares, axes = np.linalg.eigh(shape)
            bearing = math.degrees(heading + math.atan2(axes[1, 1], axes[0, 1])) % 180
            found[horizon] = point._replace(major=math.sqrt(squares[1]), minor=math.sqrt(squares[0]), bearing=bearing)
        return found

    def clear(self) -> None:
        """The time begins anew: forget the tracks that are under way."""
        for horizon, waiting in self._waiting.items():
            waiting.clear()
            self._last[horizon] = -math.inf


def turned(vector: np.ndarray, angle: float) -> np.ndarray:
    """A vector north, east, turned clockwise by an angle, rad."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])
