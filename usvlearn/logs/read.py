"""Find the logs that a path names, and read each into a Recording."""

from __future__ import annotations

import difflib
import glob
import itertools
import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Protocol

from usvlearn.errors import ConfigError, LogFormatError, did_you_mean, under
from usvlearn.logs.channel import AUTO, CHANNELS, REQUIRED, Channel, Recording, Source
from usvlearn.logs.copies import settle_period
from usvlearn.logs.series import Series

SOURCE_KEYS = tuple(field.name for field in fields(Source))


class Reader(Protocol):
    """A reader of one file: `Alog`, `Table`, `Rosbag`."""

    suffixes: tuple[str, ...]

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]: ...

    def survey(self, path: Path) -> list[Series]: ...


def read_recordings(
    path: str | os.PathLike | Mapping[str, str | os.PathLike],
    reader: Reader,
    channels: Mapping[str, Source | Mapping | None],
    boat: str | None = None,
) -> list[Recording]:
    """Read all logs of one boat, or of several.

    Runs are named by their path below the given folder, without suffix, and sorted so that run_2 comes before run_10.
    If there are several logs, one that cannot be read is left out with a warning.

    Args:
        path: a log; a folder, with all logs below it; a pattern such as `logs/*/run_?.csv`; or boat -> path.
        reader: reads one log.
        channels: channel -> a Source or its arguments; None, or a name of None, means not logged.
        boat: the boat's name; default the name of the log or folder, without suffix.

    Raises:
        ConfigError: the path finds no log, or the channels are not declared as expected.
        LogFormatError: no log can be read as declared; the message is that of the first log.

    >>> from tempfile import TemporaryDirectory
    >>> from usvlearn.logs.csv_table import Table
    >>> channels = {"command_left": {"name": "L"}, "command_right": {"name": "R"}, "surge": {"name": "v"},
    ...             "heading": {"name": "psi", "unit": "deg"}}
    >>> with TemporaryDirectory() as folder:
    ...     for run in ("run_10", "run_2"):
    ...         _ = Path(folder, f"{run}.csv").write_text("t,L,R,v,psi\\n0,0.5,0.5,1.0,90\\n")
    ...     recordings = read_recordings(folder, Table("t"), channels, boat="heron")
    >>> [(recording.boat, recording.run) for recording in recordings]
    [('heron', 'run_2'), ('heron', 'run_10')]
    """
    if not hasattr(reader, "read"):
        raise ConfigError(f"data.reader: found {reader!r}, expected a reader: Alog, Table or Rosbag")
    if isinstance(path, Mapping):
        if boat is not None or not path:
            found = f"boat {boat!r} beside a path per boat" if path else "no boat"
            raise ConfigError(f"data.path: found {found}, expected BOAT: FILE entries that name the boats")
        return [
            recording
            for name, place in path.items()
            for recording in read_recordings(place, reader, channels, str(name))
        ]
    sources = _sources(channels)
    root, files = _find(path, reader.suffixes)
    if boat is None:
        boat = files[0].stem if len(files) == 1 and Path(path).expanduser().is_file() else root.resolve().name
    recordings, unread = [], []
    for file in files:
        try:
            recordings.append(_read(file, root, reader, sources, str(boat)))
        except LogFormatError as error:
            unread.append(error)
    if not recordings:
        raise unread[0]
    for each in unread:
        warnings.warn(f"log left out: {each}", stacklevel=2)
    return settle_period(str(boat), recordings)


def _read(file: Path, root: Path, reader: Reader, sources: dict[str, Source], boat: str) -> Recording:
    try:
        if file.stat().st_size == 0:
            raise LogFormatError(f"{file}: expected a log, found an empty file: remove it")
        channels, dropped = reader.read(file, sources)
    except OSError as error:
        raise LogFormatError(
            f"{file}: expected a readable file, found: {error.strerror or error}: fix its permissions"
        ) from error
    return Recording(boat, file.relative_to(root).with_suffix("").as_posix(), channels, dropped)


def _find(path: str | os.PathLike, suffixes: tuple[str, ...]) -> tuple[Path, list[Path]]:
    """The folder relative to which runs are named, and the logs in natural order."""
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
        root, pattern = here, os.path.join(glob.escape(text), "**")
    elif glob.has_magic(text):
        root = Path(*itertools.takewhile(lambda part: not glob.has_magic(part), here.parts))
        pattern = text
    else:
        if here.exists():
            raise ConfigError(
                f"data.path: found {text!r}, which is a device or a pipe: set it to a folder or log ({endings})"
            )
        close = difflib.get_close_matches(here.name, _names(here.parent), n=1)
        hint = f"did you mean {here.parent / close[0]}?" if close else f"set it to a folder or log ({endings})"
        raise ConfigError(f"data.path: found {text!r}, but {here.absolute()} does not exist: {hint}")
    found = [Path(name) for name in glob.glob(pattern, recursive=True) if os.path.isfile(name)]
    files = [file for file in found if file.suffix.lower() in suffixes]
    if not files and found and not here.is_dir():
        files = found  # the pattern names another suffix
    if not files:
        raise ConfigError(
            f"data.path: expected logs ({endings}) in {text!r}, found none among its {len(found)} files: "
            "set data.path to a log, or choose the data option that fits these files"
        )
    return root, sorted(files, key=lambda file: _natural(file.relative_to(root)))


def _names(folder: Path) -> list[str]:
    return [entry.name for entry in folder.iterdir()] if folder.is_dir() else []


def _natural(path: Path) -> list[list]:
    """A sort key in which run_2 comes before run_10."""
    parts = [re.split(r"(\d+)", part) for part in path.parts]
    return [[int(piece) if place % 2 else piece for place, piece in enumerate(part)] for part in parts]


def _sources(channels: Mapping[str, Source | Mapping | None]) -> dict[str, Source]:
    """The channels that are logged, checked."""
    for name in channels:
        if name not in CHANNELS:
            hint = did_you_mean(name, CHANNELS)
            raise ConfigError(f"data.channels: found {name!r}, expected channels among {', '.join(CHANNELS)}{hint}")
    sources = {
        name: source
        for name in CHANNELS
        if (source := _source(name, channels[name] if name in channels else None)) is not None
    }
    for name in REQUIRED:
        if name not in sources:
            raise ConfigError(
                f"data.channels: found no {name}, expected {', '.join(REQUIRED)}: set data.channels.{name}.name"
            )
    return sources


def _source(channel: str, given: Source | Mapping | None) -> Source | None:
    key = f"data.channels.{channel}"
    if given is None or isinstance(given, Source):
        return given
    if not isinstance(given, Mapping):
        raise ConfigError(f"{key}: found {given!r}, expected {{name: ..., unit: ...}}")
    for name, value in given.items():
        if name not in SOURCE_KEYS:
            hint = did_you_mean(name, SOURCE_KEYS)
            raise ConfigError(f"{key}: found {name!r}, expected keys among {', '.join(SOURCE_KEYS)}{hint}")
        numeric = name in ("zero", "span", "window", "delay") or (name == "period" and value != AUTO)
        if numeric and (isinstance(value, bool) or not isinstance(value, int | float)):
            expected = f"a time in s, or {AUTO}" if name == "period" else "a number"
            raise ConfigError(f"{key}.{name}: found {value!r}, expected {expected}")
        if name == "held" and not isinstance(value, bool):
            raise ConfigError(f"{key}.held: found {value!r}, expected true or false")
    if given.get("name") in (None, "", "???"):
        return None
    with under(key, given):
        return Source(**{**given, "name": str(given["name"])})
