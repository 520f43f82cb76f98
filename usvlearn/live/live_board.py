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
    """Curves over the seconds of the session: speed, errors of each member, networks, identified quantities, data."""

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
        for name, speed in step.members.items():
            if math.isfinite(speed - step.measured):
                total, weight = self._errors.get(name, (0.0, 0.0))
                self._errors[name] = keep * total + abs(speed - step.measured), keep * weight + 1.0
        for event in step.events:
            self._board.text("event", event.sentence, int(elapsed), "session")
        if elapsed - self._last < EVERY:
            return
        self._last = elapsed
        for name in ("measured", "speed", "low", "high"):
            run = "predicted" if name == "speed" else name
            self._write("1 overview/speed (m/s)", getattr(step, name), f"speed/{run}")
        for name, (total, weight) in self._errors.items():
            self._write("1 overview/MAE (m/s)", total / weight, f"members/{name}")
        for horizon, (value, _, _) in step.forecasts.items():
            self._write("1 overview/forecast (m/s)", value, f"forecast/{horizon:g} s ahead")

    def health(self, health: Health) -> None:
        """Add what the node says of itself; it is drawn with the points of the steps."""
        if self._last != self._time and self._last >= 0:
            return
        self._write("5 data/rejected messages", health.rejected, "session")
        self._write("1 overview/alarms", health.alarms, "session")
        for name, network in health.contraction.items():
            self._write("4 contraction/rate K", network["rate"], f"members/{name}")
            self._write("4 contraction/equilibrium (m/s)", network["equilibrium"], f"members/{name}")
        for name, (value, low, high, unit) in health.identified.items():
            for run, each in (("identified", value), ("identified low", low), ("identified high", high)):
                self._write(f"2 identified/{name} ({unit})", each, run)

    def close(self) -> None:
        """Write what is buffered."""
        self._board.close()

    def _write(self, tag: str, value: float | None, run: str) -> None:
        if value is not None and math.isfinite(value):
            self._board.scalars({tag: float(value)}, int(self._time), run)
