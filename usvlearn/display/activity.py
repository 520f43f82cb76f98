"""Progress: library code reports a phase, and the command shows it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_SHOW: ContextVar[Callable[[str], object] | None] = ContextVar("show", default=None)


def doing(what: str) -> None:
    """Tell what is done now, in some words; it is nothing where nobody shows it."""
    if show := _SHOW.get():
        show(what)


@contextmanager
def shown_by(show: Callable[[str], object]) -> Iterator[None]:
    """A context in which `doing` calls a function."""
    before = _SHOW.set(show)
    try:
        yield
    finally:
        _SHOW.reset(before)
