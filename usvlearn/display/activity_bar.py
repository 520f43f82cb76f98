"""One line at the terminal that tells what a command is doing, with a bar where its length is known."""

from __future__ import annotations

from contextlib import ExitStack

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Column

from usvlearn.display.activity import shown_by
from usvlearn.errors import printable

BAR = 20  # columns


class Activity:
    """A context that shows what `usvlearn.display.activity.doing` tells; nothing is left of it, and nothing goes into a
    file.

    Args:
        console: of the terminal.
        what: is done first.

    >>> with Activity(Console(quiet=True)) as activity:
    ...     activity.begin("replaying", total=100)
    ...     activity.advance(60)
    ...     activity.advance(40)
    >>> activity.done
    100.0
    """

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
