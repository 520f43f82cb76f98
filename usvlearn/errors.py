"""The errors that usvlearn raises for bad input: each message says what was found, what was expected, and the fix."""

import difflib
import errno
import os
import re
import sys
import textwrap
import traceback
import warnings
from collections.abc import Container, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
DISK = (*NO_ROOM, errno.EROFS, errno.EIO)  # of a write, which names no file


def printable(text: str) -> str:
    r"""Text from a file, with characters that would control the terminal escaped."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def folded(text: str, columns: int | None) -> str:
    """Text whose lines are broken between words, where a terminal would break them within one; a long word stays whole.

    What follows a label and two spaces continues below itself. Without columns, as of a file, nothing is broken.
    """
    if columns is None:
        return text
    lines = []
    for line in text.split("\n"):
        label = re.match(r"\s*(?:\S+ {2,}(?=\S))?", line)
        hang = " " * len(label[0] if label else "")
        lines.append(
            textwrap.fill(line, columns, subsequent_indent=hang, break_long_words=False, break_on_hyphens=False)
        )
    return "\n".join(lines)


def columns_of(stream: TextIO) -> int | None:
    """The width of the terminal to which a stream writes; None if it is none, or does not tell."""
    try:
        return (os.get_terminal_size(stream.fileno()).columns or None) if stream.isatty() else None
    except (OSError, ValueError):
        return None


def drop_output() -> None:
    """Let the standard output go nowhere: its reader has gone, as `head` does."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def complain(text: str) -> None:
    """Print to the standard error stream, with lines that the terminal need not break."""
    print(folded(text, columns_of(sys.stderr)), file=sys.stderr)


class UsvlearnError(ValueError):
    """Any bad input that the user can fix. `train.py` prints it in one sentence and exits with code 2.

    >>> from usvlearn import AID
    >>> try:
    ...     AID(gain=-1.0)
    ... except UsvlearnError as error:
    ...     print(error)
    gain: found -1.0, expected a positive number
    """


class LogFormatError(UsvlearnError):
    """A log that cannot be read as it was declared. The message may quote the log: see `printable`.

    Args:
        message: one sentence; what may not be printed is escaped.

    >>> from pathlib import Path
    >>> from usvlearn.logs.formats.csv.table import Table
    >>> issubclass(LogFormatError, UsvlearnError), str(LogFormatError("a.csv: found no rows"))
    (True, 'a.csv: found no rows')
    """

    def __init__(self, message: str):
        super().__init__(printable(message))


class CheckpointError(UsvlearnError):
    """A checkpoint that is damaged, or that belongs to another estimator or schema.

    >>> from usvlearn import Online
    >>> Online.open("nowhere.safetensors")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    usvlearn.errors.CheckpointError: nowhere.safetensors: ...
    """


class ConfigError(UsvlearnError):
    """An option outside its legal values.

    >>> from usvlearn import AID
    >>> AID(mass=0.0)
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: mass: found 0.0, expected a positive number of kg
    """


class MemberError(UsvlearnError):
    """What other code raised, which is the cause, as it stepped a member of an ensemble.

    Args:
        step: index of the step at which.
        predictions: up to it, m/s, `(time, *batch)`.

    >>> MemberError(3, None).step
    3
    """

    def __init__(self, step: int, predictions: Any):
        super().__init__(f"step {step}")
        self.step, self.predictions = step, predictions


class ShapeError(UsvlearnError):
    """Arrays whose shape or dtype do not fit together.

    >>> from usvlearn import AID
    >>> AID(gain=[0.5, 1.0]).init((3,))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    usvlearn.errors.ShapeError: gain: found the shape (2,), expected one that broadcasts against the batch (3,): ...
    """


class MissingExtraError(UsvlearnError, ImportError):
    """An optional dependency that is not installed.

    Args:
        package: that is missing.
        extra: of usvlearn or certify, which installs it.
        purpose: what it is needed for.

    >>> print(MissingExtraError("rosbags", "logs", "reading a bag"))
    reading a bag needs the package rosbags, which is not installed: run `pip install 'usvlearn[logs]'`
    """

    def __init__(self, package: str, extra: str, purpose: str):
        name = f"{_distribution(extra)}[{extra}]"
        super().__init__(f"{purpose} needs the package {package}, which is not installed: run `pip install '{name}'`")


def _distribution(extra: str) -> str:
    """The one to install an extra of: usvlearn, or usvlearn-aboard where that is installed and has this extra."""
    from importlib.metadata import PackageNotFoundError, metadata  # takes a moment to import

    try:
        aboard = metadata("usvlearn-aboard").get_all("Provides-Extra") or []
    except PackageNotFoundError:
        aboard = []
    return "usvlearn-aboard" if extra in aboard else "usvlearn"


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> str:
    """Return `value` if it is one of `choices`, else raise a ConfigError that lists them."""
    if value not in choices:
        raise ConfigError(f"{name}: found {value!r}, expected one of {', '.join(choices)}")
    return value


def check_positive(name: str, value: float, unit: str = "") -> float:
    """Return `value` if it is a positive, finite number, else raise a ConfigError."""
    if not (isinstance(value, int | float) and 0 < value < float("inf")):
        raise ConfigError(f"{name}: found {value!r}, expected a positive number {unit}".rstrip())
    return value


def check_not_negative(name: str, value: float, unit: str = "") -> float:
    """Return `value` if it is a finite number of 0 or more, else raise a ConfigError."""
    if not (isinstance(value, int | float) and 0 <= value < float("inf")):
        raise ConfigError(f"{name}: found {value!r}, expected a number of 0 or more {unit}".rstrip())
    return value


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """A hint at the nearest names: keys that end in the word, or one that looks similar; else ""."""
    names = list(names)
    ends = [name for name in names if name.endswith(f".{word}")]
    keys = [name for name in ends if not name.startswith("hydra.")]
    close = keys or difflib.get_close_matches(word, names, n=1) or ends
    return f": did you mean {' or '.join(close[:3])}?" if close else ""


@contextmanager
def under(key: str, names: Container[str] | None = None) -> Iterator[None]:
    """A context in which an error that begins with the name of an option begins with the full path of its key."""
    try:
        yield
    except UsvlearnError as error:
        first = re.split(r"\W", str(error), maxsplit=1)[0]
        if key and (names is None or first in names):
            error.args = (f"{key}.{error}",)
        raise


@contextmanager
def reading(file: os.PathLike[str] | str) -> Iterator[None]:
    """What a reader did not mean to raise becomes a LogFormatError, so that the other logs of a folder are read.

    Only calls of a reader stand in it. Tests of the readers call them directly, and see the exception itself.
    """
    try:
        yield
    except (UsvlearnError, OSError, Warning):
        raise
    except Exception as error:
        raise LogFormatError(f"{file}: cannot be read ({cause_of(error)}): leave it out, and report this") from error


def cause_of(error: Exception) -> str:
    """An unexpected exception in words, with its place."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {str(error)[:200]}, in {os.path.basename(at.filename)}:{at.lineno}"


def bad_input(error: BaseException) -> str | None:
    """The sentence for the user if an error means bad input or a full disk; None if it is a bug."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, UsvlearnError):
        cause = cause.__cause__
    if cause is not None:
        return str(cause)
    if isinstance(error, OSError) and (error.filename is not None or error.errno in DISK):
        full = "make room there; the files saved before are complete"
        hint = full if error.errno in NO_ROOM else "correct that, or name another file or folder"
        return f"{error.filename or 'a file of the run'}: {error.strerror}: {hint}"
    return None


@contextmanager
def exit_on_user_error() -> Iterator[None]:
    """A context in which bad input ends the program with one sentence and code 2, and a warning takes one line."""
    before = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"{folded(f'warning: {message}', columns_of(sys.stderr))}\n"
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()  # here, so that a reader who has gone is no error at the end
    except BrokenPipeError:
        drop_output()
    except Exception as error:
        if (cause := bad_input(error)) is None:
            raise
        complain(f"error: {cause}")
        sys.exit(2)
    finally:
        warnings.formatwarning = before
