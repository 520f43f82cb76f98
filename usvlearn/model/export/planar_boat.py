"""The planar model of a boat: the surge of its run, and the sway and yaw rate that were learned beside it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.engine.validate import read_checkpoint
from usvlearn.errors import CheckpointError, ConfigError, printable
from usvlearn.estimators.planar.state import USED, filter_of
from usvlearn.model.planar import PlanarModel
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.runs.files import CHECKPOINTS, PLANAR

AXES = ("yaw", "sway")


class Learned(NamedTuple):
    """What an axis EKF has learned of one axis."""

    mean: np.ndarray  # (n,) x
    updates: float  # count, without those at rest
    deviation: float  # rad/s or m/s, of the measurements' noise


class PlanarBoat(NamedTuple):
    """A boat with its planar model."""

    boat: IdentifiedBoat
    model: PlanarModel
    learned: Mapping[str, Learned]  # by axis
    path: Path  # of the checkpoint that has them
    facts: Mapping[str, Any]  # its metadata

    @property
    def lacks(self) -> tuple[str, ...]:
        """What is not confirmed or not known, a sentence each."""
        if self.model.sway is not None:
            return tuple(self.boat.guessed)
        times = f"{self.learned['sway'].updates:.0f} times, expected {USED:.0f}"
        return (*self.boat.guessed, f"The sway was measured {times}: v is 0 in the planar model.")


def read_planar(boat: IdentifiedBoat, run: Path) -> PlanarBoat | None:
    """The planar model from the newest readable checkpoint in RUN/planar/checkpoints/BOAT of a run's folder.

    None where there is none, or, with a warning, where the yaw rate was not learned. A CheckpointError if none can be
    read, a ConfigError if a filter has diverged.
    """
    folder = run / PLANAR / CHECKPOINTS / boat.path.parent.name
    if not checkpoint.checkpoints(folder):
        return None
    (path, leaves), facts = checkpoint.newest(folder, _read)
    if (kind := facts["kernel"]["kind"]) != PLANAR:
        raise CheckpointError(
            f"{path}: found an estimator of the kind {kind}, expected {PLANAR}: make the run anew, or remove {folder}"
        )
    learned = {axis: _learned(axis, leaves, facts["kernel"][axis]) for axis in AXES}
    if learned["yaw"].updates < USED:
        warnings.warn(
            f"the planar model of {printable(boat.name)} is left out: its yaw rate was measured "
            f"{learned['yaw'].updates:.0f} times, expected {USED:.0f}",
            stacklevel=2,
        )
        return None
    sway = learned["sway"].mean if learned["sway"].updates >= USED else None
    try:
        model = PlanarModel.of(boat.model, learned["yaw"].mean, sway)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    return PlanarBoat(boat, model, learned, path, facts)


def _read(path: Path) -> tuple[tuple[Path, dict[str, np.ndarray]], dict[str, Any]]:
    leaves, facts = read_checkpoint(path)
    return (path, leaves), facts


def _learned(axis: str, leaves: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> Learned:
    prefix = f"{axis}.members.{filter_of(axis, description)}."
    mean, updates, noise = (leaves[prefix + name] for name in ("mean", "updates", "noise"))
    return Learned(mean, float(np.min(updates)), float(np.sqrt(np.max(noise))))
