"""Replay: runs through an ensemble in the order in which they were made, predicting before learning."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from usvlearn.estimators.ensemble.layer import Ensemble, EnsembleState
from usvlearn.estimators.ensemble.monitors import effectiveness
from usvlearn.rollouts import rollout
from usvlearn.runs.published import BEGIN, Position
from usvlearn.signals import Fleet, Sample, tree_map

THRUSTERS = "monitors.thrusters."  # before the names of a state's leaves


class Chunk(NamedTuple):
    """A stretch of one run, replayed."""

    begin: Position
    end: Position
    state: EnsembleState  # at the end; leaves (boats, ...)
    published: dict[str, np.ndarray]  # see `runs.published`, (time, boats, …), NaN where no step was made
    save: bool  # whether parameter sets are due at the end

    @property
    def predictions(self) -> np.ndarray:
        """m/s, `(time, boats, estimators)`, NaN where no step was made."""
        return self.published["predictions"]


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
        fleet: aligned runs; see `usvlearn.logs.recordings.align_fleet`.
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
                state, _, kept = rollout(ensemble, state, tensors(part, dtype), record=_recorded(state))
                published = _published(state, kept)
            stepped = (part.fresh & (part.inputs.dt != 0))[..., None]
            yield Chunk(
                Position(index, done),
                Position(index, stop),
                state,
                {name: np.where(stepped, array.numpy(), np.nan) for name, array in published.items()},
                stop == length or stop % save_every == 0,
            )
            done = stop


def _recorded(state: EnsembleState) -> list[str]:
    """The leaves that are kept of every step."""
    thrusters = [f"{THRUSTERS}{leaf}" for leaf in ("evidence", "sums", "raised")] if state.monitors else []
    return ["predictions", "halfwidths", *thrusters]


def _published(state: EnsembleState, kept: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """What is published of every step, from the leaves that were kept."""
    published = {name: kept[name] for name in ("predictions", "halfwidths")}
    if not state.monitors:
        return published
    health = state.monitors.thrusters._replace(evidence=kept[f"{THRUSTERS}evidence"], sums=kept[f"{THRUSTERS}sums"])
    alarm = kept[f"{THRUSTERS}raised"].amax(-1, keepdim=True)
    return published | {"thrusters": torch.cat([effectiveness(health)[0], health.evidence, alarm], -1)}


def tensors(samples: Sample, dtype: torch.dtype) -> Sample:
    """Samples of a fleet as tensors; numbers have the dtype, masks are what they were."""
    as_tensors = tree_map(torch.from_numpy, samples)
    return tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, as_tensors)
