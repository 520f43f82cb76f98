"""Replay: runs through an ensemble in the order in which they were made, predicting before learning."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from usvlearn.estimator import rollout
from usvlearn.estimators.ensemble import Ensemble, EnsembleState
from usvlearn.signals import Fleet, Run, tree_map


class Position(NamedTuple):
    """A place in a fleet's runs: so many steps of the run with that index are done."""

    run: int
    step: int


class Chunk(NamedTuple):
    """A stretch of one run, replayed."""

    begin: Position
    end: Position
    state: EnsembleState  # at the end; leaves (boats, ...)
    predictions: np.ndarray  # (time, boats, estimators) m/s, NaN where no step was made
    due: tuple[bool, ...]  # per boat: whether a parameter set is to be saved at the end


def replay(
    ensemble: Ensemble,
    fleet: Fleet,
    state: EnsembleState,
    begin: Position = Position(0, 0),
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
        save_every: steps between two parameter sets of a boat; one more falls due at the end of each of its runs.

    Yields:
        Chunks in order; together they cover each run once.
    """
    dtype = state.predictions.dtype
    for index in range(begin.run, len(fleet.runs)):
        run = fleet.runs[index]
        done = begin.step if index == begin.run else 0
        for stop in _stops(run, every, save_every):
            if stop <= done:
                continue
            samples = tree_map(lambda x, a=done, b=stop: _tensor(x[a:b], dtype), run.samples)
            with torch.no_grad():
                state, _, predictions = rollout(ensemble, state, samples, record=lambda s: s.predictions)
            stepped = run.samples.fresh[done:stop, :, None] & (run.samples.inputs.dt[done:stop, :, None] != 0)
            due = tuple(is_due(n, stop, save_every) for n in run.lengths)
            yield Chunk(
                Position(index, done),
                Position(index, stop),
                state,
                np.where(stepped, predictions.numpy(), np.nan),
                due,
            )
            done = stop


def is_due(length: int, step: int, save_every: int) -> bool:
    """Whether a boat whose run has `length` steps saves a parameter set at `step`."""
    return 0 < step <= length and (step == length or step % save_every == 0)


def last_due(length: int, step: int, save_every: int) -> int:
    """The last step up to `step` at which a boat whose run has `length` steps saves; 0 where there is none.

    >>> last_due(1000, 800, 750), last_due(1000, 1200, 750), last_due(1000, 700, 750)
    (750, 1000, 0)
    """
    return length if step >= length else step // save_every * save_every


def _stops(run: Run, every: int, save_every: int) -> list[int]:
    longest = max(run.lengths)
    stops = {*range(every, longest, every), *range(save_every, longest, save_every), *run.lengths} - {0}
    return sorted(stops)


def _tensor(x: np.ndarray, dtype: torch.dtype) -> torch.Tensor:
    tensor = torch.from_numpy(x)
    return tensor.to(dtype) if tensor.is_floating_point() else tensor
