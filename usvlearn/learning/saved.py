"""Reads what runs have saved: folders as `run_folder` writes them, and the samples that they are judged on."""

from __future__ import annotations

import json
import warnings
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.checkpoint import checkpoints, load, restore
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble import Ensemble
from usvlearn.evaluation.season import Season, SeasonRun
from usvlearn.learning.run_folder import (
    CHECKPOINTS,
    ESTIMATOR,
    PREDICTIONS,
    RESULTS,
    RUNS,
    digest,
    position,
    side_by_side,
)
from usvlearn.signals import Fleet, tree_map


def run_folders(folder: str | Path) -> list[Path]:
    """A folder that a run was saved in, or all of those below one, the oldest first.

    Raises:
        ConfigError: there is none.
    """
    folder = Path(folder)
    found = [folder] if (folder / RUNS).exists() else [path.parent for path in folder.glob(f"**/{RUNS}")]
    if not found:
        what = "a tuning alone in" if (folder / "tuning.json").exists() else "no run below"
        raise ConfigError(f"runs: found {what} {str(folder)!r}, expected a folder in which train.py has made a run")
    return sorted(found, key=lambda path: ((path / RUNS).stat().st_mtime_ns, path))


def is_sweep(folder: Path) -> bool:
    """Whether the runs below a folder are to be compared, not pooled: jobs of a sweep, or of several ensembles.

    Raises:
        ConfigError: they are of several ensembles, and their commands are not known, as in a study's folder.
    """
    if (folder / "multirun.yaml").exists():
        return True
    folders = [path.parent for path in sorted(folder.glob(f"**/{RUNS}"))]
    if len({_runs_file(each)["ensemble"] for each in folders}) < 2:
        return False
    if not any(folder.glob("**/.hydra")):
        names = ", ".join(map(str, folders))
        raise ConfigError(f"runs: found runs of several ensembles below {folder}, expected one: name one of {names}")
    return True


def configuration(folder: Path) -> dict[str, Any]:
    """With what a run was made, as its newest readable parameter set tells.

    Raises:
        CheckpointError: it has none, or none can be read.
    """
    paths = [path for boat in sorted((folder / CHECKPOINTS).glob("*")) for path in reversed(checkpoints(boat))]
    for path in paths:
        try:
            return load(path)[1]["configuration"]
        except (CheckpointError, KeyError) as error:
            last = error
    if paths:
        cause = f"none of its {len(paths)} parameter sets can be read ({last})"
        raise CheckpointError(f"{folder}: {cause}: make the run anew")
    raise CheckpointError(
        f"{folder}: has no parameter sets ({CHECKPOINTS}/BOAT/*.safetensors): let train.py finish a run there"
    )


def results(folder: Path) -> dict[str, Any]:
    """What a run has found, {} where it is not finished.

    Raises:
        CheckpointError: the file is damaged.
    """
    path = folder / RESULTS
    try:
        found = json.loads(path.read_text()) if path.exists() else {}
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected a dictionary")
        return found
    except (OSError, ValueError) as error:
        raise CheckpointError(
            f"{path}: is damaged ({error}): run train.py with resume={folder} hydra.run.dir={folder} to write it anew"
        ) from error


def read_seasons(folders: Sequence[Path], ensemble: Ensemble, fleets: Sequence[Fleet]) -> list[Season]:
    """Every boat's parameter sets of all folders, and its runs of all fleets.

    A damaged set, or file of predictions, is passed over with a warning.

    Args:
        folders: of the runs, the oldest first.
        ensemble: to which all sets belong.
        fleets: what the sets are judged on; a run that stands in several counts once.

    Raises:
        CheckpointError: a boat has no readable set; sets of another ensemble or schema.
        ConfigError: the folders hold no set of a boat of the fleets.
    """
    runs: dict[str, dict[str, SeasonRun]] = {}
    for fleet in fleets:
        for lane, boat in enumerate(fleet.boats):
            for run in fleet.runs:
                if length := run.lengths[lane]:
                    samples = tree_map(lambda x, n=length, k=lane: x[:n, k], run.samples)
                    key = digest(run, lane)
                    runs.setdefault(boat, {}).setdefault(key, SeasonRun(run.names[lane], key, samples, {}))
    known = sorted({path.name for folder in folders for path in (folder / CHECKPOINTS).glob("*")})
    if missing := [boat for boat in runs if boat not in known]:
        raise ConfigError(
            f"data: found the boat {', '.join(missing)}, of which the runs hold no parameter set (they have "
            f"{', '.join(known) or 'none'}): give the data of these boats, or name the boat by data.boat"
        )
    return [_season(boat, list(found.values()), folders, ensemble) for boat, found in runs.items()]


def _season(boat: str, runs: list[SeasonRun], folders: Sequence[Path], ensemble: Ensemble) -> Season:
    template = tree_map(lambda x: x[0], ensemble.init((1,)))
    keys = [run.key for run in runs]
    sets, paths, own, hours, before = [], [], [], [], 0.0
    for folder in folders:
        learned = _learned(folder, boat)
        dt = float(configuration(folder)["align"]["dt"])
        ends = np.cumsum([0, *(length for _, length, _ in learned)]) * dt / 3600
        for path in checkpoints(folder / CHECKPOINTS / boat):
            at = position(path)
            if at is None or at.step == 0:  # what it started from
                continue
            try:
                sets.append(restore(path, template, ESTIMATOR)[0])
            except CheckpointError as error:
                if "damaged" not in str(error):
                    raise
                warnings.warn(f"{error}; going on without it", stacklevel=2)
                continue
            key = learned[at.run][2]
            paths.append(path)
            own.append(keys.index(key) if key in keys else -1)
            hours.append(before + ends[at.run] + at.step * dt / 3600)
        before += ends[-1]
        runs = _with_predictions(folder, boat, runs, learned)
    if not sets:
        raise CheckpointError(f"{', '.join(map(str, folders))}: no parameter set of {boat} can be read")
    return Season(boat, tuple(runs), side_by_side(sets), tuple(paths), np.array(own), np.array(hours))


def _runs_file(folder: Path) -> dict[str, Any]:
    path = folder / RUNS
    try:
        found = json.loads(path.read_text())
        boats = {
            boat: [(str(name), int(length), str(key)) for name, length, key in runs]
            for boat, runs in found["boats"].items()
        }
        return {"boats": boats, "ensemble": found["ensemble"]}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CheckpointError(f"{path}: is damaged ({error}): make the run anew") from error


def _learned(folder: Path, boat: str) -> list[tuple[str, int, str]]:
    """Name, steps and key of each run that a boat's folder was made of."""
    return _runs_file(folder)["boats"].get(boat, [])


def _with_predictions(
    folder: Path, boat: str, runs: list[SeasonRun], learned: Sequence[tuple[str, int, str]]
) -> list[SeasonRun]:
    """The runs with what was published of them in a folder, where its predictions are complete."""
    lane = list(_runs_file(folder)["boats"]).index(boat) if learned else 0
    parts: dict[int, list[dict[str, np.ndarray]]] = {}
    for path in sorted((folder / PREDICTIONS).glob("*.npz")):
        at = position(path)
        try:
            with path.open("rb") as file, np.load(file) as archive:
                part = {name: archive[name][:, lane] for name in archive.files}
        except (OSError, ValueError, KeyError, EOFError, IndexError, zipfile.BadZipFile, zlib.error) as error:
            warnings.warn(f"{path}: is damaged ({error}); its run goes without predictions", stacklevel=3)
            continue
        if at is not None:
            parts.setdefault(at.run, []).append(part)
    complete = {}
    for (_, length, key), some in ((learned[k], parts[k]) for k in sorted(parts) if k < len(learned)):
        if sum(len(part["predictions"]) for part in some) >= length:
            complete[key] = {name: np.concatenate([part[name] for part in some])[:length] for name in some[0]}
    return [run._replace(published=complete.get(run.key, run.published)) for run in runs]
