"""Writes the pages of results: their folder, tables, numbers, and the machine in words."""

import os
import platform
import subprocess
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from reference import FLAGS, compiler

FOLDER = Path(__file__).parents[1] / "docs" / "benchmarks"


def publish(script: str, text: str | Sequence[str]) -> None:
    """Print a page and write it to the folder, under the name of its script."""
    whole = (text if isinstance(text, str) else "\n".join(text)).rstrip("\n") + "\n"
    print(whole, end="")
    (FOLDER / f"{Path(script).stem}.md").write_text(whole)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Markdown; all columns but the first are numbers."""
    lines = [head, *rows]
    text = ["| " + " | ".join(line) + " |" for line in lines]
    return [text[0], "|---|" + "---:|" * (len(head) - 1), *text[1:]]


def three_digits(value: float) -> str:
    """Without an exponent."""
    digits = max(0, 2 - int(f"{value:e}".partition("e")[2]))
    return f"{value:.{digits}f}"


def micro(seconds: float | None) -> str:
    """Microseconds; nothing where nothing was measured."""
    return "" if seconds is None else three_digits(seconds * 1e6)


def counted(number: int, thing: str) -> str:
    return f"{number} {thing}{'s' * (number != 1)}"


def hardware() -> str:
    """The machine alone: the processor, how many cores, the system."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    processor = names[0] if names else platform.processor() or platform.machine()
    return f"{processor}, {platform.machine()}, {os.cpu_count()} cores, {platform.system()}"


def machine() -> str:
    """The machine and what computes on it."""
    facts = [
        hardware(),
        f"Python {platform.python_version()}",
        *(f"{name} {version(name)}" for name in ("torch", "numba", "numpy")),
    ]
    if compiler():
        banner = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout
        facts.append(f"{banner.splitlines()[0]} with `{' '.join(FLAGS)}`")
    if hasattr(os, "getloadavg"):
        facts.append(f"load {os.getloadavg()[0]:.1f} before")
    return "; ".join(facts)
