"""Which tests see a fault: 60 places of the sources are changed one by one, and the tests that ought to fail are run.

    python benchmarks/mutations.py                 try those of mutations.json beside this, draw missing ones
    python benchmarks/mutations.py --again         try the places of mutations.json alone, wherever their files are now
    python benchmarks/mutations.py --survivors     try again those alone that no test saw

A place is named by its function, its expression and what the expression becomes. A line number or a file's name would
be lost where code moves. Every change is made in a copy of the repository. The tests of a group run in the order below,
narrow ones first, until one fails. A change that makes them compute longer than `--seconds` counts as seen, and is told
as such. Results are written one by one, and a run that was stopped continues with the places that are left: a result
holds as long as the source file is the same, and if no test saw the change, as long as the tests are, too.
"""

from __future__ import annotations

import argparse
import ast
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
from pathlib import Path
from typing import Any, NamedTuple

from mutation_places import Place, changed, places

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_suffix(".json")
SEED = 33
LIMIT = 300.0  # s of CPU, of one place
MEMORY = 8 << 30  # bytes of one place: a changed size may ask for all there is


class Group(NamedTuple):
    """Sources, how many places are drawn from them, and the tests that ought to see a change."""

    sources: tuple[str, ...]  # patterns below the repository
    places: int
    tests: tuple[str, ...]
    compiled: bool = True  # whether the tests need numba; without it a change is not compiled first


def named(folder: str, names: str) -> tuple[str, ...]:
    """The test files of a folder by the middle of their names."""
    return tuple(f"tests/{folder}/test_{name}.py" for name in names.split())


GROUPS = {
    "certify": Group(
        (
            *(f"certify/*/vector_{name}*.py" for name in ("a", "b*e", "c", "e", "f", "l", "p", "r", "sc")),
            "certify/networks/vector.py",
        ),
        18,
        (
            *named("certify/proofs", "vector_exact vector_certificate"),
            *named("certify/command", "vector_certify"),
            *named("certify/search", "vector_scaling"),
            *named("certify/training", "vector_projections"),
            *named("certify/search", "vector_lmi vector_box"),
        ),
    ),
    "certify_box": Group(
        (
            *(f"certify/search/vector_{name}.py" for name in ("box", "box_search")),
            *(f"certify/proofs/vector_{name}.py" for name in ("box_proof", "slopes", "statements")),
        ),
        8,
        (
            *named("certify/proofs", "vector_slopes"),
            *named("certify/search", "vector_box"),
            *named("certify/proofs", "steps"),
        ),
    ),
    "live": Group(
        ("usvlearn/live/*.py", "usvlearn/live/ros2/*.py", "usvlearn/live/status/*.py", "usvlearn/core/json_values.py"),
        10,
        (
            *named("live", "arguments prior systemd"),
            *named("live/ros2", "ros2 ros2_node ros2_parameters"),
            *named("live", "session recent usable replay node"),
        ),
    ),
    "export": Group(("usvlearn/model/export/*.py",), 7, named("model/export", "formats command")),
    "joint": Group(
        ("usvlearn/estimators/joint/*.py", "usvlearn/estimators/augmented/*.py"),
        6,
        named("estimators", "joint identified quantities"),
        False,
    ),
    "forecasts": Group(
        ("usvlearn/estimators/ensemble/forecasts/*.py",),
        4,
        (
            *named("estimators", "forecasts plans"),
            *named("engine", "descriptions"),
            "tests/engine/test_kernels.py::test_every_estimator_and_setting[forecasts]",
        ),
        False,
    ),
    "logs": Group(
        tuple(f"usvlearn/logs/{room}*.py" for room in ("alignment/", "channels/", "formats/", "formats/*/", "")),
        7,
        (
            *named("logs", "survey"),
            *named("logs/formats/csv", "topics"),
            *named("logs", "setup"),
            *named("logs/alignment", "mixing"),
            *named("logs/formats/csv", "csv_dialects"),
            *named("logs/channels", "relations"),
            *named("logs", "velocities"),
            *named("logs/channels", "derived_surge"),
            *named("logs/formats/ros", "decompress"),
            *named("logs/channels", "copies"),
            *named("logs/formats", "readers"),
            *named("logs/alignment", "align"),
            *named("logs", "read"),
        ),
    ),
}
ALWAYS = (  # what an adversary changed, and no test saw
    ("certify", "_claims", "2", "4", 0),
)


def every_place(root: Path) -> dict[Place, tuple[Path, ast.AST, ast.AST]]:
    """All places by name; of two equal names in different files the first file's."""
    found: dict[Place, tuple[Path, ast.AST, ast.AST]] = {}
    for group, each in GROUPS.items():
        for source in sorted(path for pattern in each.sources for path in root.glob(pattern)):
            for place, node, other in places(group, source):
                found.setdefault(place, (source, node, other))
    return found


def drawn(known: dict[Place, tuple[Path, ast.AST, ast.AST]]) -> list[Place]:
    """The places of each group, from one seed, as evenly over its files and functions as they come."""
    rng, chosen = random.Random(SEED), [Place(*each) for each in ALWAYS]
    for group, each in GROUPS.items():
        own: dict[Path, list[Place]] = {}
        for place, (source, *_) in known.items():
            if place.group == group:
                own.setdefault(source, []).append(place)
        files, taken = list(own.values()), [place for place in chosen if place.group == group]
        rng.shuffle(files)
        for of_file in files:
            rng.shuffle(of_file)
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


def collected(folder: Path) -> None:
    """Refuse a copy whose tests cannot even be collected: each change would count as seen."""
    tests = sorted({name for group in GROUPS.values() for name in group.tests if _file(folder, name).exists()})
    command = [sys.executable, "-m", "pytest", "-q", "--collect-only", *tests]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if ran.returncode:
        raise SystemExit(f"the tests cannot be collected without a change:\n{ran.stdout[-500:]}{ran.stderr[-500:]}")


def tried(folder: Path, source: Path, text: str, group: Group, seconds: float) -> dict[str, Any]:
    """Run the tests on a changed file, and put it back: the first test that fails, or None."""
    environment = {**os.environ, "PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    if not group.compiled:
        environment["NUMBA_DISABLE_JIT"] = "1"
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-rfE"]
    tests = [name for name in group.tests if _file(folder, name).exists()]
    tests.sort(key=lambda name: source.stem not in name)  # the source's own tests first
    before, began = source.read_text(), time.perf_counter()

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

    source.write_text(text)
    try:
        ran = subprocess.Popen(
            [*command, *tests], cwd=folder, env=environment, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, preexec_fn=limited,
        )  # fmt: skip
        try:
            output, killed = ran.communicate(timeout=10 * seconds)[0], None
            if ran.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
                raise subprocess.TimeoutExpired(command, seconds)
            if ran.returncode:
                failed = re.search(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
                killed = failed[1] if failed else " ".join(output.split())[-120:]
        except subprocess.TimeoutExpired:
            killed = f"longer than {seconds:g} s"
        finally:
            if ran.poll() is None:
                os.killpg(ran.pid, signal.SIGKILL)
                ran.communicate()
    finally:
        source.write_text(before)
    return {"killed_by": killed, "seconds": round(time.perf_counter() - began, 1)}


def holds(row: dict[str, Any], text: str, folder: Path, group: Group) -> bool:
    """Whether a result is about this source; that no test saw it, also about these tests."""
    return row.get("about") == about(text, folder, group if row.get("killed_by") is None else None)


def about(text: str, folder: Path, group: Group | None) -> str:
    """The sha256 of a changed source, and of the tests of a group."""
    total = hashlib.sha256(text.encode())
    for name in group.tests if group else ():
        if _file(folder, name).exists():
            total.update(_file(folder, name).read_bytes())
    return total.hexdigest()[:16]


def table(rows: list[dict[str, Any]]) -> str:
    """The results in Markdown."""
    seen = sum(row["killed_by"] is not None for row in rows if "lost" not in row)
    late = sum(str(row.get("killed_by")).startswith("longer") for row in rows)
    lost = sum("lost" in row for row in rows)
    lines = [f"{seen} of {len(rows)} seen by a test ({late} by the time limit), {len(rows) - seen - lost} not"]
    lines += ["", "| group | function | from | to | seen by |", "|---|---|---|---|---|"]
    for row in rows:
        cells = [row["group"], row["function"], row["expression"], row["becomes"]]
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
    name = "-".join(["mutations", *(options.group or GROUPS)])
    folder = copied(ROOT, options.folder or Path(tempfile.gettempdir()) / name)
    collected(folder)
    known = every_place(folder)
    named = [Place(*(row[key] for key in Place._fields)) for row in before]
    wanted = named if options.again or options.survivors else filled(named, drawn(known), known)
    rows = {place: row for place, row in zip(named, before, strict=True) if place in wanted}
    for k, place in enumerate(wanted, 1):
        old = rows.get(place, {})
        skipped = place.group not in (options.group or GROUPS) or (options.survivors and old.get("killed_by"))
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
        tested = group if found["killed_by"] is None else None
        rows[place] = {**place._asdict(), **found, "about": about(text, folder, tested)}
        print(f"{k}/{len(wanted)} {' | '.join(map(str, place[:4]))}: {rows[place]['killed_by']}", flush=True)
        stored = json.loads(TABLE.read_text()) if TABLE.exists() else []  # by another process, of other groups
        kept = {Place(*(row[key] for key in Place._fields)): row for row in stored} | {place: rows[place]}
        TABLE.write_text(
            json.dumps([kept[each] for each in wanted if each in kept], indent=1, ensure_ascii=False) + "\n"
        )
    print(table([rows[each] for each in wanted if each in rows]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
