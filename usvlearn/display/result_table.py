"""A table of results, as CSV, Markdown and HTML."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

Cell = str | float | int | bool | None


class ResultTable(NamedTuple):
    """Rows under named columns; the names contain the units.

    >>> result_table = ResultTable("online", ("boat", "MAE, m/s"), [("heron", 0.0312345)])
    >>> print(result_table.markdown())
    | boat | MAE, m/s |
    |---|---:|
    | heron | 0.03123 |
    """

    name: str  # of its file
    columns: tuple[str, ...]
    rows: Sequence[tuple[Cell, ...]]

    def csv(self) -> str:
        """All digits; None is empty."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return text.getvalue()

    def markdown(self) -> str:
        """The table with four digits; columns of numbers are right-aligned."""
        lines = [
            "| " + " | ".join(self.columns) + " |",
            "|" + "|".join("---:" if right else "---" for right in self._numeric()) + "|",
            *("| " + " | ".join(map(shown, row)) + " |" for row in self.rows),
        ]
        return "\n".join(lines)

    def html(self) -> str:
        """A `<table>`; four digits."""
        right = [' class="n"' if each else "" for each in self._numeric()]
        head = "".join(f"<th{r}>{escape(name)}</th>" for name, r in zip(self.columns, right, strict=True))
        body = "".join(
            "<tr>" + "".join(f"<td{r}>{escape(shown(x))}</td>" for x, r in zip(row, right, strict=True)) + "</tr>\n"
            for row in self.rows
        )
        return f"<table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody>\n</table>"

    def _numeric(self) -> list[bool]:
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.columns)
        return [any(isinstance(x, int | float) for x in cells) for cells in columns]


def shown(x: Any) -> str:
    """A cell as shown: four significant digits, or a dash if the value is unknown.

    >>> shown(0.0312345), shown(1234.5678), shown(None), shown(float("nan")), shown(True)
    ('0.03123', '1235', '–', '–', 'yes')
    """
    if x is None or x != x:
        return "–"
    if isinstance(x, bool):
        return "yes" if x else "no"
    if isinstance(x, float):
        return f"{x:.4g}" if abs(x) < 1000 else f"{x:.0f}"
    return str(x)
