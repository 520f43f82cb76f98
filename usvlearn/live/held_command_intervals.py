"""Intervals for forecasts that assume the present commands continue.

The intervals of `Online.forecast` are learned from forecasts that were told the commands that came. A node does not
know what will be commanded. Its forecasts hold the commands in force, and are wrong as soon as the autopilot changes
them. So the node compares these forecasts themselves with what was measured later, at all moments. For each horizon it
keeps the last 300 errors |y − ŷ|. The half-width of a forecast is the error of rank ⌈(n + 1) p⌉ of the n that are kept,
and p follows the misses of the forecasts that were published with a width (adaptive conformal inference, Gibbs and
Candès 2021, equation 2):

    p ← p + .005 (miss − 0.1),    miss = 1 where |y − ŷ| is greater than the width that was published, else 0     (1)

The interval is infinite while fewer than ten errors are known. One forecast over h is compared every h/5 s.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.forecasts.state import NARROWEST

OVERLAP = 5  # forecasts over a horizon that are under way at the same time
KEPT, MISSES, RATE = 300, 0.1, 0.005  # errors of a horizon; of (1)
LEAST, MOST = 0.5, 0.995  # p
LARGEST = 1e3  # m/s, of an error


class HeldIntervals:
    """Learns how far forecasts under held commands are from the speeds that come."""

    def __init__(self, horizons: Sequence[float], dt: float):  # s; s of a step
        self._dt = dt
        self._waiting: dict[float, deque[tuple[float, float, float]]] = {h: deque() for h in horizons}
        self._last = dict.fromkeys(horizons, -math.inf)  # s, when the last one began that is compared
        self._errors: dict[float, deque[float]] = {h: deque(maxlen=KEPT) for h in horizons}  # m/s
        self._share = dict.fromkeys(horizons, 1 - MISSES)  # p
        self._widths = dict.fromkeys(horizons, math.inf)  # m/s

    def expect(self, time: float, forecasts: Mapping[float, float]) -> None:
        """Take the forecasts that were made at a time, s: horizon -> m/s."""
        for horizon, surge in forecasts.items():
            if time - self._last[horizon] >= horizon / OVERLAP - self._dt / 2 and math.isfinite(surge):
                self._last[horizon] = time
                self._waiting[horizon].append((time + horizon, surge, self._widths[horizon]))

    def compare(self, time: float, measured: float) -> None:
        """Learn from what is due at a time, s, at which a speed was measured, m/s; NaN where none was."""
        for horizon, waiting in self._waiting.items():
            while waiting and waiting[0][0] < time + self._dt / 2:
                due, surge, width = waiting.popleft()
                error = abs(measured - surge)
                if time - due <= self._dt / 2 and error < LARGEST:
                    self._learn(horizon, error, width)

    def _learn(self, horizon: float, error: float, width: float) -> None:
        if math.isfinite(width):
            moved = self._share[horizon] + RATE * ((error > width) - MISSES)  # (1)
            self._share[horizon] = min(max(moved, LEAST), MOST)
        self._errors[horizon].append(error)
        self._settle(horizon)

    def _settle(self, horizon: float) -> None:
        errors = sorted(self._errors[horizon])
        if len(errors) >= FEW:
            rank = min(math.ceil((len(errors) + 1) * self._share[horizon]), len(errors))
            self._widths[horizon] = max(errors[rank - 1], NARROWEST)

    def halfwidth(self, horizon: float) -> float:
        """Of the 90 % interval, m/s; infinite while too few errors are known."""
        return self._widths[horizon]

    def clear(self) -> None:
        """The time begins anew: forget the forecasts that are under way."""
        for horizon, waiting in self._waiting.items():
            waiting.clear()
            self._last[horizon] = -math.inf

    def json(self) -> dict[str, list[float]]:
        """What was learned, as JSON values: horizon -> p, and the errors, mm/s precisely."""
        return {
            f"{horizon:g}": [self._share[horizon], *(round(each, 3) for each in errors)]
            for horizon, errors in self._errors.items()
        }

    def load(self, given: Any) -> None:
        """Continue from what `json` returned; a horizon whose numbers are not legal begins anew."""
        for horizon in self._errors:
            row = given.get(f"{horizon:g}") if isinstance(given, Mapping) else None
            if not isinstance(row, list) or not 1 <= len(row) <= KEPT + 1:
                continue
            numbers = all(isinstance(x, int | float) and not isinstance(x, bool) and 0 <= x < LARGEST for x in row)
            if numbers and LEAST <= row[0] <= MOST:
                self._share[horizon] = float(row[0])
                self._errors[horizon].extend(map(float, row[1:]))
                self._settle(horizon)
