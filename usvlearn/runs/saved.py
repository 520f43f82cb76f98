"""Reads the folders that `run_folder` writes, and joins them with the samples on which they are evaluated."""

from __future__ import annotations

import json
import warnings
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.checkpoint import FormerVersionError, checkpoints, load
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.core.unconfirmed import Questions, open_questions
from usvlearn.engine.rollouts import stack
from usvlearn.engine.validate import restored
from usvlearn.errors import CheckpointError, ConfigError, check_positive
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.season import Season, SeasonRun
from usvlearn.runs.files import CHECKPOINTS, ESTIMATOR, RESULTS, RUNS, TUNING, begun, digest, longest, runs_file
from usvlearn.runs.prediction_files import Published, position, widths_of
from usvlearn.runs.trust import check_settings

SETTINGS = ("estimators", "combiners", "data", "align", "vehicle")  # what a saved configuration must contain


def run_folders(folder: str | Path) -> list[Path]:
    """The folder itself if it contains a run, else all folders below it that do, the oldest first."""
    folder = Path(folder)
    folders = [folder] if (folder / RUNS).exists() else [path.parent for path in folder.glob(f"**/{RUNS}")]
    if not folders:
        what = "a tuning alone in" if (folder / TUNING).exists() else "no run below"
        raise ConfigError(f"runs: found {what} {str(folder)!r}, expected a folder in which `train` has made a run")
    if len({path.parent for path in folders}) == 1:
        return sorted(folders, key=begun)
    return sorted(folders, key=lambda path: ((path / RUNS).stat().st_mtime_ns, path))  # numbers are per folder


def is_sweep(folder: Path) -> bool:
    """Whether the runs below a folder are compared instead of pooled: jobs of a sweep, or runs of several ensembles.

    A ConfigError if they are of several ensembles, and their commands were not saved, as in a study's folder.
    """
    if (folder / "multirun.yaml").exists():
        return True
    folders = [path.parent for path in sorted(folder.glob(f"**/{RUNS}"))]
    if len({runs_file(each)["ensemble"] for each in folders}) < 2:
        return False
    if not any(folder.glob("**/.hydra")):
        names = ", ".join(map(str, folders))
        raise ConfigError(f"runs: found runs of several ensembles below {folder}, expected one: name one of {names}")
    return True


def configuration(folder: Path, trust: str | Sequence[str] | None = None, unused: Sequence[str] = ()) -> dict[str, Any]:
    """The settings of a run, from its newest readable checkpoint; all but the `unused` ones can be instantiated.

    A CheckpointError if none can be read, or they name code that is not trusted (`runs.trust.check_settings`).
    """
    path, settings = _configuration(folder)
    check_settings(str(path), {key: each for key, each in settings.items() if key not in unused}, trust)
    check_positive(f"{path}: align.dt", settings["align"].get("dt"), "of s")
    check_positive(f"{path}: vehicle.mass", settings["vehicle"].get("mass"), "of kg")
    return settings


def _configuration(folder: Path) -> tuple[Path, dict[str, Any]]:
    """The newest readable checkpoint, and the settings in it."""
    paths = [path for boat in sorted((folder / CHECKPOINTS).glob("*")) for path in reversed(checkpoints(boat))]
    for path in paths:
        try:
            settings = load(path)[1].get("configuration")
            if not (isinstance(settings, dict) and all(isinstance(settings.get(key), dict) for key in SETTINGS)):
                raise CheckpointError(f"{path}: found no configuration with {', '.join(SETTINGS)}")
            return path, settings
        except FormerVersionError:
            raise
        except CheckpointError as error:
            last = error
    if paths:
        cause = f"none of its {len(paths)} checkpoints can be read ({last})"
        raise CheckpointError(f"{folder}: {cause}: make the run anew")
    raise CheckpointError(
        f"{folder}: has no checkpoints ({CHECKPOINTS}/BOAT/*.safetensors): let train.py finish a run there"
    )


def results(folder: Path) -> dict[str, Any]:
    """The results of a run; {} if it is not finished. A CheckpointError if the file is damaged."""
    content = _results_file(folder)
    return {} if "partial" in content else content


def data_check(folder: Path) -> Any:
    """The findings of the data check of a run, finished or not; None if there was none. Errors as of `results`."""
    content = _results_file(folder)
    partial = content.get("partial", content)
    return partial.get("data_check") if isinstance(partial, dict) else None


def questions_of_runs(folders: Sequence[Path], trust: str | Sequence[str] | None = None) -> Questions:
    """The questions that were open as runs learned. Arguments and errors as of `configuration`."""
    return {key: each for one in folders for key, each in open_questions(configuration(one, trust)).items()}


def _results_file(folder: Path) -> dict[str, Any]:
    path = folder / RESULTS
    try:
        content = json.loads(path.read_text()) if path.exists() else {}
        if not isinstance(content, dict):
            raise ValueError(f"found {type(content).__name__}, expected a dictionary")
        return content
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: is damaged ({error}): run train.py with resume={folder} hydra.run.dir={folder} to write it anew"
        ) from error


def read_seasons(folders: Sequence[Path], ensemble: Ensemble, fleets: Sequence[Fleet]) -> list[Season]:
    """Each boat's checkpoints and runs, each run once; what is damaged is skipped with a warning."""
    runs: dict[str, dict[str, SeasonRun]] = {}
    for fleet in fleets:
        for element, boat in enumerate(fleet.boats):
            for run in fleet.runs:
                if length := run.lengths[element]:
                    samples = tree_map(lambda x, n=length, k=element: x[:n, k], run.samples)
                    track = None if run.position is None else run.position[:length, element]
                    key, time = digest(run, element), run.time[:length, element]
                    season_run = SeasonRun(run.names[element], key, samples, {}, time, track, ensemble.surge_limit)
                    runs.setdefault(boat, {}).setdefault(key, season_run)
    known = sorted({path.name for folder in folders for path in (folder / CHECKPOINTS).glob("*")})
    if missing := [boat for boat in runs if boat not in known]:
        raise ConfigError(
            f"data: found the boat {', '.join(missing)}, of which the runs contain no checkpoint (they have "
            f"{', '.join(known) or 'none'}): give the data of these boats, or name the boat by data.boat"
        )
    keys = {key for named in runs.values() for key in named}
    read = [_read(folder, keys, widths_of(ensemble)) for folder in folders]
    return [_season(boat, list(named.values()), read, ensemble) for boat, named in runs.items()]


class _Folder(NamedTuple):
    """The content of a run's folder, for all boats."""

    path: Path
    dt: float  # s, of its grid
    learned: dict[str, list[tuple[str, int, str]]]  # boat -> name, steps and key of each of its runs
    published: dict[int, list[dict[str, np.ndarray]]]  # index of the run -> stretches, (time, boats, …)


def _read(folder: Path, known: Collection[str], widths: Mapping[str, int]) -> _Folder:
    """Read a folder; predictions only of the runs whose keys are known."""
    learned, dt = runs_file(folder)["boats"], _configuration(folder)[1]["align"]["dt"]
    published: dict[int, list[dict[str, np.ndarray]]] = {}
    files = Published(folder, longest(learned), len(learned), widths)
    for run, step, end in files.places():
        if any(run < len(runs) and runs[run][2] in known for runs in learned.values()):
            try:
                published.setdefault(run, []).append(files.read(run, step, end).arrays)
            except CheckpointError as error:
                warnings.warn(f"{error}; its run has no predictions here", stacklevel=3)
    return _Folder(folder, dt, learned, published)


def _season(boat: str, runs: list[SeasonRun], folders: Sequence[_Folder], ensemble: Ensemble) -> Season:
    template, description = tree_map(lambda x: x[0], ensemble.init((1,))), ensemble.description()
    keys = [run.key for run in runs]
    spacing = {run.key: run.spacing for run in runs if run.spacing}  # a step's may differ from align.dt
    states, paths, run_indices, hours, before = [], [], [], [], 0.0
    for folder in folders:
        learned = folder.learned.get(boat, [])
        steps = np.array([spacing.get(key, folder.dt) for _, _, key in learned]) / 3600
        ends = np.cumsum([0.0, *(length * step for (_, length, _), step in zip(learned, steps, strict=True))])
        for path in checkpoints(folder.path / CHECKPOINTS / boat):
            at = position(path)
            if at is None or at.step == 0:  # the checkpoint it started from
                continue
            if at.run >= len(learned) or at.step > learned[at.run][1]:
                warnings.warn(f"{path}: belongs to no step of the runs in {RUNS}; continuing without it", stacklevel=2)
                continue
            try:
                states.append(restored(path, template, ESTIMATOR, description)[0])
            except CheckpointError as error:
                if "damaged" not in str(error) and "cannot be read" not in str(error):
                    raise
                warnings.warn(f"{error}; continuing without it", stacklevel=2)
                continue
            key = learned[at.run][2]
            paths.append(path)
            run_indices.append(keys.index(key) if key in keys else -1)
            hours.append(before + ends[at.run] + at.step * steps[at.run])
        before += ends[-1]
        runs = _with_predictions(folder, boat, runs)
    if not states:
        raise CheckpointError(f"{', '.join(str(each.path) for each in folders)}: no checkpoint of {boat} can be read")
    return Season(boat, tuple(runs), stack(states), tuple(paths), np.array(run_indices), np.array(hours))


def _with_predictions(folder: _Folder, boat: str, runs: list[SeasonRun]) -> list[SeasonRun]:
    """The runs, each with its published arrays if the folder has them for all of its steps."""
    complete = {}
    element = list(folder.learned).index(boat) if boat in folder.learned else 0
    for index, (_, length, key) in enumerate(folder.learned.get(boat, [])):
        some = folder.published.get(index, [])
        if some and sum(len(part["predictions"]) for part in some) >= length:
            names = [name for name in some[0] if all(name in part for part in some)]
            complete[key] = {name: np.concatenate([part[name][:, element] for part in some])[:length] for name in names}
    return [run._replace(published=complete.get(run.key, run.published)) for run in runs]
