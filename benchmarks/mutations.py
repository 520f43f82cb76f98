"""Mutation tests: changes places of the sources one by one, and runs the tests that ought to fail.

    python benchmarks/mutations.py                 try the places of mutations.json without a result, draw missing ones
    python benchmarks/mutations.py --again         try all places of mutations.json, wherever their files are now

A place is named by its function, its expression and what the expression becomes. A line number or a file's name would
be lost where code moves. Every change is made in a copy of the repository. The tests of a group (`mutation_groups`) run
in order, narrow ones first, until one fails: those of the default tier, and if all of them pass, the thorough ones. A
change that makes them compute longer than `--seconds` counts as seen, and is told as such. Results are written one by
one, so that a run that was stopped continues with the places that are left; --again tries them anew.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mutation_groups import ALWAYS, EQUIVALENT, GROUPS, Group
from mutation_places import Place, changed, places, written

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_suffix(".json")
SEED = 33
LIMIT = 300.0  # s of CPU, of one place
TIERS = {"default": (), "thorough": ("-m", "thorough and not slow and not slurm and not docs")}  # options of pytest
EMPTY = 5  # pytest's exit code where no test was collected
MEMORY = 8 << 30  # bytes of one place: a changed size may ask for all there is


def every_place(root: Path, groups: Iterable[str] = GROUPS) -> dict[Place, tuple[Path, ast.AST, ast.AST]]:
    """All places of groups by name; of two equal names in different files the first file's."""
    known: dict[Place, tuple[Path, ast.AST, ast.AST]] = {}
    for group in groups:
        for source in sorted(path for pattern in GROUPS[group].sources for path in root.glob(pattern)):
            more = [each for place in ALWAYS if place[0] == group for each in written(Place(*place), source)]
            for place, node, other in [*places(group, source), *more]:
                known.setdefault(place, (source, node, other))
    return known


def drawn(known: dict[Place, tuple[Path, ast.AST, ast.AST]]) -> list[Place]:
    """The places of each group, from one seed, as evenly over its files and functions as they come."""
    rng, chosen = random.Random(SEED), [Place(*each) for each in ALWAYS if Place(*each) in known]
    for group, each in GROUPS.items():
        by_file: dict[Path, list[Place]] = {}
        for place, (source, *_) in known.items():
            if place.group == group:
                by_file.setdefault(source, []).append(place)
        files, taken = list(by_file.values()), [place for place in chosen if place.group == group]
        rng.shuffle(files)
        for of_file in files:
            rng.shuffle(of_file)
            of_file[:] = [place for place in of_file if place not in EQUIVALENT]
        while len(taken) < min(each.places, sum(map(len, by_file.values()))):
            taken += [of_file.pop() for of_file in files[: each.places - len(taken)] if of_file]
        chosen += [place for place in taken if place not in chosen]
    return chosen


def filled(named: list[Place], new: list[Place], known: dict[Place, Any]) -> list[Place]:
    """The places of the table that exist, and of each group as many new ones as it lacks."""
    chosen = [place for place in named if place in known]
    lacking = Counter({group: each.places for group, each in GROUPS.items()}) - Counter(place.group for place in chosen)
    for place in new:
        if place not in chosen and lacking[place.group] > 0:
            chosen.append(place)
            lacking[place.group] -= 1
    return chosen


def copied(root: Path, folder: Path) -> Path:
    """Copy the tracked files and new ones; the folder is always the same, so that compiled code is found again."""
    folder = folder.resolve()
    if folder == root:
        raise SystemExit(f"--folder: found {folder}, expected another folder than the repository's own")
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=root, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        target = folder / name
        if (root / name).is_file() and not (target.exists() and target.read_bytes() == (root / name).read_bytes()):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(root / name, target)
    for stale in (path for pattern in ("certify", "usvlearn", "tests") for path in (folder / pattern).rglob("*.py")):
        if not (root / stale.relative_to(folder)).exists():
            stale.unlink()
    return folder


def _file(folder: Path, test: str) -> Path:
    """The file of a test, which may be named with its function."""
    return folder / test.partition("::")[0]


def collected(folder: Path, groups: Iterable[str]) -> None:
    """Refuse a copy whose tests cannot even be collected: each change would count as seen."""
    tests = sorted({name for group in groups for name in GROUPS[group].tests if _file(folder, name).exists()})
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", *tests]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if ran.returncode not in (0, EMPTY):
        raise SystemExit(f"the tests cannot be collected without a change:\n{ran.stdout[-500:]}{ran.stderr[-500:]}")


def tried(folder: Path, source: Path, text: str, group: Group, seconds: float) -> dict[str, Any]:
    """Run the tests on a changed file, and put it back: the first test that fails, or None, and its tier."""
    before, began, killed, tier = source.read_text(), time.perf_counter(), None, None
    tests = [name for name in group.tests if _file(folder, name).exists()]
    tests.sort(key=lambda name: f"/test_{source.stem}." not in name)  # the source's own tests first
    source.write_text(text)
    try:
        for name, options in TIERS.items():
            if killed := failed(folder, [*options, *tests], group.compiled, seconds):
                tier = name
                break
    finally:
        source.write_text(before)
    return {"killed_by": killed, "tier": tier, "seconds": round(time.perf_counter() - began, 1)}


def failed(folder: Path, options: list[str], compiled: bool, seconds: float) -> str | None:
    """The first test that fails, or how else pytest failed; None if no test fails, or there is none."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    if not compiled:  # NumPy warns of infinite and undefined numbers then, which is no fault that a test has seen
        environment["NUMBA_DISABLE_JIT"], options = "1", ["-W", "ignore::RuntimeWarning", *options]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-rfE", *options]

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

    ran = subprocess.Popen(
        command, cwd=folder, env=environment, text=True, start_new_session=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, preexec_fn=limited,
    )  # fmt: skip
    try:
        output = ran.communicate(timeout=10 * seconds)[0]
    except subprocess.TimeoutExpired:
        return f"longer than {seconds:g} s"
    finally:
        if ran.poll() is None:
            os.killpg(ran.pid, signal.SIGKILL)
            ran.communicate()
    if ran.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"longer than {seconds:g} s"
    if ran.returncode in (0, EMPTY):
        return None
    match = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return match[1] if match else " ".join(output.split())[-120:]


def table(rows: list[dict[str, Any]]) -> str:
    """The results in Markdown."""
    tiers = Counter(row.get("tier") for row in rows if "lost" not in row)
    late = sum(str(row.get("killed_by")).startswith("longer") for row in rows)
    lost = sum("lost" in row for row in rows)
    default, by_all = tiers["default"], tiers["default"] + tiers["thorough"]
    lines = [
        f"{len(rows)} places: seen by default tests {default}, by all {by_all}, by none {len(rows) - by_all - lost}"
    ]
    lines += ["", f"{late} by the time limit, {lost} lost"]
    lines += ["", "| group | function | from | to | tier | seen by |", "|---|---|---|---|---|---|"]
    for row in rows:
        cells = [*(row[key] for key in Place._fields[:4]), row.get("tier") or ""]
        cells += ["lost: no such place" if "lost" in row else row["killed_by"] or "**no test**"]
        lines.append("| " + " | ".join(cell.replace("|", "\\|")[:110] for cell in cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Try the places; prints a line for each, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="store_true", help="all places of the table, and no new ones")
    parser.add_argument("--group", choices=GROUPS, nargs="+", help="the places of these groups alone")
    parser.add_argument("--folder", type=Path, help="of the copy, which is changed (default: a temporary one)")
    parser.add_argument("--seconds", type=float, default=LIMIT, help=f"CPU time of one place (default: {LIMIT:g})")
    options = parser.parse_args()
    rows = {Place(*(row[key] for key in Place._fields)): row for row in json.loads(TABLE.read_text())}
    groups = options.group or list(GROUPS)
    folder = copied(ROOT, options.folder or Path(tempfile.gettempdir()) / "-".join(["mutations", *groups])[:80])
    collected(folder, groups)
    known = every_place(folder, groups if options.again else GROUPS)  # new ones are drawn in the order of all groups
    wanted = list(rows) if options.again else filled(list(rows), drawn(known), known)
    for k, place in enumerate(wanted, 1):
        if place.group not in groups or ("tier" in rows.get(place, {}) and not options.again):
            continue
        if place in known:
            source, node, other = known[place]
            text = changed(source, node, other)
            ast.parse(text)
            rows[place] = {**place._asdict(), **tried(folder, source, text, GROUPS[place.group], options.seconds)}
        else:
            rows[place] = {**place._asdict(), "lost": True, "killed_by": None}
        print(f"{k}/{len(wanted)} {' | '.join(map(str, place[:4]))}: {rows[place]['killed_by']}", flush=True)
        still = [rows[each] for each in wanted if each in rows]
        TABLE.write_text(json.dumps(still, indent=1, ensure_ascii=False) + "\n")
    print(table([rows[each] for each in wanted if each in rows]))


if __name__ == "__main__":
    main()
