"""Finds the logs that arguments name, their format, and all series that they hold.

The first bytes of a file tell its format, and its suffix where the bytes do not. Which tables are topics of one run,
the names of their columns tell, by the rules of `usvlearn.logs.formats.csv.topics`.
"""

from __future__ import annotations

import glob
import importlib
import os
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, reading
from usvlearn.logs.channels.series import Series, segments
from usvlearn.logs.formats.csv.boats import PHASES, VEHICLES, words_of
from usvlearn.logs.formats.csv.dialect import AUTO, find_dialect, split_unit
from usvlearn.logs.formats.csv.options import NAMED
from usvlearn.logs.formats.csv.packed import PACKED
from usvlearn.logs.formats.csv.rows import quaternions
from usvlearn.logs.formats.csv.topics import several_kinds, tables_of
from usvlearn.logs.formats.foreign import HEAD, explained, foreign
from usvlearn.logs.inspection.vocabulary import fit, names_side_alone, side

RECENT = 1e15, 4.1e15  # us since 1970, from 2001 to 2099: before a frame in a telemetry log of another suffix
BETWEEN = 1000.0  # s between two logs that are looked at as one
MOST_BYTES = 400e6  # of logs that are looked at; more of one boat tell no more
ROW = re.compile(rb"^-?\d+(\.\d+)?\s+\S+\s+\S+\s+\S")  # of a MOOS log
DATED = re.compile(r"(?<!\d)(?:20\d\d\D?[01]\d|[0-3]?\d\D[01]?\d\D20\d\d)")  # the name of a log, after that of its boat
SYNCHRONOUS = re.compile(rb"^\S+\s+([-+.\d][-+.\de]*|nan)\s", re.IGNORECASE)  # row of a .slog, which is a table
SHOWN_NAMES = 6  # names of files


@dataclass(frozen=True)
class Format:
    """A format of logs, and the reader of it."""

    name: str  # for a person
    module: str
    reader: str
    suffixes: tuple[str, ...]  # by which a folder is searched
    example: str  # the configuration in configs/data that reads such logs
    begins: tuple[bytes, ...] = ()  # bytes at the start of such a file
    looks: Callable[[bytes, str], bool] = lambda head, suffix: False  # likewise, where no fixed bytes begin it

    def fits(self, head: bytes, suffix: str) -> bool:
        return head.startswith(self.begins) if self.begins else self.looks(head, suffix)

    def open(self, path: Path, boat: str | None, beside: Sequence[Path]) -> tuple[Any, list[str]]:
        """The reader, with the options that this file needs, and what is unsure about them."""
        reader = getattr(importlib.import_module(self.module), self.reader)
        return reader.of_file(path, boat, beside) if hasattr(reader, "of_file") else (reader(), [])


def _is_moos(head: bytes, suffix: str) -> bool:
    lines = [line for line in head.splitlines()[:-1] if line.strip()]
    rows = [line for line in lines if not line.startswith(b"%%")]
    if b"\0" in head or not lines or (rows and all(map(SYNCHRONOUS.match, rows))):
        return False
    alike = sum(bool(ROW.match(line)) for line in rows) >= 0.8 * len(rows)
    return lines[0].startswith(b"%%") or (suffix == ".alog" and alike)


def _is_text(head: bytes, suffix: str) -> bool:
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):  # UTF-16
        return True
    control = sum(byte < 32 and byte not in b"\t\n\r\f\x1b" for byte in head)
    return bool(head.strip()) and control <= 0.01 * len(head)


def _is_telemetry(head: bytes, suffix: str) -> bool:
    known = suffix == ".tlog" or RECENT[0] < int.from_bytes(head[:8]) < RECENT[1]
    return known and len(head) > 8 and head[8] in (0xFE, 0xFD)


TABLES = (".csv", ".txt", ".tsv", ".slog", *PACKED)
TABLE = Format("tables", "usvlearn.logs.formats.csv.table", "Table", TABLES, "csv", looks=_is_text)
FORMATS = (
    Format("ROS 1", "usvlearn.logs.formats.ros.rosbag", "Rosbag", (".bag", ".active"), "rosbag", (b"#ROSBAG V2.0",)),
    Format("ROS 2 (MCAP)", "usvlearn.logs.formats.ros.rosbag", "Rosbag", (".mcap",), "rosbag", (b"\x89MCAP",)),
    Format("ROS 2 (SQLite)", "usvlearn.logs.formats.ros.rosbag", "Rosbag", (".db3",), "rosbag",
           (b"SQLite format 3\0",)),
    Format("PX4 ULog", "usvlearn.logs.formats.px4.ulog", "Ulog", (".ulg",), "ulog", (b"ULog\x01\x12\x35",)),
    Format("ArduPilot DataFlash", "usvlearn.logs.formats.ardupilot.dataflash", "DataFlash", (".bin",), "ardupilot",
           (b"\xa3\x95",)),
    Format("MAVLink telemetry", "usvlearn.logs.formats.ardupilot.tlog", "Tlog", (".tlog",), "tlog",
           looks=_is_telemetry),
    Format("MOOS", "usvlearn.logs.formats.moos.alog", "Alog", (".alog",), "alog", looks=_is_moos),
    TABLE,
)  # fmt: skip
ZSTD = ".zstd"  # after the suffix of a file that ROS 2 compressed
BAGS = (".db3", ".mcap", ZSTD)  # of ROS 2, in a folder with metadata.yaml
SHOWN = 3  # files that are left out, each with its reason
NOTES = (".txt", ".xlsx", ".parquet", ".mat", ".npz")  # of a table, or of what lies beside logs
SUFFIXES = tuple(suffix for each in FORMATS for suffix in each.suffixes)


class Logs(NamedTuple):
    """What was found at the given paths."""

    format: Format
    reader: Any  # as it is to be configured
    path: str  # data.path that finds these logs
    name: str  # of the boat, as far as the paths tell
    files: tuple[Path, ...]
    surveyed: list[list[Series]]  # of each log that was looked at
    notes: tuple[str, ...]  # what was left out, and why
    doubts: tuple[str, ...]  # about the reader's options; each begins with the option
    joined: str = ""  # how the tables of a folder belong together, and why


def find_format(path: Path) -> Format:
    """The format of a file; a LogFormatError if it has none that is known."""
    inside = sorted(each for each in path.iterdir() if each.suffix.lower() in BAGS) if path.is_dir() else [path]
    with inside[0].open("rb") as file:
        head = file.read(HEAD)
    if not head.strip():
        raise LogFormatError(f"{path}: expected a log, found an empty file: remove it")
    suffix = inside[0].suffix.lower()
    inner = Path(inside[0].stem).suffix if path.is_dir() and suffix == ZSTD else None
    if packed := next((each for each in FORMATS if inner in each.suffixes), None):
        return packed
    if suffix == ".slog" or (inside[0].name.lower().endswith(PACKED) and not _is_text(head, suffix)):
        return TABLE
    known = foreign(inside[0], head, surely=True)
    if found := next((each for each in FORMATS if each.fits(head, suffix) and (each.begins or not known)), None):
        return found
    known = known or "found binary data of no known format: give a log that a boat recorded"
    raise LogFormatError(f"{path}: expected a log ({' '.join(dict.fromkeys(SUFFIXES))}), {known}")


def open_logs(given: Sequence[str], only: str | None = None) -> Logs:
    """Find the logs that arguments name, and list all their series; of a table of several boats those of `only`.

    A ConfigError if no log is there; a LogFormatError if they have several formats, or none can be read.
    """
    files = list(dict.fromkeys(file for each in given for file in _files(each)))
    by_format: dict[str, list[Path]] = {}
    formats, refused = {}, []
    for file in files:
        try:
            which = find_format(file)
        except LogFormatError as error:
            refused.append(error)
            continue
        formats[which.name] = which
        by_format.setdefault(which.name, []).append(file)
    if not by_format:
        raise refused[0]
    if len(by_format) > 1:
        counts = ", ".join(f"{len(each)} of {name} ({each[0].name})" for name, each in by_format.items())
        raise LogFormatError(f"{given[0]}: expected logs of one format, found {counts}: give those of one format")
    ((name, logs),) = by_format.items()
    logs, joined = joined_tables(logs) if formats[name] is TABLE else (logs, "")
    path = _common_path(given, logs)
    whole = Path(path) if joined and Path(path).is_dir() else logs[0].parent
    boat = Path(path).stem if Path(path).is_file() else whole.resolve().name
    reader, surveyed, notes, doubts = _survey(formats[name], logs, only)
    notes += [f"left out: {error}" for error in refused[:SHOWN]]
    notes += [f"left out: {len(refused) - SHOWN} more files of no known format"] * (len(refused) > SHOWN)
    return Logs(formats[name], reader, path, boat, tuple(logs), surveyed, tuple(notes), tuple(doubts), joined)


def _files(given: str) -> list[Path]:
    path = Path(os.path.expanduser(given))
    if path.is_file():
        return [path]
    if path.is_dir():
        inside = [file for file in path.rglob("*") if file.name.lower().endswith((*SUFFIXES, ZSTD)) and file.is_file()]
        inside = [file for file in inside if not any(part[0] == "." for part in file.relative_to(path).parts)]
        inside = [file for file in inside if file.suffix.lower() not in NOTES] or inside
        if not inside:
            what = next((f"{file.name}, {known}" for file in sorted(path.rglob("*")) if (known := foreign(file))), "")
            what = what.replace("found ", "", 1) or "none in it: give another folder"
            raise ConfigError(f"{given}: expected a folder of logs ({' '.join(dict.fromkeys(SUFFIXES))}), found {what}")
        return sorted({_bag_of(file) for file in inside})
    if path.exists():
        raise ConfigError(f"{given}: found a device or a pipe, expected a log or a folder of logs")
    if found := sorted(Path(name) for name in glob.glob(str(path), recursive=True) if os.path.isfile(name)):
        return found
    raise ConfigError(f"{given}: does not exist: give a log, or a folder of logs")


def _bag_of(file: Path) -> Path:
    """The folder of a ROS 2 bag, which is one log, in place of a file in it."""
    return file.parent if file.suffix.lower() in BAGS and (file.parent / "metadata.yaml").is_file() else file


def bytes_of(log: Path) -> int:
    """The size of a log, which may be a folder."""
    return sum(each.stat().st_size for each in log.rglob("*") if each.is_file()) if log.is_dir() else log.stat().st_size


def _common_path(given: Sequence[str], files: Sequence[Path]) -> str:
    """One path or pattern that finds these files."""
    if len(files) == 1 and files[0].is_dir():
        return str(files[0].absolute())
    if len(given) == 1:
        only = Path(given[0]).expanduser().absolute()
        notes = only.is_dir() and all(file.suffix.lower() in NOTES for file in files)
        return f"{glob.escape(str(only))}/**/*{files[0].suffix}" if notes else str(only)
    absolute = [str(file.absolute()) for file in files]
    start, end = _common(absolute), _common([each[::-1] for each in absolute])[::-1]
    folder = Path(os.path.commonpath(absolute))
    pattern, inside = f"{glob.escape(start)}*{glob.escape(end)}", map(str, folder.rglob(f"*{files[0].suffix}"))
    for path, matches in ((pattern, glob.glob(pattern)), (str(folder), inside)):
        if sorted(matches) == sorted(absolute):
            return path
    raise ConfigError(
        f"{given[0]} and {len(given) - 1} more: expected one folder, or all logs that a pattern finds: move these logs "
        "to a folder of their own"
    )


def boats_of(files: Sequence[Path]) -> dict[str, str]:
    """boat -> pattern of its logs, where the logs of one folder, or its folders, have several names; else {}."""
    folder = Path(os.path.commonpath([file.parent for file in files]))
    flat = len({file.parent for file in files}) == 1
    groups: dict[str, list[str]] = {}
    for file in files:
        name = file.stem if flat else file.parent.relative_to(folder).as_posix().split("/")[0].strip(".")
        numbered = not flat and words_of(name) & VEHICLES and re.fullmatch(r"\D+\d{1,2}", name)
        groups.setdefault(name if numbered else re.sub(r"[\W_]*\d.*$", "", name), []).append(name)
    several = len(groups) > 1 and "" not in groups and not any((words_of(each) - {"log"}) & PHASES for each in groups)
    if not several or (flat and min(map(len, groups.values())) < 2 and not all(DATED.search(x.stem) for x in files)):
        return {}
    start, below = glob.escape(str(folder)), "" if flat else "/**"
    ends = {name: "*" if flat or len({*names}) > 1 else "" for name, names in groups.items()}
    return {name: f"{start}/{glob.escape(_common(names))}{ends[name]}{below}" for name, names in groups.items()}


def _common(texts: Sequence[str]) -> str:
    """What all texts begin with."""
    first, last = min(texts), max(texts)
    return first[: next((k for k, (a, b) in enumerate(zip(first, last, strict=False)) if a != b), len(first))]


def _survey(
    which: Format, files: Sequence[Path], boat: str | None
) -> tuple[Any, list[list[Series]], list[str], list[str]]:
    """The reader of the first log that can be read, the series of each log, and notes and doubts."""
    reader, error, size = None, None, 0
    surveyed, notes, doubts = list[list[Series]](), list[str](), list[str]()
    for number, file in enumerate(files):
        if size > MOST_BYTES:
            notes.append(f"The first {number} of {len(files)} logs were looked at.")
            break
        size += bytes_of(file)
        try:
            with reading(file), warnings.catch_warnings(record=True) as sentence:
                warnings.simplefilter("always")
                beside = files if reader is None else ()
                opened, doubts = which.open(file, boat, files) if reader is None else (reader, doubts)
                series = opened.survey(file)
            notes += [text for each in sentence if (text := str(each.message)) not in notes]
            if not any(np.isfinite(each.value).any() for each in series):
                why = "; ".join(str(each.message).removeprefix(f"{file}: ") for each in sentence)
                why = why or "give a log with the commands and the motion of the boat"
                raise LogFormatError(f"{file}: expected numbers, found none in this log: {why}")
        except LogFormatError as raised:
            wrong = explained(file, raised)
            error = error or wrong
            notes.append(f"left out: {wrong}")
            continue
        reader = opened
        parts, jumps = segments(series)
        surveyed += parts
        if doubt := getattr(opened, "doubt", None):
            doubts += filter(None, [doubt(file, [place for place, _ in jumps], beside)])
    if reader is None:
        raise error or LogFormatError(f"{files[0]}: no log can be read")
    return reader, surveyed, notes, doubts


def joined(surveyed: Iterable[Sequence[Series]]) -> list[Series]:
    """The series of several logs as one log; the logs follow each other with a pause between.

    A name that is not in every log is shortened to the pattern `*name`, if that finds one series in each.
    """
    logs = [list(each) for each in surveyed]
    names = _patterns(logs)
    parts: dict[tuple[str, str | None], list[Series]] = {}
    begin = 0.0
    for log in logs:
        stamps = [each.time[np.isfinite(each.time)] for each in log]
        low = min((time.min() for time in stamps if len(time)), default=0.0)
        high = max((time.max() for time in stamps if len(time)), default=0.0)
        for each in log:
            name = names.get(each.name, each.name)
            parts.setdefault((name, each.field), []).append(each._replace(name=name, time=each.time - low + begin))
        begin += high - low + BETWEEN
    merged = []
    for several in parts.values():
        whole: Any = {key: np.concatenate([getattr(one, key) for one in several]) for key in ("time", "value", "order")}
        merged.append(several[0]._replace(**whole))
    return merged


def _patterns(logs: Sequence[Sequence[Series]]) -> dict[str, str]:
    """name -> the pattern that finds it, for names that are not in every log."""
    have = [{each.name for each in log} for log in logs]
    everywhere = set.intersection(*have) if have else set()
    patterns = {}
    for name in set().union(*have) - everywhere:
        tail = name.rsplit("/", 1)[-1]
        matches = [[each for each in names if each.endswith(tail)] for names in have]
        if "/" in name and all(len(each) == 1 for each in matches):
            patterns[name] = f"*{tail}"
    return patterns


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
        if others := ", ".join(each.name for each in rest[:SHOWN_NAMES]):
            what = f"{folder}: expected all tables of a run, whose columns differ, found {len(inside)} given and "
            raise LogFormatError(f"{what}{others} not: give the folder, or move these tables to one of their own")
        logs.append(folder)
        names = ", ".join(sorted(each.stem for each in columns)[:SHOWN_NAMES])
        names += ", …" if len(columns) > SHOWN_NAMES else ""
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
    columns = {}
    for file in files:
        try:
            names = find_dialect(file, AUTO, AUTO, AUTO, AUTO, AUTO).names
        except LogFormatError:  # the survey says so
            continue
        columns[file] = [name for name in (*names, *quaternions(names)) if split_unit(name)[0].lower() not in NAMED]
    return {file: names for file, names in columns.items() if names}
