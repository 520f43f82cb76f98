"""The files of predictions, `predictions/RRRRR_SSSSSSS.npz`: what a run publishes of each step.

A file contains the steps of one run since the previous file. It can be used alone, and opens without pickle. Its arrays
are those of docs/runs.md. The forecasts are of the members weighed, persistence and the ensemble; `units` has the name
and the unit of each array. Older files contain only the first three of PUBLISHED, and an ensemble without forecasts has
none.
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.core import samples
from usvlearn.core.samples import Run
from usvlearn.errors import CheckpointError
from usvlearn.estimators.planar.state import DUE

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble
    from usvlearn.estimators.planar.layer import Planar

PREDICTIONS = "predictions"  # the folder
# what a damaged .npz raises
DAMAGE = (OSError, ValueError, KeyError, IndexError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error)
PUBLISHED = ("predictions", "halfwidths", "thrusters", "health", "forecasts", "forecast_halfwidths", "tracks")
UNITS = samples.UNITS | {
    "predictions": "m/s", "halfwidths": "m/s", "thrusters": "share of the thrust; evidence; 0 or 1",
    "health": "share of the thrust; 0 or 1; 0 or 1; count",
    "measured_surge": samples.UNITS["surge"], "forecasts": "m/s", "forecast_halfwidths": "m/s", "horizons": "s",
    "tracks": "m; rad; m; m; m; m; group; m", "track_horizons": "s",
}  # fmt: skip
Widths = Mapping[str, int]  # the length of the last axis of each array that may be published


class Position(NamedTuple):
    """A place in a fleet's runs: `step` steps of the run with index `run` are done."""

    run: int
    step: int


BEGIN = Position(0, 0)


class Stretch(NamedTuple):
    """The steps of one run in one file."""

    run: int  # its index
    step: int  # the first
    arrays: dict[str, np.ndarray]  # by PUBLISHED, (time, boats, …)


class Published:
    """The stretches in a run's folder, in order. Each is read when it is needed, so that memory contains one at a time.

    The lengths are the steps of each run, the widths those of `widths_of`.
    """

    def __init__(
        self, folder: Path, lengths: Sequence[int], boats: int, widths: Widths, names: Sequence[str] = PUBLISHED
    ):
        self._folder, self._lengths, self._boats, self._widths = folder / PREDICTIONS, lengths, boats, widths
        self._names = names

    def places(self) -> list[tuple[int, int, int]]:
        """Index of the run, first step and end of each stretch, from the names of the files."""
        places, before = [], BEGIN
        for place in filter(None, map(position, self.paths())):
            places.append((place.run, before.step if place.run == before.run else 0, place.step))
            before = place
        return places

    def paths(self) -> list[Path]:
        """The files, in order."""
        return named(self._folder.parent, self._lengths)

    def read(self, run: int, step: int, end: int, names: Sequence[str] = PUBLISHED) -> Stretch:
        """Read the arrays `names` of one of the `places`, as far as its file has them."""
        path = self._folder / f"{stem(Position(run, end))}.npz"
        steps, widths = min(end, self._lengths[run]) - step, self._widths
        most = (1 << 16) + (2048 + 4 * 8 * max(0, steps) * (sum(widths.values()) + 7)) * self._boats  # 2048: names
        try:
            with archive_of(path, most) as archive:
                wanted = [name for name in names if name in widths and (name in archive or name == "predictions")]
                arrays = {name: archive[name] for name in wanted}
            for name, array in arrays.items():
                shape = (end - step, self._boats, widths[name])
                if array.dtype.kind != "f" or array.ndim != 3 or array.shape[1:] != shape[1:]:
                    raise ValueError(f"{name} are {array.dtype} {array.shape}, expected numbers of {shape}")
                if len(array) != end - step:
                    raise ValueError(f"it contains {len(array)} steps, expected {end - step}")
        except DAMAGE as error:
            raise CheckpointError(f"{path}: is damaged ({error})") from error
        return Stretch(run, step, arrays)

    def only(self, *names: str) -> Published:
        """The same stretches with these arrays alone, which saves unpacking the others."""
        return Published(self._folder.parent, self._lengths, self._boats, self._widths, names)

    def __iter__(self) -> Iterator[Stretch]:
        """All stretches, one after the other."""
        return (self.read(*place, self._names) for place in self.places())


def widths_of(ensemble: Ensemble, planar: Planar | None = None) -> dict[str, int]:
    """The widths of what an ensemble publishes, and what makes tracks beside it."""
    count = len(ensemble.names)
    widths = {"predictions": count, "halfwidths": count, "thrusters": 5, "health": 6 + len(ensemble.accommodated)}
    if (forecasts := ensemble.forecasts) is not None:
        count = len(forecasts.horizons)
        widths |= {"forecasts": count * len(forecasts.columns), "forecast_halfwidths": count}
    return widths if planar is None else widths | {"tracks": DUE * len(planar.horizons)}


def joined(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Stretches, concatenated in time."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def packed(
    published: Mapping[str, np.ndarray],
    run: Run,
    end: int,
    boats: Sequence[str],
    ensemble: Ensemble,
    planar: Planar | None = None,
) -> bytes:
    """The content of a file: what was published of the last steps of a run before `end`, with their samples."""
    part = slice(end - len(published["predictions"]), end)
    inputs, surge, fresh, measured = run.samples
    arrays = {
        **published,
        "time": run.time[part],
        "measured_surge": np.where(measured[part], surge[part], np.nan),
        **{name: values[part] for name, values in inputs._asdict().items()},
        "fresh": fresh[part],
        "measured": measured[part],
        "boats": np.array(boats, str),
        "runs": np.array(run.names, str),
        "estimators": np.array(ensemble.names, str),
    }
    if (forecasts := ensemble.forecasts) is not None:
        arrays |= {"horizons": forecasts.horizons.numpy(), "forecast_columns": np.array(forecasts.columns, str)}
    if planar is not None and "tracks" in published:
        arrays["track_horizons"] = np.array(planar.horizons, float)
    if "health" in published:
        arrays["filters"] = np.array(ensemble.accommodated, str)
    arrays["units"] = np.array([(name, unit) for name, unit in UNITS.items() if name in arrays])
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:  # 6 takes 2.5 times as long
        for name, array in arrays.items():  # and makes it 1 % smaller
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    return content.getvalue()


@contextmanager
def archive_of(path: Path, most: int) -> Iterator[Any]:
    """The opened archive of a file of predictions; raises one of DAMAGE if it unpacks to more than `most` bytes."""
    if not (path.is_file() and zipfile.is_zipfile(path)):  # a pipe would never end
        raise ValueError("it is no archive of arrays")
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        if (size := sum(each.file_size for each in archive.zip.infolist())) > most:
            raise ValueError(f"it unpacks to {size / 1e6:.0f} MB, expected {most / 1e6:.1f} at most")
        yield archive


def position(path: Path) -> Position | None:
    """The place in a file's name; None if the name has another form than `stem` gives it."""
    run, _, step = path.stem.partition("_")
    place = Position(int(run), int(step)) if run.isdecimal() and step.isdecimal() else None
    return place if place is not None and stem(place) == path.stem else None


def named(folder: Path, lengths: Sequence[int]) -> list[Path]:
    """The predictions in a folder that belong to runs of so many steps, in order."""
    placed = [(at, path) for path in (folder / PREDICTIONS).glob("*.npz") if (at := position(path)) is not None]
    return [path for at, path in sorted(placed) if at.run < len(lengths) and 0 < at.step <= lengths[at.run]]


def stem(place: Position) -> str:
    """The stem of the names of a place's files."""
    return f"{place.run:05d}_{place.step:07d}"
