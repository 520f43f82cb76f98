"""The error that certify raises for bad input: each message says what was found, where, what was expected, the fix."""

from __future__ import annotations

import os
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager


class CertifyError(ValueError):
    """Bad input that the user can fix. `python -m certify` prints it in one sentence and exits with code 2."""


def folded(text: str, columns: int | None) -> str:
    """Lines broken between words for a terminal, which would break them within one; a long word stays whole."""
    if columns is None:
        return text
    fill = textwrap.TextWrapper(columns, break_long_words=False, break_on_hyphens=False).fill
    return "\n".join(map(fill, text.split("\n")))


def complain(text: str) -> None:
    """Print to the standard error stream."""
    try:
        columns = (os.get_terminal_size(sys.stderr.fileno()).columns or None) if sys.stderr.isatty() else None
    except (OSError, ValueError):
        columns = None
    print(folded(text, columns), file=sys.stderr)


@contextmanager
def about(path: str) -> Iterator[None]:
    """Make errors about one checkpoint name it; those of arithmetic, with unforeseen weights, are among them."""
    try:
        yield
    except CertifyError as error:
        if str(error).startswith(path):
            raise
        raise CertifyError(f"{path}: {error}") from error
    except (ArithmeticError, ValueError, MemoryError, RecursionError) as error:
        cause = f"{type(error).__name__}: {shortened(error)}"
        raise CertifyError(f"{path}: cannot be judged ({cause}): rescale the network, and report this fault") from error


def quoted(value: object) -> str:
    """At most 80 characters of a value, for a message: a value from a file can have any length."""
    return shortened(repr(value))


def shortened(text: object) -> str:
    """At most 80 characters of a text, in one line."""
    line = " ".join(str(text).split())
    return line if len(line) <= 80 else f"{line[:79]}…"
