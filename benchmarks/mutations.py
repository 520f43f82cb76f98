"""Which tests see a fault: places of the sources are changed one by one, and the tests that ought to fail are run.

    python benchmarks/mutations.py                 try those of mutations.json beside this, draw missing ones
    python benchmarks/mutations.py --again         try the places of mutations.json alone, wherever their files are now
    python benchmarks/mutations.py --survivors     try again those alone that no test saw

A place is named by its function, its expression and what the expression becomes. A line number or a file's name would
be lost where code moves. Every change is made in a copy of the repository. The tests of a group (`mutation_groups`) run
in order, narrow ones first, until one fails: those of the default tier, and if all of them pass, the thorough ones. A
change that makes them compute longer than `--seconds` counts as seen, and is told as such. Results are written one by
one, and a run that was stopped continues with the places that are left: a result holds as long as the source file and
the test that saw the change are the same, and all tests of the group, if no default test saw it.
"""

from __future__ import annotations

import argparse
import ast
import fcntl
import hashlib
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
from collections.abc import Iterable, Sequence
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
    found: dict[Place, tuple[Path, ast.AST, ast.AST]] = {}
    for group in groups:
        for source in sorted(path for pattern in GROUPS[group].sources for path in root.glob(pattern)):
            own = [each for place in ALWAYS if place[0] == group for each in written(Place(*place), source)]
            for place, node, other in [*places(group, source), *own]:
                found.setdefault(place, (source, node, other))
    return found


def drawn(known: dict[Place, tuple[Path, ast.AST, ast.AST]]) -> list[Place]:
    """The places of each group, from one seed, as evenly over its files and functions as they come."""
    rng, chosen = random.Random(SEED), [Place(*each) for each in ALWAYS if Place(*each) in known]
    for group, each in GROUPS.items():
        own: dict[Path, list[Place]] = {}
        for place, (source, *_) in known.items():
            if place.group == group:
                own.setdefault(source, []).append(place)
        files, taken = list(own.values()), [place for place in chosen if place.group == group]
        rng.shuffle(files)
        for of_file in files:
            rng.shuffle(of_file)
            of_file[:] = [place for place in of_file if place not in EQUIVALENT]
        while len(taken) < min(each.places, sum(map(len, own.values()))):
            taken += [of_file.pop() for of_file in files[: each.places - len(taken)] if of_file]
        chosen += [place for place in taken if place not in chosen]
    return chosen


def filled(named: list[Place], new: list[Place], known: dict[Place, Any]) -> list[Place]:
    """The places of the table that exist, and of each group as many new ones as it lacks."""
    kept = [place for place in named if place in known]
    lacking = Counter({group: each.places for group, each in GROUPS.items()}) - Counter(place.group for place in kept)
    for place in new:
        if place not in kept and lacking[place.group] > 0:
            kept.append(place)
            lacking[place.group] -= 1
    return kept


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
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
    return found[1] if found else " ".join(output.split())[-120:]


def holds(row: dict[str, Any], text: str, folder: Path, group: Group) -> bool:
    """Whether a result is about this source and these tests."""
    return "tier" in row and row.get("about") == about(text, folder, deciding(row, group))


def deciding(row: dict[str, Any], group: Group) -> tuple[str, ...]:
    """The tests on which a result rests: the one that failed; all of the group, if none of the default tier did."""
    return (row["killed_by"],) if row["tier"] == "default" else group.tests


def about(text: str, folder: Path, tests: Sequence[str]) -> str:
    """The sha256 of a changed source and of tests, with that which settles their tiers."""
    total = hashlib.sha256(text.encode())
    for name in ("tests/conftest.py", *tests):
        if (file := _file(folder, name)).is_file():
            total.update(file.read_bytes())
    return total.hexdigest()[:16]


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


def main() -> int:
    """Try the places; prints a line for each, then the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--again", action="store_true", help="the places of the table, and no new ones")
    parser.add_argument("--survivors", action="store_true", help="those of the table that no test saw")
    parser.add_argument("--group", choices=GROUPS, nargs="+", help="the places of these groups alone")
    parser.add_argument("--folder", type=Path, help="of the copy, which is changed (default: a temporary one)")
    parser.add_argument("--show", action="store_true", help="print the table as it is")
    parser.add_argument("--seconds", type=float, default=LIMIT, help=f"CPU time of one place (default: {LIMIT:g})")
    options = parser.parse_args()
    before = json.loads(TABLE.read_text()) if TABLE.exists() else []
    if options.show:
        print(table(before))
        return 0
    groups, again = options.group or list(GROUPS), options.again or options.survivors
    name = "-".join(["mutations", *(options.group or ["all"])])
    folder = copied(ROOT, options.folder or Path(tempfile.gettempdir()) / name)
    collected(folder, groups)
    known = every_place(folder, groups if again else GROUPS)  # new ones are drawn in the order of all groups
    named = [Place(*(row[key] for key in Place._fields)) for row in before]
    wanted = named if again else filled(named, drawn(known), known)
    rows = {place: row for place, row in zip(named, before, strict=True) if place in wanted}
    for k, place in enumerate(wanted, 1):
        old = rows.get(place, {})
        skipped = place.group not in groups or (options.survivors and old.get("killed_by"))
        if place not in known or skipped:
            if not skipped:
                rows[place] = {**place._asdict(), "lost": True, "killed_by": None}
            continue
        source, node, other = known[place]
        text, group = changed(source, node, other), GROUPS[place.group]
        try:
            ast.parse(text)
        except SyntaxError as error:
            raise SystemExit(f"{place}: the change is no Python: {error}") from error
        if holds(old, text, folder, group):
            continue
        found = tried(folder, source, text, group, options.seconds)
        rows[place] = {**place._asdict(), **found, "about": about(text, folder, deciding(found, group))}
        print(f"{k}/{len(wanted)} {' | '.join(map(str, place[:4]))}: {rows[place]['killed_by']}", flush=True)
        with Path(__file__).open() as alone:
            fcntl.flock(alone, fcntl.LOCK_EX)
            stored = json.loads(TABLE.read_text()) if TABLE.exists() else []  # by another process, of other groups
            kept = {Place(*(row[key] for key in Place._fields)): row for row in stored} | {place: rows[place]}
            ordered = [kept[each] for each in wanted if each in kept]
            TABLE.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n")
    print(table([rows[each] for each in wanted if each in rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
