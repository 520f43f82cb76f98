"""Compares what this source computes with what a recorded source computed, bit for bit.

    python benchmarks/gates.py record           compute all cases, and write their digests into gates.json
    python benchmarks/gates.py                  compare, and print "equal" or the first difference of each gate
    python benchmarks/gates.py --only steps/aid     the cases whose names begin so; or --only time

The exit code is 1 if a value differs. gates.json holds digests of the cases and of the recorded source, and names the
machine. A digest tells no leaf, and bits differ between processors and between versions of libraries. So where a digest
or the machine differs, the recorded source computes the values again, on this machine. It is the source of the commit
that wrote gates.json, or the copy that `record` left in the user's cache. So gates.json may be part of the commit that
changes the values.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # compares this checkout, whichever is installed

import numpy as np  # noqa: E402
from gate_values import digest, first_difference, leaves  # noqa: E402

RECORD = Path(__file__).with_suffix(".json")
PLACES = ("usvlearn", "certify", "configs", "benchmarks", "tests/__init__.py", "tests/support")  # what a case may read
LIBRARIES = ("numpy", "numba", "scipy", "torch")
ABSENT = "absent"
TIME = "time"  # the gate that is printed and never fails


class Recorded(NamedTuple):
    """What gates.json holds."""

    source: str  # digest of the files in PLACES
    machine: dict[str, str]
    cases: dict[str, str]  # name -> digest, or ABSENT


def read(path: Path = RECORD) -> Recorded:
    if not path.exists():
        raise SystemExit(f"{path}: does not exist: run python benchmarks/gates.py record")
    return Recorded(**json.loads(path.read_text()))


def machine() -> dict[str, str]:
    """What bits depend on beside the source."""
    from pages import hardware  # which imports torch

    return {"processor": hardware(), "python": platform.python_version()} | {name: version(name) for name in LIBRARIES}


def source_files(folder: Path) -> list[Path]:
    """Files below PLACES, relative, in order; those that git ignores are left out where the folder is a checkout."""
    if (folder / ".git").exists():
        listed = git("ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *PLACES, folder=folder)
        files = {Path(name) for name in listed.decode().split("\0") if name and (folder / name).is_file()}
    else:
        every = (path for place in PLACES for path in [folder / place, *(folder / place).rglob("*")])
        files = {path.relative_to(folder) for path in every if path.is_file() and "__pycache__" not in path.parts}
    return sorted(files - {RECORD.relative_to(ROOT)})


def source_digest(folder: Path) -> str:
    sha = hashlib.sha256()
    for path in source_files(folder):
        content = (folder / path).read_bytes()
        sha.update(f"{path.as_posix()}\n{len(content)}\n".encode() + content)
    return sha.hexdigest()[:12]


def git(*arguments: str, folder: Path = ROOT) -> bytes:
    return subprocess.run(["git", "-C", folder, *arguments], capture_output=True, check=True).stdout


def cache() -> Path:
    """Where recorded sources are kept, beside usvlearn's compiled code."""
    from usvlearn.core.jit import folder

    return folder(ROOT / "usvlearn" / "core" / "jit.py").parent / "gates"


def keep(source: str) -> Path:
    """The recorded source as a folder: kept before, or out of the commit that wrote gates.json, or out of HEAD."""
    target = cache() / source
    if target.exists():
        return target
    with suppress(OSError, subprocess.CalledProcessError):  # no git, no repository, or a commit that lacks a folder
        for commit in (git("log", "-1", "--format=%H", "--", str(RECORD)).decode().strip(), "HEAD"):
            with tempfile.TemporaryDirectory() as temporary:
                with tarfile.open(fileobj=io.BytesIO(git("archive", commit or "HEAD", *PLACES))) as archive:
                    archive.extractall(temporary, filter="data")
                if source_digest(Path(temporary)) == source:
                    return stored(Path(temporary), target)
    raise SystemExit(
        f"gates.json: the commit that wrote it does not hold the recorded source {source}: fetch the whole history, or "
        "run python benchmarks/gates.py record in a checkout of the commit whose values are right"
    )


def stored(folder: Path, target: Path) -> Path:
    """Copy a source into the cache, completely or not at all."""
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        part = Path(tempfile.mkdtemp(dir=target.parent))
        for path in source_files(folder):
            (part / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(folder / path, part / path)
        part.rename(target)
    return target


def recorded_digests(recorded: Recorded, shared: Path) -> Mapping[str, str]:
    """The digests that the recorded source has on this machine."""
    if recorded.machine == machine():
        return recorded.cases
    tag = hashlib.sha256(json.dumps(machine()).encode()).hexdigest()[:12]
    path = cache() / f"{recorded.source}-{tag}.json"
    if not path.exists():
        print(f"gates.json is of another machine ({differing(recorded.machine)}): its source computes all cases here")
        run(keep(recorded.source), "record", "--to", path, "--shared", shared)
    return read(path).cases


def differing(other: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {value}" for name, value in other.items() if machine().get(name) != value)


def recorded_values(recorded: Recorded, names: Sequence[str], shared: Path) -> dict[str, dict[str, np.ndarray]]:
    """The leaves that the recorded source computes for these cases."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "values.npz"
        run(keep(recorded.source), "dump", path, *names, "--shared", shared)
        values: dict[str, dict[str, np.ndarray]] = {name: {} for name in names}
        with np.load(path) as archive:
            for entry in archive["entries"]:
                key, case, leaf = entry.split("\t", 2)
                values[case][leaf] = archive[key]
        return values


def run(source: Path, *arguments: str | Path) -> None:
    """gates.py of a recorded source."""
    environment = os.environ | {"PYTHONPATH": str(source)}
    subprocess.run([sys.executable, source / "benchmarks" / "gates.py", *arguments], env=environment, check=True)


def computed(names: Iterable[str] | None, shared: Path, prefixes: Sequence[str] = ("",)):
    """Yield the name and the leaves of each case, of those with a prefix if `names` is None; of an absent one None."""
    from gate_cases import cases  # which imports all of usvlearn

    every = cases(shared)
    wanted = [name for name in every if name.startswith(tuple(prefixes))] if names is None else names
    for name in wanted:
        if name in every:
            case = every[name]()
            yield name, None if case is None else leaves(case)


def record(path: Path, shared: Path) -> None:
    source = source_digest(ROOT)
    digests = {name: ABSENT if case is None else digest(case) for name, case in computed(None, shared)}
    if source_digest(ROOT) != source:
        raise SystemExit("gates.json: the source was changed while it was recorded: run it again")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(Recorded(source, machine(), digests)._asdict(), indent=1) + "\n")
    stored(ROOT, cache() / source)
    print(f"{len(digests)} cases of the source {source} are recorded in {path}")


def dump(path: Path, names: Sequence[str], shared: Path) -> None:
    """Write the leaves of some cases."""
    arrays, entries = {}, []
    for case, values in computed(names, shared):
        for leaf, array in (values or {}).items():
            key = f"a{len(entries)}"
            arrays[key] = array
            entries.append(f"{key}\t{case}\t{leaf}")
    np.savez(path, entries=np.array(entries), **arrays)


def compare(prefixes: Sequence[str], shared: Path) -> bool:
    """Print what differs; whether nothing does."""
    recorded = read()
    known, present, states = recorded_digests(recorded, shared), {}, {}
    for name, values in computed(None, shared, prefixes):
        code = ABSENT if values is None else digest(values)
        states[name] = "equal" if code == known.get(name) else ABSENT if values is None else "differs"
        if code == ABSENT or name not in known or known[name] == ABSENT:
            states[name] = ABSENT if code == ABSENT else "not recorded"
        elif states[name] == "differs":
            present[name] = values
    if unknown := [each for each in prefixes if not any(name.startswith(each) for name in (*known, *states))]:
        raise SystemExit(f"--only: found {', '.join(unknown)}, expected the beginning of a case, such as steps/aid")
    gone = [name for name in known if name.startswith(tuple(prefixes)) and name not in states]
    states |= dict.fromkeys(gone, "gone")
    before = recorded_values(recorded, list(present), shared) if present else {}
    for gate, names in groupby(sorted(states, key=lambda name: name.partition("/")[0]), lambda n: n.partition("/")[0]):
        told(gate, {name: states[name] for name in names}, before, present)
    return not present and not gone


def told(gate: str, states: Mapping[str, str], before: Mapping[str, Any], present: Mapping[str, Any]) -> None:
    """Print one gate: equal, or the first difference, with how many cases differ."""
    by = {state: [name for name, each in states.items() if each == state] for state in dict.fromkeys(states.values())}
    said = "DIFFERS" if {"differs", "gone"} & by.keys() else "equal" if "equal" in by else "not compared"
    counts = ", ".join(f"{len(names)} {state}" for state, names in by.items())
    print(f"{gate:13} {said} ({counts})")
    for state in (ABSENT, "not recorded", "gone"):
        if names := by.get(state):
            print(f"{'':13} {state}: {', '.join(names)}")
    for name in by.get("differs", [])[:1]:
        difference = first_difference(before[name], present[name])
        again = f"the recorded source computes the same here today: {name} is not repeatable, or its logs have changed"
        print(f"{'':13} {name}: {again if difference is None else difference}")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="compare", choices=["compare", "record", "dump"])
    parser.add_argument("names", nargs="*", help="of `dump`, which `compare` calls: a file and cases")
    parser.add_argument("--only", action="append", metavar="PREFIX", help="of the names of cases that are compared")
    parser.add_argument("--shared", type=Path, default=ROOT.parent / "shared", help="the folder with recorded logs")
    parser.add_argument("--to", type=Path, default=RECORD, help="where `record` writes")
    given = parser.parse_args()
    if given.what == "record":
        record(given.to, given.shared)
    elif given.what == "dump":
        dump(Path(given.names[0]), given.names[1:], given.shared)
    else:
        only = given.only or ["", TIME]
        cases = [each for each in only if each != TIME]
        good = not cases or compare(cases, given.shared)
        if TIME in only:
            from gate_time import time_ratios

            for line in time_ratios(keep(read().source)):
                print(f"{TIME:13} {line}", flush=True)
        sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
