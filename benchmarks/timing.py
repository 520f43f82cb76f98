"""What the measurements of speed share: works timed in turn, a page of results, the machine in words."""

import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from reference import FLAGS, compiler

Work = Callable[[], Any]
Clock = Callable[[], float]


class Effort(NamedTuple):
    """How much is measured."""

    repeats: int = 5
    steps: int = 50_000  # streamed through one batch element
    eager: int = 200  # of them through torch
    calls: int = 3000  # from Python
    elements: tuple[int, ...] = (1, 8, 64, 512, 4096)
    element_steps: int = 400_000  # over all batch elements
    hours: tuple[float, float] = (3.0, 30.0)  # of a season, and of a short one
    settings: int = 512  # of a grid
    sets: int = 80  # of a cross-validation
    clock: Clock = time.perf_counter  # s


WHOLE = Effort()
QUICK = Effort(2, 1000, 20, 100, (1, 8), 2000, (0.2, 0.4), 8, 4)


def once(work: Work, clock: Clock = time.perf_counter) -> float:
    """Seconds of a call."""
    start = clock()
    work()
    return clock() - start


def in_turn(works: Mapping[Any, Work], repeats: int, clock: Clock = time.perf_counter) -> dict[Any, list[float]]:
    """Seconds of every work, once each and all again: a machine that drifts harms their ratios least.

    Before, each is done once unmeasured: it may compile, and fills the caches.
    """
    for work in works.values():
        work()
    rounds = [{name: once(work, clock) for name, work in works.items()} for _ in range(repeats)]
    return {name: [each[name] for each in rounds] for name in works}


def ratio(spent: Sequence[float], reference: Sequence[float]) -> float:
    """Median over the rounds of the one's time over the other's."""
    return statistics.median(a / b for a, b in zip(spent, reference, strict=True))


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Markdown; all columns but the first are numbers.

    >>> print(*table(["a", "b"], [["x", "1"]]), sep="\\n")
    | a | b |
    |---|---:|
    | x | 1 |
    """
    lines = [head, *rows]
    text = ["| " + " | ".join(line) + " |" for line in lines]
    return [text[0], "|---|" + "---:|" * (len(head) - 1), *text[1:]]


def three_digits(value: float) -> str:
    """Without an exponent.

    >>> three_digits(1234.5), three_digits(0.015)
    ('1234', '0.0150')
    """
    digits = max(0, 2 - int(f"{value:e}".partition("e")[2]))
    return f"{value:.{digits}f}"


def micro(seconds: float | None) -> str:
    """Microseconds; nothing where nothing was measured.

    >>> micro(1.2345e-4), micro(None)
    ('123', '')
    """
    return "" if seconds is None else three_digits(seconds * 1e6)


def counted(number: int, thing: str) -> str:
    """
    >>> counted(1, "boat"), counted(8, "boat")
    ('1 boat', '8 boats')
    """
    return f"{number} {thing}{'s' * (number != 1)}"


def hardware() -> str:
    """The machine alone: the processor, how many cores, the system."""
    names = [line.partition(":")[2].strip() for line in _read("/proc/cpuinfo").splitlines() if "model name" in line]
    processor = names[0] if names else platform.processor() or platform.machine()
    return f"{processor}, {platform.machine()}, {os.cpu_count()} cores, {platform.system()}"


def load() -> float | None:
    """How many processes ran at once in the last minute; None where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def machine() -> str:
    """The machine and what computes on it."""
    found = [
        hardware(),
        f"Python {platform.python_version()}",
        *(f"{name} {version(name)}" for name in ("torch", "numba", "numpy")),
    ]
    if compiler():
        told = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout
        found.append(f"{told.splitlines()[0]} with `{' '.join(FLAGS)}`")
    if (busy := load()) is not None:
        found.append(f"load {busy:.1f} before")
    return "; ".join(found)


def _read(path: str) -> str:
    return Path(path).read_text() if Path(path).exists() else ""
