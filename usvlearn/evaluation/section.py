"""What a section of a report holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from usvlearn.evaluation.sheet import Sheet

PAPER = ("aid", "rls", "rnn")  # the paper's methods, by the names that the default configuration gives them


class Drawn(NamedTuple):
    """A figure."""

    name: str  # of its files
    figure: Any  # of matplotlib
    caption: str


class Section(NamedTuple):
    """A part of a report."""

    key: str
    title: str
    paper: str  # what the paper found; "" where it says nothing of it
    here: Sequence[str]  # sentences
    figures: Sequence[Drawn] = ()
    sheets: Sequence[Sheet] = ()


def of(count: int, total: int, what: str = "boats") -> str:
    """How many, in words that can be read aloud.

    >>> of(8, 8), of(0, 8), of(3, 8), of(1, 1)
    ('all 8 boats', 'none of 8 boats', '3 of 8 boats', 'the one boat')
    """
    if total == 1:
        return f"the one {what.removesuffix('s')}" if count else f"not the one {what.removesuffix('s')}"
    return f"all {total} {what}" if count == total else f"{count or 'none'} of {total} {what}"
