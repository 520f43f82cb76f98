"""What a run published of one boat, step by step, as CSV and as MCAP with JSON messages (Foxglove, PlotJuggler)."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import usvlearn
from usvlearn.errors import CheckpointError, ConfigError, MissingExtraError
from usvlearn.runs.prediction_files import DAMAGE, PREDICTIONS, UNITS, archive_of, position

INPUTS = ("command_left", "command_right", "heading", "yaw_rate", "dt")
COLUMNS = ("time", "measured_surge", *INPUTS)  # arrays (time, boats)
LARGEST, LATEST = 1 << 30, 1e8  # bytes of a file's arrays; s after the first step of a run


class Stretch(NamedTuple):
    """The steps of one run in one file."""

    run: str  # its name
    estimators: tuple[str, ...]
    columns: dict[str, np.ndarray]  # COLUMNS, (time,): s since the run's first step, m/s, shares, rad, rad/s, s
    predicted: np.ndarray  # (time, estimators) m/s; NaN where no step was made
    halfwidths: np.ndarray  # (time, estimators) m/s, of the 90 % intervals


def stretches(folder: Path, boat: str) -> Iterator[Stretch]:
    """All stretches of a boat of a run, in order; a ConfigError without any, a CheckpointError if a file is damaged."""
    paths = sorted(path for path in (folder / PREDICTIONS).glob("*.npz") if position(path) is not None)
    exists = False
    for path in paths:
        try:
            stretch = _read(path, boat)
        except (*DAMAGE, TypeError) as error:
            raise CheckpointError(
                f"{path}: is damaged ({error}): export the other formats, or make the run anew"
            ) from error
        if stretch is not None and len(stretch.predicted):
            exists = True
            yield stretch
    if not exists:
        raise ConfigError(
            f"{folder}: found no predictions of {boat} ({PREDICTIONS}/*.npz), expected the folder of a run "
            "of train.py: give it in place of a checkpoint"
        )


def _read(path: Path, boat: str) -> Stretch | None:
    """A boat's steps in a file; None if it is not in it."""
    with archive_of(path, LARGEST) as archive:
        boats, names, runs = (_names(archive[each]) for each in ("boats", "estimators", "runs"))
        if boat not in boats:
            return None
        element = boats.index(boat)
        run = runs[element]
        columns = {name: archive[name] for name in COLUMNS}
        tables = [archive[name] for name in ("predictions", "halfwidths")]
    shape = (*columns["time"].shape[:1], len(boats))
    for each in (*columns.values(), *tables):
        wanted = shape if each.ndim == 2 else (*shape, len(names))
        if each.dtype not in (np.float32, np.float64) or each.shape != wanted:
            raise ValueError(f"found {each.dtype} {each.shape}, expected numbers {wanted}")
    if (np.abs(np.nan_to_num(columns["time"] - LATEST / 2, nan=0.0)) > LATEST / 2).any():
        raise ValueError(f"found a time beyond 0 to {LATEST:g} s")
    steps = np.isfinite(columns["time"][:, element])  # a boat's shorter run has ended
    columns = {name: each[steps, element] for name, each in columns.items()}
    return Stretch(run, names, columns, *(each[steps, element] for each in tables)) if run else None


def _names(array: np.ndarray) -> tuple[str, ...]:
    """The texts of an array, as they can be written."""
    return tuple(str(each).encode("utf-8", "replace").decode() for each in array)


def csv_table(stretches: Iterable[Stretch]) -> bytes:
    """The text: a row for each step, an empty cell where a number is unknown.

    Columns: run, time, measured_surge, inputs, then `NAME` and `NAME_halfwidth` of each estimator. Numbers are written
    so that they are read again as the same.
    """
    iterator = iter(stretches)
    first = next(iterator)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", *COLUMNS, *chain(*((name, f"{name}_halfwidth") for name in first.estimators))])
    for each in chain([first], iterator):
        if each.estimators != first.estimators:
            raise CheckpointError(
                f"predictions of {each.run}: found the estimators {', '.join(each.estimators)}, expected those of the "
                f"runs before, {', '.join(first.estimators)}: make the run anew"
            )
        for k in range(len(each.predicted)):
            pairs = chain(*zip(each.predicted[k].tolist(), each.halfwidths[k].tolist(), strict=True))
            numbers = [*(float(values[k]) for values in each.columns.values()), *pairs]
            writer.writerow([each.run, *(repr(x) if math.isfinite(x) else "" for x in numbers)])
    return text.getvalue().encode()


GAP = 10.0  # s between two runs, which follow each other from time 0
TOPICS = {"measured": "/usvlearn/measured", "predicted": "/usvlearn/predicted", "halfwidth": "/usvlearn/halfwidth"}


def mcap_file(boat: str, stretches: Iterable[Stretch]) -> bytes:
    """The content of a file.

    Topics: `/usvlearn/measured` (speed and inputs), `/usvlearn/predicted` and `/usvlearn/halfwidth` (a number for each
    estimator), each with `time`, s since the run's first step. A number that is unknown is left out. The stamps begin
    at 0, and the runs follow each other with 10 s between; the metadata `runs` has the stamp at which each begins.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise MissingExtraError("mcap", "export", "writing MCAP") from error
    content = io.BytesIO()
    writer = Writer(content)
    writer.start(profile="", library=f"usvlearn {usvlearn.__version__}")
    channels: dict[str, int] = {}
    begins: dict[str, str] = {}
    begin, end, run = 0.0, 0.0, None
    for each in stretches:
        if not channels:
            channels = {name: _channel(writer, name, topic, each) for name, topic in TOPICS.items()}
        if each.run != run:
            begin, run = (end + GAP if run is not None else 0.0), each.run
            begins[each.run] = f"{begin:.3f} s"
        for k in range(len(each.predicted)):
            time = float(each.columns["time"][k])
            end = begin + time
            stamp = round(end * 1e9)
            rows: dict[str, dict[str, float]] = {
                "measured": {name: float(values[k]) for name, values in each.columns.items()},
                "predicted": {"time": time, **dict(zip(each.estimators, each.predicted[k].tolist(), strict=True))},
                "halfwidth": {"time": time, **dict(zip(each.estimators, each.halfwidths[k].tolist(), strict=True))},
            }
            for name, row in rows.items():
                known = {key: value for key, value in row.items() if math.isfinite(value)}
                writer.add_message(channels[name], stamp, json.dumps(known).encode(), stamp)
    writer.add_metadata("runs", begins)
    writer.add_metadata("boat", {"name": boat})
    writer.finish()
    return content.getvalue()


def _channel(writer: Any, name: str, topic: str, stretch: Stretch) -> int:
    """Register a topic; returns its number."""
    columns = stretch.columns if name == "measured" else ("time", *stretch.estimators)
    schema = {
        "type": "object",
        "properties": {key: {"type": "number", "description": UNITS.get(key, "m/s")} for key in columns},
    }
    number = writer.register_schema(f"usvlearn.{name}", "jsonschema", json.dumps(schema).encode())
    return int(writer.register_channel(topic, "json", number))
