"""Shows a live session in TensorBoard, where TensorBoard is installed: `usvlearn live … --tensorboard DIR`."""

from __future__ import annotations

import math
from pathlib import Path

from usvlearn.display.tensorboard import TensorBoardWriter
from usvlearn.live.health import Health
from usvlearn.live.node import Step

EVERY = 5.0  # s of session time between two points
MEMORY = 60.0  # s, over which errors are averaged


class Board:
    """Curves over the seconds of the session: speed, errors of each member, networks, identified quantities, data.

    Args:
        folder: of the TensorBoard files.
    """

    def __init__(self, folder: Path):
        self._board = TensorBoardWriter(folder)
        self._begin, self._last = math.nan, -math.inf
        self._errors: dict[str, tuple[float, float]] = {}  # member -> weighted sums of |error| and of 1
        self._time = 0.0

    def step(self, step: Step) -> None:
        """Add one step; a point is written every `EVERY` seconds."""
        if math.isnan(self._begin):
            self._begin = step.time
        elapsed, before = step.time - self._begin, self._time
        if elapsed < before:  # the stamps began anew
            self._begin, elapsed = step.time - before, before
        keep = math.exp(-(elapsed - before) / MEMORY)
        self._time = elapsed
        if math.isfinite(step.measured):
            for name, speed in step.members.items():
                if math.isfinite(speed):
                    total, weight = self._errors.get(name, (0.0, 0.0))
                    self._errors[name] = keep * total + abs(speed - step.measured), keep * weight + 1.0
        for event in step.events:
            self._board.text("event", event.sentence, int(elapsed), "session")
        if elapsed - self._last < EVERY:
            return
        self._last = elapsed
        at = int(elapsed)
        speeds = {"measured": step.measured, "predicted": step.speed, "low": step.low, "high": step.high}
        for name, value in speeds.items():
            self._write({"1 overview/speed (m/s)": value}, at, f"speed/{name}")
        for name, (total, weight) in self._errors.items():
            self._write({"1 overview/MAE (m/s)": total / weight}, at, f"members/{name}")
        for horizon, (value, _, _) in step.forecasts.items():
            self._write({"1 overview/forecast (m/s)": value}, at, f"forecast/{horizon:g} s ahead")

    def health(self, health: Health) -> None:
        """Add what the node says of itself; it is drawn with the points of the steps."""
        if self._last != self._time and self._last >= 0:
            return
        at = int(self._time)
        rejected = sum(count for causes in health.counts.values() for count in causes.values())
        self._write(
            {"5 data/rejected messages": float(rejected), "1 overview/alarms": float(health.alarms)}, at, "session"
        )
        for name, network in health.contraction.items():
            row = {"4 contraction/rate K": network["rate"], "4 contraction/equilibrium (m/s)": network["equilibrium"]}
            self._write(
                {tag: math.nan if value is None else value for tag, value in row.items()}, at, f"members/{name}"
            )
        for name, (value, low, high, unit) in health.identified.items():
            tag = f"2 identified/{name} ({unit})"
            for run, each in (("identified", value), ("identified low", low), ("identified high", high)):
                self._write({tag: each}, at, run)

    def close(self) -> None:
        """Write what is buffered."""
        self._board.close()

    def _write(self, row: dict[str, float], at: int, run: str) -> None:
        known = {tag: value for tag, value in row.items() if math.isfinite(value)}
        if known:
            self._board.scalars(known, at, run)
