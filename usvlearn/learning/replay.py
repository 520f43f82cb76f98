"""Replay: runs through an ensemble in the order in which they were made, predicting before learning."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from usvlearn.estimator import rollout
from usvlearn.estimators.ensemble import Ensemble, EnsembleState
from usvlearn.signals import Fleet, tree_map


class Position(NamedTuple):
    """A place in a fleet's runs: so many steps of the run with that index are done."""

    run: int
    step: int


BEGIN = Position(0, 0)


class Chunk(NamedTuple):
    """A stretch of one run, replayed."""

    begin: Position
    end: Position
    state: EnsembleState  # at the end; leaves (boats, ...)
    predictions: np.ndarray  # (time, boats, estimators) m/s, NaN where no step was made
    save: bool  # whether parameter sets are due at the end


def replay(
    ensemble: Ensemble,
    fleet: Fleet,
    state: EnsembleState,
    begin: Position = BEGIN,
    every: int = 750,
    save_every: int = 750,
) -> Iterator[Chunk]:
    """Run a fleet's samples through an ensemble, all boats as lanes, and yield it in chunks.

    The state is carried from run to run, as a boat carries its parameters from mission to mission.

    Args:
        ensemble: what predicts and learns.
        fleet: aligned runs; see `usvlearn.logs.fleet.align_fleet`.
        state: to start from, leaves `(boats, ...)`.
        begin: what is already done.
        every: steps in a chunk, at most.
        save_every: steps between two parameter sets; more fall due at the end of each run.

    Yields:
        Chunks in order; together they cover each run once.
    """
    dtype = state.predictions.dtype
    for index in range(begin.run, len(fleet.runs)):
        samples, length = fleet.runs[index].samples, len(fleet.runs[index].time)
        done = begin.step if index == begin.run else 0
        for stop in sorted({*range(every, length, every), *range(save_every, length, save_every), length}):
            if stop <= done:
                continue
            part = tree_map(lambda x, a=done, b=stop: x[a:b], samples)
            with torch.no_grad():
                tensors = tree_map(lambda x: _tensor(x, dtype), part)
                state, _, predictions = rollout(ensemble, state, tensors, record=lambda s: s.predictions)
            stepped = part.fresh & (part.inputs.dt != 0)
            yield Chunk(
                Position(index, done),
                Position(index, stop),
                state,
                np.where(stepped[..., None], predictions.numpy(), np.nan),
                stop == length or stop % save_every == 0,
            )
            done = stop


def _tensor(x: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
    tensor = torch.from_numpy(x)
    return tensor.to(dtype) if tensor.is_floating_point() else tensor
