"""The table that `python -m certify` prints of networks with a vector state."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from rich.text import Text

from certify.display.marks import time_constant
from certify.proofs.rounding import above, below
from certify.proofs.vector_certificate import CONDITIONS

NORMS = {"inf": "∞", "one": "1"}


def table(
    rows: Sequence[dict[str, Any]], paths: Sequence[str], dt: float | None
) -> tuple[list[str], list[list[str | Text]]]:
    """The headings and the lines.

    Args:
        rows: of `certify.analysis.vector_assess.assess`.
        paths: of the networks, shortened.
        dt: s, of a step, to give time constants in s.
    """

    shown = [name for name in CONDITIONS if any(name in row["rates"] for row in rows)]
    stepped = any("steps" in row for row in rows)
    unit = "steps" if dt is None else "s"
    headings = ["checkpoint", "q", "n", "φ", *(f"rate {name}" for name in shown), "norm", f"τ, {unit}"]
    headings += [f"all steps to, {unit}"] * stepped
    lines = []
    for row, path in zip(rows, paths, strict=True):
        line: list[str | Text] = [path, str(row["states"]), str(row["n"]), row["activation"]]
        line += [_rate(row, name) for name in shown]
        line += [norm(row), time_constant(row["time_constant"], dt)]
        if stepped:
            found = row.get("steps")
            line.append("–" if found is None else below(Fraction(found["proved"]) * Fraction(dt or 1), 4))
        lines.append(line)
    return headings, lines


def _rate(row: dict[str, Any], name: str) -> Text:
    rate = row["rates"].get(name)
    if rate is None:
        return Text("–", "red")
    return Text(above(rate, 4), "green" if row["certified"].get(name) else "red")


def norm(row: dict[str, Any]) -> str:
    """The norm of the exact rate: ∞ or 1, and whether the states are scaled one by one or mixed.

    >>> norm({"norm": "inf", "scaling": [["1", "0"], ["0", "1/2"]]})
    '∞, scaled'
    """
    scaling = row["scaling"]
    mixed = any(x != "0" for i, line in enumerate(scaling) for j, x in enumerate(line) if i != j)
    plain = not mixed and all(scaling[i][i] == scaling[0][0] for i in range(len(scaling)))
    return NORMS[row["norm"]] + ("" if plain else ", mixed" if mixed else ", scaled")


def summary(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The result in a few lines."""
    held = [row["judged"] for row in rows]
    counts = {name: held.count(name) for name in CONDITIONS if name in held}
    by = ", ".join(f"{name} {count}" for name, count in counts.items())
    lines = [
        f"{len(rows) - held.count(None)} of {len(rows)} with a vector state certified contracting"
        + (f" (by {by})" if by else "") + ", in rational arithmetic"
    ]  # fmt: skip
    if any(row["judged"] is None and not row["certified"]["exact"] and "solver" not in row for row in rows):
        lines.append("a full metric P may prove more: --lmi searches for it (extra lmi)")
    return lines
