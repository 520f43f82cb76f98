"""Progress: library code reports a phase, and the command shows it (`usvlearn.display.terminal.Activity`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Show = Callable[[str], object]
SHOW: ContextVar[Show | None] = ContextVar("show", default=None)  # what shows it; a thread of its own has none


def doing(what: str) -> None:
    """Tell what is done now, in some words; it is nothing where nobody shows it."""
    if show := SHOW.get():
        show(what)


@contextmanager
def shown_by(show: Show) -> Iterator[None]:
    """A context in which `doing` calls a function."""
    before = SHOW.set(show)
    try:
        yield
    finally:
        SHOW.reset(before)
