"""How a verdict and a time constant are written in each table of a terminal."""

from __future__ import annotations

from rich.text import Text

from certify.proofs.rounding import above

MARKS = {
    "certified": ("✓", "green"),
    "refuted": ("✗", "red"),
    "not certified": ("✗", "red"),
    "unknown": ("?", "yellow"),
}


def time_constant(steps: float | None, dt: float | None) -> str:
    """τ = −1/ln K in steps, or in s, rounded up."""
    return "–" if steps is None else above(steps * (dt or 1), 3)


def mark(verdict: str) -> Text:
    """The mark of a verdict, in its colour."""
    return Text(*MARKS[verdict])
