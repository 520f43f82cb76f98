"""Find the logs that a path names, and read each into a Recording."""

from __future__ import annotations

import difflib
import glob
import itertools
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from usvlearn.core.activity import doing
from usvlearn.errors import ConfigError, LogFormatError, did_you_mean, printable, reading, under
from usvlearn.logs.alignment.mixing import PER_NAME, SOURCE_KEYS, Mix, listed, mixed, parts_of
from usvlearn.logs.channels.channel import (
    AUTO,
    AUXILIARY,
    CHANNELS,
    COMMANDS,
    FORCES,
    OWN_UNITS,
    REQUIRED,
    SURGE,
    Channel,
    Recording,
    Source,
)
from usvlearn.logs.channels.derived_surge import PAIRS_TOLD, derived_surge, pair_of
from usvlearn.logs.channels.repeated_values import settle_period
from usvlearn.logs.channels.series import OtherBoats, Reader, segments
from usvlearn.logs.formats.foreign import explained


def read_recordings(
    path: str | os.PathLike | Mapping[str, str | os.PathLike],
    reader: Reader,
    channels: Mapping[str, Source | Mix | Mapping | None],
    boat: str | None = None,
    boat_column: str | None = None,
) -> list[Recording]:
    """Read all logs of one boat, or of several.

    Runs are named by their path below the given folder, without suffix, and sorted so that run_2 comes before run_10.
    If there are several logs, one that cannot be read is left out with a warning.

    Args:
        path: a log; a folder, with all logs below it; a pattern such as `logs/*/run_?.csv`; or boat -> path.
        reader: reads one log.
        channels: channel -> a Source or its arguments; None, or a name of None, means not logged. A command may have
            several names (`usvlearn.logs.alignment.mixing`). Without a surge, it is computed from other channels.
        boat: the boat's name; default the name of the log or folder, without suffix.
        boat_column: of tables, the column that tells which boat a row is of; then `boat` chooses one of these boats.

    Raises:
        ConfigError: the path finds no log, or the channels are not declared as expected.
        LogFormatError: no log can be read as declared; the message is that of the first log.
    """
    if not hasattr(reader, "read"):
        raise ConfigError(f"data.reader: found {reader!r}, expected a reader such as Table or Rosbag")
    if isinstance(path, Mapping):
        if boat is not None or not path:
            text = f"boat {boat!r} beside a path per boat" if path else "no boat"
            raise ConfigError(f"data.path: found {text}, expected BOAT: FILE entries that name the boats")
        each_of = (read_recordings(each, reader, channels, str(name), boat_column) for name, each in path.items())
        return list(itertools.chain.from_iterable(each_of))
    sources = sources_of(channels)
    root, files = _find(path, reader, [source.name for source in parts_of(_needed(sources)).values()])
    if boat_column is not None:
        if (boats_in := getattr(reader, "boats", None)) is None:
            raise ConfigError(f"data.boat_column: found {boat_column!r}, expected none: it is for tables (data=csv)")
        boats = {name: each for file in files for name, each in boats_in(file, boat_column).items()}
        if boat is not None and (boat := str(boat)) not in boats:  # MMSI are numbers in YAML
            raise ConfigError(f"data.boat: found {boat!r}, expected one of {', '.join(boats)}, as {boat_column!r} has")
        chosen = boats if boat is None else [boat]
        return [each for name in chosen for each in read_recordings(path, boats[name], channels, name)]
    if boat is None:
        boat = _run(files[0], files[0].parent) if files == [Path(path).expanduser()] else printable(root.resolve().name)
    recordings, unread = [], dict[Path, LogFormatError]()
    for number, file in enumerate(files, 1):
        doing(f"reading {file.name}" + (f", {number} of {len(files)}" if len(files) > 1 else ""))
        try:
            if file.stat().st_size == 0:
                raise LogFormatError(f"{file}: expected a log, found an empty file: remove it")
            recordings += recordings_of(file, reader, sources, str(boat), _run(file, root))
        except OSError as error:
            why = f"{file}: expected a readable file, found: {error.strerror or error}: fix its permissions"
            unread[file] = LogFormatError(why)
        except LogFormatError as error:
            unread[file] = explained(file, error)
    if not recordings:
        raise next(iter(unread.values()))
    if refuse := getattr(reader, "refuse_several", None):
        refuse([each for each in files if each not in unread])
    for each in unread.values():
        if not isinstance(each, OtherBoats):
            warnings.warn(f"log left out: {each}", stacklevel=2)
    if SURGE not in sources:
        pair = " and ".join(pair_of(sources) or ())
        warnings.warn(f"{boat}: no speed is configured: the surge is computed from {pair}", stacklevel=2)
    return settle_period(str(boat), recordings)


def recordings_of(
    log: Path, reader: Reader, sources: Mapping[str, Source | Mix], boat: str, run: str
) -> list[Recording]:
    """One log as its runs: each jump of its clock begins one. A surge is computed where there is none."""
    read, dropped = _channels(log, reader, sources)
    parts, jumps = segments(read.values())
    complete = [{name: each for name, each in zip(read, part, strict=True) if len(each.time)} for part in parts]
    runs: list[Recording] = []
    for channels in [each for each in complete if _needed(sources).keys() <= each.keys()] or [read]:
        lost = {name: dict(causes) for name, causes in dropped.items()} if not runs else {}
        if SURGE not in channels:
            channels[SURGE], lost[SURGE] = derived_surge(str(log), channels)
        runs.append(Recording(boat, f"{run}-part{len(runs) + 1}" if runs else run, channels, lost))
    if jumps:
        where = ", ".join(f"{abs(by):.4g} s at {place}" for place, by in jumps[:5]) + (", …" if len(jumps) > 5 else "")
        warnings.warn(
            f"{log}: the stamps jump {'ahead' if jumps[0][1] < 0 else 'back'}, as where a logger starts anew "
            f"or its clock is set, by {where} (line or message): a new run begins there, so there are {len(runs)}",
            stacklevel=2,
        )
    return runs


def _run(log: Path, root: Path) -> str:
    """The name of a run: its path below the root, without the suffix that a file has."""
    return printable((log if log.is_dir() else log.with_suffix("")).relative_to(root).as_posix())


def _channels(
    file: Path, reader: Reader, sources: Mapping[str, Source | Mix]
) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
    """The channels of a log, without those that only a track needs if one of these is missing."""
    try:
        with reading(file):
            contents = reader.read(file, parts_of(sources))
        return mixed(sources, *contents)
    except LogFormatError as error:
        needed = _needed(sources)
        if len(needed) == len(sources):
            raise
        with reading(file):
            contents = reader.read(file, parts_of(needed))
        warnings.warn(f"no track: {error}", stacklevel=2)
        return mixed(needed, *contents)


def _needed(sources: Mapping[str, Source | Mix]) -> dict[str, Source | Mix]:
    """The channels without those that only a track needs."""
    needed = {*CHANNELS, *(() if SURGE in sources else pair_of(sources) or ())}
    return {name: source for name, source in sources.items() if name in needed}


def _find(path: str | os.PathLike, reader: Reader, names: Sequence[str]) -> tuple[Path, list[Path]]:
    """The folder relative to which runs are named, and the logs in natural order."""
    suffixes, marker = reader.suffixes, getattr(reader, "marker", None)
    if path is None or str(path) in ("", "???"):
        raise ConfigError("data.path is not set: set data.path=FILE, a folder of logs, or a pattern")
    if not isinstance(path, str | os.PathLike):
        raise ConfigError(f"data.path: found {path!r}, expected a file, a folder, a pattern or BOAT: FILE entries")
    text = os.path.expanduser(os.fspath(path))
    here = Path(text)
    if here.is_file():
        return here.parent, [here]
    endings = " or ".join(suffixes)
    if here.is_dir():
        if _is_log(here, marker):
            return here.parent, [here]
        root, pattern = here, os.path.join(glob.escape(text), "**")
    elif glob.has_magic(text):
        root = Path(*itertools.takewhile(lambda part: not glob.has_magic(part), here.parts))
        pattern = text
    else:
        if here.exists():
            raise ConfigError(
                f"data.path: found {text!r}, which is a device or a pipe: set it to a folder or log ({endings})"
            )
        beside = os.listdir(here.parent) if here.parent.is_dir() else []
        close = difflib.get_close_matches(here.name, beside, n=1)
        hint = f"did you mean {here.parent / close[0]}?" if close else f"set it to a folder or log ({endings})"
        raise ConfigError(f"data.path: found {text!r}, but {here.absolute()} does not exist: {hint}")
    found = [Path(name) for name in glob.glob(pattern, recursive=True) if os.path.isfile(name)]
    files = [file for file in found if file.name.lower().endswith(suffixes)]
    if marker and here.is_dir():
        logs = {folder for folder in {file.parent for file in files} if _is_log(folder, marker)}
        files = [*(file for file in files if file.parent not in logs), *logs]
    if here.is_dir() and (is_log := getattr(reader, "is_log", None)):
        folders: dict[Path, list[Path]] = {}
        for file in files:
            folders.setdefault(file.parent, []).append(file)
        logs = {folder for folder, inside in folders.items() if is_log(folder, inside, names)}
        files = [*(file for file in files if file.parent not in logs), *logs]
        root = here.parent if here in logs else root
    if not files and found and not here.is_dir():
        files = found  # the pattern names another suffix
    if not files:
        raise ConfigError(
            f"data.path: expected logs ({endings}) in {text!r}, found none among its {len(found)} files: "
            "set data.path to a log, or choose the data option that fits these files"
        )
    return root, sorted(files, key=lambda file: _natural(file.relative_to(root)))


def _is_log(folder: Path, marker: tuple[str, bytes] | None) -> bool:
    """Whether a folder as a whole is a log."""
    if marker is None or not (folder / marker[0]).is_file():
        return False
    with (folder / marker[0]).open("rb") as file:
        return marker[1] in file.read(1 << 16)


def _natural(path: Path) -> list[list]:
    """A sort key in which run_2 comes before run_10."""
    parts = [re.split(r"(\d+)", part) for part in path.parts]
    return [[int(piece) if place % 2 else piece for place, piece in enumerate(part)] for part in parts]


def sources_of(channels: Mapping[str, Source | Mix | Mapping | None]) -> dict[str, Source | Mix]:
    """The channels that are logged, from their declarations, as of `read_recordings`.

    A ConfigError if a channel is unknown, has an illegal option, or is missing.
    """
    known = (*CHANNELS, *AUXILIARY)
    for name in channels:
        if name not in known:
            hint = did_you_mean(name, known)
            raise ConfigError(f"data.channels: found {name!r}, expected channels among {', '.join(known)}{hint}")
    read = {name: _source(name, channels[name] if name in channels else None) for name in known}
    sources = {name: source for name, source in read.items() if source is not None}
    for name in REQUIRED:
        if name not in sources and (name != SURGE or pair_of(sources) is None):
            more = f", or {PAIRS_TOLD}" if name == SURGE else ""
            raise ConfigError(
                f"data.channels: found no {name}, expected {', '.join(REQUIRED)}: set data.channels.{name}.name{more}"
            )
    return sources


def _source(channel: str, given: Source | Mix | Mapping | None) -> Source | Mix | None:
    key = f"data.channels.{channel}"
    if isinstance(given, Mapping):
        given = _described(channel, given, key)
    elif given is not None and not isinstance(given, Source | Mix):
        raise ConfigError(f"{key}: found {given!r}, expected {{name: ..., unit: ...}}")
    for part in given.parts if isinstance(given, Mix) else [given] if given else []:
        _check_unit(key, channel, part.unit)
        if part.unit in FORCES[::2] and abs(part.span) == 1:
            raise ConfigError(
                f"{key}.span: found {part.span:g} for {printable(part.name)!r} in {part.unit}, expected the greatest "
                "one: a command is a share of it"
            )
    return given


def _check_unit(key: str, channel: str, unit: Any) -> None:
    legal = ("1", *OWN_UNITS[channel])
    if unit not in legal:
        hint = did_you_mean(unit, legal) if isinstance(unit, str) else ""
        raise ConfigError(f"{key}.unit: found {unit!r}, expected one of {', '.join(legal)}, where 1 means SI{hint}")


def _described(channel: str, given: Mapping, key: str) -> Source | Mix | None:
    """A source from its arguments."""
    names = listed(given.get("name"))
    if names is not None and channel not in COMMANDS:
        raise ConfigError(f"{key}.name: found a list, expected one name: several are for {' and '.join(COMMANDS)}")
    for name, value in given.items():
        if name not in SOURCE_KEYS:
            hint = did_you_mean(name, SOURCE_KEYS)
            raise ConfigError(f"{key}: found {name!r}, expected keys among {', '.join(SOURCE_KEYS)}{hint}")
        numeric = name in ("zero", "span", "delay") or (name in ("window", "period") and value != AUTO)
        values = listed(value) if names and name in PER_NAME else None
        for each in [value] if values is None else values:
            if numeric and (isinstance(each, bool) or not isinstance(each, int | float)):
                expected = f"a time in s, or {AUTO}" if name in ("window", "period") else "a number"
                raise ConfigError(f"{key}.{name}: found {each!r}, expected {expected}")
        if name == "held" and not isinstance(value, bool):
            raise ConfigError(f"{key}.held: found {value!r}, expected true or false")
    if given.get("name") in (None, "", "???", []):
        return None
    for unit in (listed(given.get("unit")) if names else None) or [given.get("unit", "1")]:
        _check_unit(key, channel, unit)
    with under(key, given):
        if names is not None:
            return Mix.of({**given, "name": [str(name) for name in names]})
        if given.get("weight") is not None:
            raise ConfigError(f"weight: found {given['weight']!r}, expected none, since there is one name")
        return Source(**{**{k: v for k, v in given.items() if k != "weight"}, "name": str(given["name"])})
