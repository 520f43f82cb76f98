"""Checkpoints of the planar model, from which a resumed run continues.

They lie in RUN/planar/checkpoints/BOAT, named like those of the ensemble, and hold the ensemble's state, too, so that
`Online.open(RUN/planar)` forecasts tracks. Of each boat the newest two are kept, and the last of the run before, which
has not learned from the newest run.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from usvlearn.core.checkpoint import SUFFIX, checkpoints
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.engine.rollouts import stack
from usvlearn.engine.validate import restored
from usvlearn.errors import CheckpointError
from usvlearn.estimators.planar.layer import Planar, PlanarState
from usvlearn.runs.file_names import CHECKPOINTS, PLANAR
from usvlearn.runs.prediction_files import Position, position, stem

ESTIMATOR = "Planar"  # the kind of state in a checkpoint
KEPT = 2


def planar_path(folder: Path, boat: str, place: Position) -> Path:
    """The checkpoint of a boat at a place."""
    return folder / PLANAR / CHECKPOINTS / boat / f"{stem(place)}{SUFFIX}"


def started(
    planar: Planar, folders: Sequence[Path], fleet: Fleet, places: Sequence[Position | None]
) -> tuple[PlanarState | None, str]:
    """The state of all boats from the first folder that has it at these places, or None and why.

    Args:
        planar: as configured now.
        folders: of runs.
        fleet: that is replayed.
        places: of each boat; None: the newest checkpoint is taken.
    """
    template, reason = tree_map(lambda x: x[0], planar.init((1,))), ""
    for folder in folders:
        found: list[Any] = []
        for boat, place in zip(fleet.boats, places, strict=True):
            paths = checkpoints(folder / PLANAR / CHECKPOINTS / boat)
            if place is not None:
                paths = [path for path in paths if path == planar_path(folder, boat, place)]
            reason = f"{folder / PLANAR}: has no checkpoint of {boat} at this place"
            for path in reversed(paths):
                try:
                    found.append(restored(path, template, ESTIMATOR, planar.description())[0])
                    break
                except CheckpointError as error:
                    reason = str(error)
        if len(found) == len(fleet.boats):
            return stack(found), ""
    return None, reason


def beside_of(checkpoint: Path) -> Path:
    """Where the checkpoint of all axes lies that was saved with an ensemble's.

    >>> str(beside_of(Path("run/checkpoints/heron/00000_0000750.safetensors")))
    'run/planar/checkpoints/heron/00000_0000750.safetensors'
    """
    boat = checkpoint.parent
    return boat.parent.parent / PLANAR / CHECKPOINTS / boat.name / checkpoint.name


def started_from(planar: Planar, path: Path, boats: int) -> tuple[PlanarState | None, str]:
    """The state of so many boats that all start from one checkpoint, or None and why."""
    if not path.is_file():
        return None, f"there is no {path}"
    try:
        one = restored(path, tree_map(lambda x: x[0], planar.init((1,))), ESTIMATOR, planar.description())[0]
    except CheckpointError as error:
        return None, str(error)
    return stack([one] * boats), ""


def forget(folder: Path, boats: Sequence[str]) -> None:
    """Remove all but the newest checkpoints of each boat, and the last of its run before."""
    for boat in boats:
        paths = [path for path in checkpoints(folder / PLANAR / CHECKPOINTS / boat) if position(path) is not None]
        runs = [at.run for at in map(position, paths) if at is not None]
        before = [path for path, run in zip(paths, runs, strict=True) if run < runs[-1]]
        for old in paths[:-KEPT]:
            if old not in before[-1:]:
                old.unlink(missing_ok=True)
