"""A run's folder: parameter sets and predictions as they come, and how a run goes on from them.

checkpoints/BOAT/RRR_SSSSSSS.safetensors   the boat's state after S steps of its run with index R
predictions/RRR_SSSSSSS.npz                what all estimators predicted since the file before, all boats
"""

from __future__ import annotations

import io
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from usvlearn.checkpoint import SUFFIX, checkpoints, restore, write_atomically
from usvlearn.checkpoint import save as save_checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble import EnsembleState
from usvlearn.learning.replay import Chunk, Position, last_due
from usvlearn.signals import Fleet, tree_map

CHECKPOINTS, PREDICTIONS = "checkpoints", "predictions"


class Start(NamedTuple):
    """Where a run begins."""

    state: EnsembleState  # leaves (boats, ...)
    position: Position
    predictions: list[list[np.ndarray]]  # per run, what was predicted up to there
    note: str  # for the person who started it


class RunFolder:
    """Saves a replay as it goes and finds where to go on.

    Args:
        path: the folder.
        fleet: what is replayed.
        save_every: steps between parameter sets.
        metadata: JSON values that every checkpoint carries (configuration, version).
    """

    def __init__(self, path: str | Path, fleet: Fleet, save_every: int, metadata: Mapping[str, Any]):
        self.path, self.fleet, self.save_every, self.metadata = Path(path), fleet, save_every, dict(metadata)
        self._pending: list[np.ndarray] = []

    def begin(self, state: EnsembleState, resume: str | None) -> Start:
        """Where to start from: `state`, or what `resume` ("latest", a run's folder or a checkpoint) has saved.

        Raises:
            ConfigError: without `resume`, the folder already holds parameter sets.
            CheckpointError: with it, nothing readable is found, or it does not fit.
        """
        fresh = Start(state, Position(0, 0), [[] for _ in self.fleet.runs], "")
        if resume is None:
            if any((self.path / CHECKPOINTS).glob(f"*/*{SUFFIX}")):
                raise ConfigError(
                    f"{self.path}: already holds the parameter sets of a run: go on from them with resume=latest, "
                    "or choose another hydra.run.dir"
                )
            return fresh
        if resume == "latest":
            resume = self._latest()
        source = Path(resume)
        if source.is_file():
            return self._from_file(source, fresh)
        if not source.is_dir():
            raise CheckpointError(
                f"resume: {source} does not exist: give a run's folder, a checkpoint or latest"
            )
        return self._from_folder(source, fresh)

    def save(self, chunk: Chunk) -> None:
        """Write what a chunk makes due."""
        self._pending.append(chunk.predictions)
        if not any(chunk.due):
            return
        name = f"{chunk.end.run:03d}_{chunk.end.step:07d}"
        folder = self.path / PREDICTIONS
        folder.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        np.savez_compressed(content, predictions=np.concatenate(self._pending))
        write_atomically(folder / f"{name}.npz", content.getvalue())  # before the states that depend on it
        self._pending.clear()
        run = self.fleet.runs[chunk.end.run]
        for lane, boat in enumerate(self.fleet.boats):
            if chunk.due[lane]:
                save_checkpoint(
                    self.path / CHECKPOINTS / boat / f"{name}{SUFFIX}",
                    tree_map(lambda x, lane=lane: x[lane], chunk.state),
                    estimator="Ensemble",
                    boat=boat,
                    run=run.names[lane],
                    runs=[r.names[lane] for r in self.fleet.runs[: chunk.end.run + 1]],
                    step=chunk.end.step,
                    time=float(run.time[chunk.end.step - 1]),
                    save_every=self.save_every,
                    **self.metadata,
                )

    def _latest(self) -> Path:
        """The folder with the newest parameter set: this one, else a sibling."""
        folders = (
            [self.path] if any((self.path / CHECKPOINTS).glob(f"*/*{SUFFIX}")) else self.path.parent.glob("*")
        )
        stamped = [
            (max(path.stat().st_mtime_ns for path in sets), folder)
            for folder in folders
            if (sets := list((folder / CHECKPOINTS).glob(f"*/*{SUFFIX}")))
        ]
        if not stamped:
            raise CheckpointError(
                f"resume=latest: no run with parameter sets in {self.path.parent}: give a run's folder, or leave it out"
            )
        return max(stamped)[1]

    def _from_file(self, source: Path, fresh: Start) -> Start:
        """Every boat starts from one parameter set; the runs are new to it."""
        state, facts = restore(source, self._lane(fresh.state), "Ensemble")
        boats = len(self.fleet.boats)
        state = tree_map(lambda x: x.expand(boats, *x.shape).clone(), state)
        return fresh._replace(
            state=state, note=f"starting from {facts['boat']}, run {facts['run']}, at {facts['time']:.0f} s"
        )

    def _from_folder(self, source: Path, fresh: Start) -> Start:
        found = {boat: self._sets(source, boat, fresh.state) for boat in self.fleet.boats}
        if self._same_runs(source, found):
            return self._continue(source, found, fresh)
        lanes = [self._newest(found[boat], fresh.state) for boat in self.fleet.boats]
        state = tree_map(lambda *leaves: torch.stack(leaves), *lanes)
        return fresh._replace(
            state=state, note=f"starting from the parameter sets of {source}, on other runs"
        )

    def _sets(self, source: Path, boat: str, state: EnsembleState) -> dict[Position, Path]:
        paths = checkpoints(source / CHECKPOINTS / boat)
        if not paths:
            boats = ", ".join(sorted(p.name for p in (source / CHECKPOINTS).glob("*"))) or "none"
            raise CheckpointError(
                f"{source}: has no parameter set of {boat} (it has {boats}): resume the same boats"
            )
        return {Position(*map(int, path.stem.split("_"))): path for path in paths}

    def _newest(self, sets: dict[Position, Path], state: EnsembleState) -> EnsembleState:
        for position in sorted(sets, reverse=True):
            if (one := self._try(sets[position], state)) is not None:
                return one
        raise CheckpointError(f"{sets[min(sets)].parent}: none of its {len(sets)} parameter sets can be read")

    def _same_runs(self, source: Path, found: dict[str, dict[Position, Path]]) -> bool:
        """Whether the saved runs are the first ones of this fleet, saved at the same interval."""
        for lane, boat in enumerate(self.fleet.boats):
            facts = None
            for position in sorted(found[boat], reverse=True):
                try:
                    facts = restore_facts(found[boat][position])
                    break
                except CheckpointError:
                    continue
            if facts is None:
                return True  # _continue will say what is wrong
            names = [run.names[lane] for run in self.fleet.runs[: len(facts["runs"])]]
            if names != facts["runs"] or facts["save_every"] != self.save_every:
                return False
        return True

    def _continue(self, source: Path, found: dict[str, dict[Position, Path]], fresh: Start) -> Start:
        """The newest position at which every boat has what it needs, and every prediction up to it."""
        for position in sorted({p for sets in found.values() for p in sets}, reverse=True):
            if position.run >= len(self.fleet.runs):
                continue
            lanes = []
            for lane, boat in enumerate(self.fleet.boats):
                place = self._own(lane, position)
                path = found[boat].get(place) if place else None
                one = self._lane(fresh.state) if place is None else path and self._try(path, fresh.state)
                if one is None:
                    break
                lanes.append(one)
            predictions = self._read_predictions(source, position) if len(lanes) == len(found) else None
            if predictions is not None:
                self._copy(source, position)
                state = tree_map(lambda *leaves: torch.stack(leaves), *lanes)
                run = self.fleet.runs[position.run]
                note = f"going on after {run.time[position.step - 1]:.0f} s of run {position.run + 1} of {len(self.fleet.runs)}, from {source}"
                return Start(state, position, predictions, note)
        raise CheckpointError(
            f"{source}: has no position at which all boats can be read: start anew without resume"
        )

    def _own(self, lane: int, position: Position) -> Position | None:
        """Where a boat saved last, up to a position of the fleet."""
        for index in range(position.run, -1, -1):
            step = position.step if index == position.run else max(self.fleet.runs[index].lengths)
            if own := last_due(self.fleet.runs[index].lengths[lane], step, self.save_every):
                if index == position.run and own != min(step, self.fleet.runs[index].lengths[lane]):
                    return Position(index, -1)  # a place where this boat saved nothing: not one to go on from
                return Position(index, own)
        return None

    def _read_predictions(self, source: Path, position: Position) -> list[list[np.ndarray]] | None:
        runs: list[list[np.ndarray]] = [[] for _ in self.fleet.runs]
        for path in sorted((source / PREDICTIONS).glob("*.npz")):
            place = Position(*map(int, path.stem.split("_")))
            if place <= position:
                try:
                    runs[place.run].append(np.load(path)["predictions"])
                except (OSError, ValueError, KeyError) as error:
                    warnings.warn(f"{path}: cannot be read ({error}); trying the set before", stacklevel=2)
                    return None
        done = [sum(map(len, run)) for run in runs]
        wanted = [len(run.time) for run in self.fleet.runs[: position.run]] + [position.step]
        return runs if done[: position.run + 1] == wanted else None

    def _copy(self, source: Path, position: Position) -> None:
        """Bring along what the resumed run rests on, so that its folder is complete."""
        if source.resolve() == self.path.resolve():
            return
        for old in [*(source / CHECKPOINTS).glob(f"*/*{SUFFIX}"), *(source / PREDICTIONS).glob("*.npz")]:
            if Position(*map(int, old.stem.split("_"))) <= position:
                new = self.path / old.relative_to(source)
                new.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(old, new)

    def _try(self, path: Path, state: EnsembleState) -> EnsembleState | None:
        """One boat's state, or None where the file is damaged; a file of another estimator raises."""
        try:
            restore_facts(path)
        except CheckpointError as error:
            warnings.warn(f"{error}", stacklevel=2)
            return None
        return restore(path, self._lane(state), "Ensemble")[0]

    @staticmethod
    def _lane(state: EnsembleState) -> EnsembleState:
        return tree_map(lambda x: x[0], state)


def restore_facts(path: Path) -> dict[str, Any]:
    """The metadata of a checkpoint, its checksum verified."""
    from usvlearn.checkpoint import load

    return load(path)[1]
