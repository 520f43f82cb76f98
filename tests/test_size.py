"""No room of the repository grows: its lines, docstrings included, stay at or below a ceiling, and ceilings only fall.

`python tests/test_size.py` prints rooms, lines, ceilings and aims; `--lower` lowers the ceilings to the present lines.
"""

import os
import re
import sys
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]


class Room(NamedTuple):
    """Files whose lines are counted together."""

    ceiling: int
    aim: int | None
    paths: tuple[str, ...]  # of files, or of folders


PRODUCT = {
    "logs": Room(13_908, 12_600, ("usvlearn/logs/",)),
    "estimators": Room(9_837, 9_600, ("usvlearn/estimators/",)),
    "certify": Room(5_992, 6_500, ("certify/",)),
    "live": Room(6_560, 5_900, ("usvlearn/live/",)),
    "model": Room(6_186, 5_300, ("usvlearn/model/",)),
    "report": Room(3_980, 3_500, ("usvlearn/report/",)),
    "engine": Room(3_765, 3_200, ("usvlearn/engine/",)),
    "cli": Room(2_897, 2_400, ("usvlearn/cli/", "usvlearn/composition/", "train.py", "evaluate.py")),
    "runs": Room(2_189, 2_100, ("usvlearn/runs/",)),
    "sweeps": Room(2_074, 1_800, ("usvlearn/sweeps/",)),
    "core, errors": Room(2_750, 2_500, ("usvlearn/core/", "usvlearn/errors.py")),
    "simulate": Room(1_847, 1_800, ("usvlearn/simulate/",)),
    "evaluation": Room(1_426, 1_600, ("usvlearn/evaluation/",)),
    "display, top": Room(
        1_573,
        1_200,
        ("usvlearn/display/", "usvlearn/_", "usvlearn/api.py", "usvlearn/learned.py", "usvlearn/testing.py"),
    ),
}
OTHERS = {
    "tests": Room(45_173, 38_000, ("tests/",)),
    "benchmarks": Room(5_958, 5_000, ("benchmarks/",)),
    "building": Room(877, None, (".ci/", "aboard/", "docs/")),
    "pages": Room(8_586, None, ("README.md", "CONTRIBUTING.md", "aboard/README.md", "docs/")),
}
ROOMS = PRODUCT | OTHERS
NOT_COUNTED = "CHANGELOG.md", "docs/adr/", "docs/tutorials/"  # records that only grow, and what the site's build writes
IGNORED = {line.strip("/") for line in (ROOT / ".gitignore").read_text().splitlines()}


def files() -> list[str]:
    """The sources and pages of a checkout, without what git ignores and virtual environments."""
    paths = []
    for folder, folders, names in os.walk(ROOT):
        place = Path(folder)
        walked = [each for each in folders if (each not in IGNORED and not each.startswith(".")) or each == ".ci"]
        folders[:] = [each for each in walked if not (place / each / "pyvenv.cfg").exists()]
        paths += [(place / name).relative_to(ROOT).as_posix() for name in names if name.endswith((".py", ".md"))]
    return [path for path in paths if not path.startswith(NOT_COUNTED)]


def room_of(path: str) -> str | None:
    """The room of a file; only pages have files of Markdown."""
    rooms = {"pages"} if path.endswith(".md") else ROOMS.keys() - {"pages"}
    return next((name for name in rooms if path.startswith(ROOMS[name].paths)), None)


@cache
def counts() -> Counter:
    """The lines of each room; those of files in no room count for None."""
    lines: Counter = Counter()
    for path in files():
        lines[room_of(path)] += (ROOT / path).read_bytes().count(b"\n")
    return lines


@pytest.mark.parametrize("name", ROOMS)
def test_no_room_is_above_its_ceiling(name):
    assert counts()[name] <= ROOMS[name].ceiling, (
        f"{name}: found {counts()[name]} lines, expected at most {ROOMS[name].ceiling}; shorten it, or raise its "
        "ceiling in tests/test_size.py by hand, in the same commit as an ADR (docs/adr) that gives the reason"
    )


def test_each_file_is_in_a_room():
    lost = [path for path in files() if room_of(path) is None]
    assert room_of("usvlearn/new/room.py") is room_of("new.md") is None
    assert not lost, f"in no room of tests/test_size.py: {lost}; add each to the paths of a room"


def lowered(source: str, lines: Counter) -> str:
    """The source of this file with ceilings that are at most the present lines."""

    def lower(match: re.Match) -> str:
        return f"{match[1]}{min(int(match[3].replace('_', '')), lines[match[2]]):_}"

    return re.sub(r'(?m)^(    "(.+)": Room\()([\d_]+)', lower, source)


def test_a_ceiling_is_lowered_and_never_raised():
    source = (
        '    "logs": Room(13_245, 12_600, ("usvlearn/logs/",)),\n    "cli": Room(900, 2_400, ("usvlearn/cli/",)),\n'
    )
    assert lowered(source, Counter({"logs": 12_999, "cli": 1_000})) == source.replace("13_245", "12_999")


def main() -> None:
    """Print the table, and lower the ceilings where this is asked for."""
    now, rooms = counts(), ROOMS
    if "--lower" in sys.argv:
        Path(__file__).write_text(lowered(Path(__file__).read_text(), now))
        rooms = {name: each._replace(ceiling=min(each.ceiling, now[name])) for name, each in ROOMS.items()}
    rows = [(name, now[name], each.ceiling, each.aim) for name, each in rooms.items()]
    rows.insert(len(PRODUCT), ("product", *(sum(row[k] for row in rows[: len(PRODUCT)]) for k in (1, 2, 3))))
    print(f"{'room':14}{'lines':>9}{'ceiling':>9}{'aim':>9}")
    for name, lines, ceiling, aim in rows:
        print(f"{name:14}{lines:9,}{ceiling:9,}{'–' if aim is None else f'{aim:,}':>9}")


if __name__ == "__main__":
    main()
