"""What a terminal shows: sentences and tables at any width, what a command is doing; and tables as files.

No number and no name is cut. A table that is too wide is split into blocks, one below the other; each begins with the
columns of names. Output to a file or a pipe has no width limit, unless COLUMNS sets one.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from typing import Any, NamedTuple

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Column
from rich.text import Text

from usvlearn.core.activity import shown_by
from usvlearn.errors import drop_output, folded, printable

ALL = "--all"  # rows and sentences, of train, fit and evaluate: without it what is looked at first
asked: list[str] = []  # ALL, where the user of this process has given it
UNLIMITED = 100_000  # columns of a file or a pipe
GAP, RULE = "  ", "─"
LEAST = 6  # least width, in columns, of a text that is folded


class _Console(Console):
    """A console whose command goes on, and writes its files, where the reader of a pipe has gone, as `head` does."""

    def on_broken_pipe(self) -> None:
        """Drop what is printed from now on."""
        self.quiet = True
        drop_output()


def console(quiet: bool = False) -> Console:
    """The standard output, as wide as the terminal. In a notebook it is text, too, and not HTML."""
    terminal = _Console(markup=False, quiet=quiet, force_jupyter=False)
    if not terminal.is_terminal and "COLUMNS" not in os.environ:
        terminal.width = UNLIMITED
    return terminal


def show(*parts: str | Text | Blocks, to: Console | None = None) -> None:
    """Print sentences, paths and commands, whose lines are broken between words, tables, and Text as it is."""
    to = to or console()
    for part in parts:
        to.print(folded(part, to.width) if isinstance(part, str) else part, soft_wrap=not isinstance(part, Blocks))


class Blocks:
    """A table in as many blocks as the width needs, each with the columns `names`; `folded` may take several lines."""

    def __init__(self, title: str, names: Sequence[str], numbers: Sequence[str] = (), folded: Collection[str] = ()):
        self.title, self.head, self.names = title, (*names, *numbers), len(names)
        self.folded = [k for k, name in enumerate(names) if name in folded]
        self.rows: list[tuple[Text, ...]] = []  # of one cell: the heading of those that follow

    def add(self, *cells: str | Text, style: str = "") -> None:
        """A row; a style such as "bold" is that of all its cells."""
        self.rows.append(tuple(Text(str(cell), style or getattr(cell, "style", "")) for cell in cells))

    def group(self, heading: str) -> None:
        """A heading for the rows that follow."""
        self.rows.append((Text(heading, "underline"),))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Text]:
        yield Text(self.title, "italic")
        widths, blocks = self._layout(options.max_width)
        for block in blocks:
            yield Text()
            columns = [*range(self.names), *block]
            head = [Text(self.head[k], "bold") for k in columns]
            yield from self._lines(console, head, columns, widths)
            yield Text(RULE * self._width(columns, widths))
            for number, row in enumerate(self.rows):
                if len(row) > 1:
                    yield from self._lines(console, [row[k] for k in columns], columns, widths)
                else:
                    yield from [Text()] * bool(number)
                    yield from row
        yield Text()

    def _lines(self, console: Console, cells: list[Text], columns: list[int], widths: list[int]) -> Iterator[Text]:
        """The lines of a row; there are several if a cell is folded."""
        parts = [cell.wrap(console, widths[k], overflow="fold") for cell, k in zip(cells, columns, strict=True)]
        for number in range(max(map(len, parts))):
            line = []
            for k, part in zip(columns, parts, strict=True):
                cell = part[number].copy() if number < len(part) else Text()
                cell.rstrip()
                cell.align("left" if k < self.names else "right", widths[k])
                line.append(cell)
            whole = Text(GAP).join(line)
            whole.rstrip()
            yield whole

    def _width(self, columns: Sequence[int], widths: Sequence[int]) -> int:
        return sum(widths[k] for k in columns) + len(GAP) * (len(columns) - 1)

    def _layout(self, width: int) -> tuple[list[int], list[list[int]]]:
        """The width of each column, and the columns of numbers in each block."""
        table = [[Text(name) for name in self.head], *(row for row in self.rows if len(row) > 1)]
        widths = [max(row[k].cell_len for row in table) for k in range(len(self.head))]
        names, numbers = list(range(self.names)), list(range(self.names, len(self.head)))
        words = {
            k: max(cell_len(word) for row in table for word in (row[k].plain or " ").split(" ")) for k in self.folded
        }
        if self._fold(widths, words, [*names, *numbers], width):
            return widths, [numbers]
        widest = max(numbers, key=widths.__getitem__, default=None)
        self._fold(widths, dict.fromkeys(self.folded, LEAST), [*names, *([] if widest is None else [widest])], width)
        room = max(0, width - self._width(names, widths))
        count = len(self._shared(numbers, widths, room))
        even = (self._shared(numbers, widths, narrower) for narrower in range(room + 1))
        return widths, next(blocks for blocks in even if len(blocks) == count)

    def _fold(self, widths: list[int], least: Mapping[int, int], columns: Sequence[int], width: int) -> bool:
        """Narrow the texts, the widest first, until some columns fit, or none may be narrower; whether they fit."""
        while self._width(columns, widths) > width:
            wide = [k for k in self.folded if widths[k] > least[k]]
            if not wide:
                return False
            widths[max(wide, key=lambda k: (widths[k], k))] -= 1
        return True

    def _shared(self, numbers: Sequence[int], widths: Sequence[int], room: int) -> list[list[int]]:
        """The columns of numbers in blocks of so much room, each of one column at least, if there are any."""
        blocks: list[list[int]] = [[]]
        left = room
        for k in numbers:
            taken = len(GAP) + widths[k]
            if blocks[-1] and taken > left:
                blocks.append([])
                left = room
            blocks[-1].append(k)
            left -= taken
        return blocks


BAR = 20  # columns


class Activity:
    """Shows what `usvlearn.core.activity.doing` tells; nothing is left of it, and nothing goes into a file."""

    def __init__(self, console: Console, what: str = "starting"):
        text = TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis"))
        bar = BarColumn(BAR), TaskProgressColumn(), TimeRemainingColumn()
        self._progress = Progress(SpinnerColumn(), text, *bar, console=console, transient=True)
        self._stack, self.done = ExitStack(), 0.0
        self._task = self._progress.add_task(what, total=None)

    def __enter__(self) -> Activity:
        # In a file it would leave an empty line. While rich draws, all that is printed goes to its console, and a quiet
        # one would lose the lines that a sweep prints of its jobs.
        if self._progress.console.is_terminal and not self._progress.console.quiet:
            self._stack.enter_context(self._progress)
            self._stack.enter_context(shown_by(self.tell))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def tell(self, what: str) -> None:
        """What is done now; the bar stays as it is."""
        self._progress.update(self._task, description=printable(what))

    def begin(self, what: str, total: float | None = None) -> None:
        """What is done from now on, and how much it is; None where that is not known."""
        self.done = 0.0
        self._progress.remove_task(self._task)
        self._task = self._progress.add_task(printable(what), total=total)

    def advance(self, amount: float) -> None:
        """So much more is done."""
        self.completed(self.done + amount)

    def completed(self, amount: float) -> None:
        """So much is done in all."""
        self.done = float(amount)
        self._progress.update(self._task, completed=amount)


Cell = str | float | int | bool | None


class ResultTable(NamedTuple):
    """Rows under named columns; the names contain the units."""

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
            "|" + "|".join("---:" if right else "---" for right in self.numeric) + "|",
            *("| " + " | ".join(map(shown, row)) + " |" for row in self.rows),
        ]
        return "\n".join(lines)

    @property
    def numeric(self) -> list[bool]:
        """Which columns have numbers."""
        columns = zip(*self.rows, strict=True) if self.rows else [()] * len(self.columns)
        return [any(isinstance(x, int | float) for x in cells) for cells in columns]


def shown(x: Any) -> str:
    """A cell as shown: four significant digits, or a dash if the value is unknown."""
    if x is None or x != x:
        return "–"
    if isinstance(x, bool):
        return "yes" if x else "no"
    if isinstance(x, float):
        return f"{x:.4g}" if abs(x) < 1000 else f"{x:.0f}"
    return str(x)
