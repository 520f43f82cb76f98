"""Speed, accuracy, stress and certificates in short, compared with earlier runs: a data page and its history.

python benchmarks/overview.py                    ten minutes; wants the extra bench and an idle machine
python benchmarks/overview.py --logs LOGS        also recorded boats; LOGS: a folder with blueboat, vtec, dalian
python benchmarks/overview.py --check            exits with 1 if a figure has become worse, for use before a release
python benchmarks/overview.py --only speed       one section, printed alone; --check works with it, too
python benchmarks/overview.py --quick            all, on little data: whether it runs

A whole run writes overview.md of docs/benchmarks, and appends its figures to history.csv there. With
--only or --quick nothing is written, unless --folder names a place. `benchmarks/history.py` states when a figure is
worse.
"""

import argparse
import math
import platform
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import history
import torch
from history import Comparison, Entry, Run
from overview_sections import QUICK, RECORDED, SECTIONS, WHOLE, Part
from pages import FOLDER
from timing import hardware, load, machine, table, three_digits

import usvlearn
from usvlearn.errors import UsvlearnError, exit_on_user_error

BUSY = 0.7  # load from which on other work is mentioned
OPENING = """The package is compared with references: the same steps in C, other libraries, and batch least
squares. This page is a summary; [Benchmarks](../benchmarks.md) links all others."""
RULE = (history.__doc__ or "").partition("\n\n")[2].strip()
CHECK = """`python benchmarks/overview.py --check` exits with 1 and names the figures that are worse. The file is
[history.csv](history.csv)."""


def this_run(effort: str) -> Run:
    now = datetime.now(UTC).replace(microsecond=0)
    packages = (version(name) for name in ("torch", "numba", "numpy"))
    return Run(now.isoformat(), usvlearn.__version__, effort, hardware(), platform.python_version(), *packages)


def percent(change: float | None) -> str:
    """
    >>> percent(0.123), percent(-0.004), percent(math.inf), percent(None)
    ('+12 %', '+0 %', 'from 0', '')
    """
    if change is None:
        return ""
    return f"{round(100 * change):+d} %" if math.isfinite(change) else "from 0"


def beside_earlier(before: Sequence[Entry], comparisons: Sequence[Comparison]) -> list[str]:
    """The table of the history, and what it shows in a sentence."""
    rows = [
        [each.figure.name, three_digits(each.figure.value), each.figure.reference,
         "" if each.figure.spread is None else f"{100 * each.figure.spread:.0f} %", str(each.entries),
         percent(each.last), percent(each.median), f"{100 * each.tolerance:.0f} %", "**worse**" if each.worse else ""]
        for each in comparisons
    ]  # fmt: skip
    head = ["figure", "ratio", "to", "spread", "entries", "since the last", "since their median", "t", ""]
    known, worse = sum(each.entries > 0 for each in comparisons), sum(each.worse for each in comparisons)
    text = f"Figures: {len(comparisons)}; with comparable entries: {known}; worse: {worse}."
    if before:
        run = before[-1].run
        text += (
            f" The entry before this run is of {run.date}: usvlearn {run.version}, Python {run.python}, torch "
            f"{run.torch}, numba {run.numba}, numpy {run.numpy}, {run.machine}."
        )
    return [text, "", *table(head, rows)]


def verdict(comparisons: Sequence[Comparison]) -> str:
    """What has become worse, in a sentence."""
    told = [
        f"{each.figure.name} ({percent(each.last)} since the last entry, {percent(each.median)} since the median, "
        f"t = {100 * each.tolerance:.0f} %)"
        for each in comparisons
        if each.worse
    ]
    if told:
        return f"{len(told)} of {len(comparisons)} figures are worse: {'; '.join(told)}."
    known = sum(each.entries > 0 for each in comparisons)
    return f"No figure is worse, of {known} with comparable entries." if known else "Nothing to compare with."


def page(run: Run, command: str, computer: str, minutes: float, parts: dict[str, Part], against: Sequence[str]) -> str:
    """The page, as Markdown; `against` is empty where there is nothing to compare with."""
    text = [
        "# Speed, accuracy, stress and certificates in short", "", OPENING, "",
        f"Made by `{command}` on {run.date} in {minutes:.0f} min, with usvlearn {run.version}.", "",
        f"{computer}.", "",
    ]  # fmt: skip
    for name, part in parts.items():
        text += [f"## {SECTIONS[name][0]}", "", *part.lines, ""]
    if against:
        text += ["## Against earlier runs", "", *against, "", RULE, "", CHECK, ""]
    return "\n".join(text)


def measure(names: Sequence[str], quick: bool, logs: Path | None) -> dict[str, Part]:
    parts = {}
    for name in names:
        print(f"{SECTIONS[name][0]} …", file=sys.stderr, flush=True)
        parts[name] = SECTIONS[name][1](QUICK if quick else WHOLE, logs)
    return parts


def work(given: argparse.Namespace, spare: Path) -> int:
    """The command; returns its exit code."""
    whole = given.only is None and not given.quick
    file = (given.folder or (spare if given.quick else FOLDER)) / "history.csv"
    before = history.read(file)  # a damaged file is found before ten minutes have passed
    if given.logs and not any((given.logs / name).is_dir() for name in RECORDED):
        raise UsvlearnError(f"--logs: found no folder {', '.join(RECORDED)} in {given.logs}, expected one at least")
    began, computer, run = time.monotonic(), machine(), this_run("quick" if given.quick else "whole")
    if (load() or 0.0) > BUSY:
        computer += ". Other work ran on the machine, which makes the times uncertain"
    parts = measure([given.only] if given.only else list(SECTIONS), given.quick, given.logs)
    minutes = (time.monotonic() - began) / 60
    now = [Entry(run, figure) for part in parts.values() for figure in part.figures]
    comparisons = [history.compare(before, entry) for entry in now]
    against = beside_earlier(before, comparisons)
    if whole or given.folder:
        folder = given.folder or FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        history.append(file, now)
        command = f"python benchmarks/overview.py{' --quick' * given.quick}{' --logs LOGS' * bool(given.logs)}"
        shown = against if any(each.entries for each in comparisons) else []
        (folder / "overview.md").write_text(page(run, command, computer, minutes, parts, shown))
    for name, part in parts.items():
        print("", f"## {SECTIONS[name][0]}", "", *part.lines, sep="\n")
    print("", *against, "", verdict(comparisons), sep="\n")
    return int(given.check and any(each.worse for each in comparisons))


def main(arguments: Sequence[str] | None = None) -> int:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", choices=SECTIONS, help="one section, printed alone")
    asked.add_argument("--quick", action="store_true", help="on little data")
    asked.add_argument("--check", action="store_true", help="exit with 1 if a figure has become worse")
    asked.add_argument("--logs", type=Path, help="a folder with recorded boats")
    asked.add_argument("--folder", type=Path, help="of the page and the history; by default docs/benchmarks")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as spare, exit_on_user_error():
        return work(asked.parse_args(arguments), Path(spare))


if __name__ == "__main__":
    sys.exit(main())
