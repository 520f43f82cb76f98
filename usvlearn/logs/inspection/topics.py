"""Which tables are topics of one run, as their names tell before anybody has said what they mean.

The rules are those of `usvlearn.logs.formats.csv.topics`. Which file has all channels, the names of its columns tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.csv.dialect import AUTO, find_dialect, split_unit
from usvlearn.logs.formats.csv.options import NAMED
from usvlearn.logs.formats.csv.rows import quaternions
from usvlearn.logs.formats.csv.topics import several_kinds, tables_of
from usvlearn.logs.inspection.vocabulary import fit, names_side_alone, side

SHOWN = 6  # names of files


def joined_tables(files: Sequence[Path]) -> tuple[list[Path], str]:
    """The logs among some tables, where a folder of topics is one; and what was decided, and why, or "".

    A LogFormatError if the files are topics, and others of their folder are not among them.
    """
    folders: dict[Path, list[Path]] = {}
    for file in files:
        folders.setdefault(file.parent, []).append(file)
    logs: list[Path] = []
    sentence = ""
    for folder, inside in folders.items():
        if len(inside) < 2:
            logs += inside
            continue
        columns = _columns(inside)
        whole = next((file for file, names in columns.items() if names_all(names)), None)
        differ = several_kinds(list(columns.values()))
        if whole is not None or not differ:
            logs += inside
            why = f"{whole.name} has all channels" if whole and differ else "they have the same columns"
            sentence = sentence or f"Each file is a run: {why}."
            continue
        rest = [each for each in tables_of(folder) if each not in inside and each.stat().st_size]
        if others := ", ".join(each.name for each in rest[:SHOWN]):
            told = f"{folder}: expected all tables of a run, whose columns differ, found {len(inside)} given and "
            raise LogFormatError(f"{told}{others} not: give the folder, or move these tables to one of their own")
        logs.append(folder)
        names = ", ".join(sorted(each.stem for each in columns)[:SHOWN])
        names += ", …" if len(columns) > SHOWN else ""
        sentence = f"The {len(columns)} tables of a folder are one run, joined by time ({names})"
        sentence += ": none has all channels."
    return logs, sentence


def names_all(columns: Sequence[str]) -> bool:
    """Whether the names of columns tell commands, a heading and a speed, or a position in place of it."""
    commands = [name for name in columns if fit("command", name) >= 1 or names_side_alone(name)]
    sides = {side(name) for name in commands}
    driven = {"left", "right"} <= sides or (commands and any(fit("rudder", name) >= 1 for name in columns))
    moves = any(fit(role, name) >= 1 for role in ("surge", "latitude", "velocity_north", "north") for name in columns)
    return bool(driven) and moves and any(fit("heading", name) >= 1 for name in columns)


def _columns(files: Sequence[Path]) -> dict[Path, list[str]]:
    """The columns of each file that is a table, without stamps that are called so; only its first lines are read."""
    found = {}
    for file in files:
        try:
            names = find_dialect(file, AUTO, AUTO, AUTO, AUTO, AUTO).names
        except LogFormatError:  # the survey says so
            continue
        found[file] = [name for name in (*names, *quaternions(names)) if split_unit(name)[0].lower() not in NAMED]
    return {file: names for file, names in found.items() if names}
