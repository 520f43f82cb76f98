"""What a run published of one boat, step by step, from its files of predictions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.runs.prediction_files import DAMAGE, PREDICTIONS, archive_of, position

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
    """All stretches of a boat, in order.

    Args:
        folder: of the run.
        boat: its name.

    Raises:
        ConfigError: the folder has no predictions of the boat.
        CheckpointError: a file is damaged.
    """
    paths = sorted(path for path in (folder / PREDICTIONS).glob("*.npz") if position(path) is not None)
    found = False
    for path in paths:
        try:
            one = _read(path, boat)
        except (*DAMAGE, TypeError) as error:
            raise CheckpointError(
                f"{path}: is damaged ({error}): export the other formats, or make the run anew"
            ) from error
        if one is not None and len(one.predicted):
            found = True
            yield one
    if not found:
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
    made = np.isfinite(columns["time"][:, element])  # a boat's shorter run has ended
    columns = {name: each[made, element] for name, each in columns.items()}
    return Stretch(run, names, columns, *(each[made, element] for each in tables)) if run else None


def _names(array: np.ndarray) -> tuple[str, ...]:
    """The texts of an array, as they can be written."""
    return tuple(str(each).encode("utf-8", "replace").decode() for each in array)
