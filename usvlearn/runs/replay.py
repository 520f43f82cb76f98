"""Replay: runs through an ensemble in the order in which they were made, predicting before learning."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from usvlearn.core.samples import Fleet, masks, tree_map
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.estimators.ensemble.accommodation.layer import thrust_remaining
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.planar.layer import Planar, PlanarState
from usvlearn.runs.prediction_files import BEGIN, Position

THRUSTERS = tuple(
    f"monitors.thrusters.{name}" for name in ("evidence", "share", "deviation", "raised")
)  # leaves of a state
GIVEN = tuple(f"accommodation.{name}" for name in ("handed", "share", "deviation"))
FORECASTS = {"forecasts": "predictions", "forecast_halfwidths": "halfwidths"}  # published, and its leaf


class Chunk(NamedTuple):
    """A stretch of one run, replayed."""

    begin: Position
    end: Position
    state: EnsembleState  # at the end; leaves (boats, ...)
    published: dict[str, np.ndarray]  # see `runs.prediction_files`, (time, boats, …), NaN where no step was made
    surge: np.ndarray  # (time, boats) m/s, the speeds that were learned from; NaN elsewhere
    save: bool  # whether checkpoints are saved at the end
    planar: PlanarState | None = None  # likewise, with sway, yaw rate and tracks


def replay(
    ensemble: Ensemble,
    fleet: Fleet,
    state: EnsembleState,
    begin: Position = BEGIN,
    every: int = 750,
    save_every: int = 750,
    planar: Planar | None = None,
    beside: PlanarState | None = None,
) -> Iterator[Chunk]:
    """Run a fleet's samples through an ensemble, all boats as batch elements, and yield it in chunks of at most `every`
    steps.

    The state, leaves `(boats, ...)`, is carried from run to run, as a boat carries its parameters from mission to
    mission. A chunk with a checkpoint ends after `save_every` steps, and at the end of each run. `planar` learns sway
    and yaw rate beside the ensemble, and makes tracks, from the state `beside`.
    """
    places, filters = list(_places(fleet, begin, every, save_every)), ensemble.accommodated
    samples = [run.samples if planar is None else run.planar for run in fleet.runs]
    parts = (tree_map(lambda x, a=a, b=b: x[a:b], samples[run]) for run, a, b, _ in places)
    names, whole = _recorded(state, filters), None
    if planar is None:
        replayed: Iterator[Any] = chunked_rollout(ensemble, state, parts, names)
    else:
        first = (planar.init((len(fleet.boats),)) if beside is None else beside)._replace(surge=state)
        replayed = chunked_rollout(planar, first, parts, [*(f"surge.{name}" for name in names), "track.due"])
    for (run, done, stop, save), (after, recorded) in zip(places, replayed, strict=True):
        state = after
        if planar is not None:
            whole, state = after, after.surge
            recorded = {name.removeprefix("surge."): x for name, x in recorded.items()}
        part = tree_map(lambda x, a=done, b=stop: x[a:b], fleet.runs[run].samples)
        mask = masks(part, ensemble.surge_limit)
        stepped, surge = mask.steps[..., None], np.where(mask.learns, part.surge, np.nan)
        published = {name: np.where(stepped, x, np.nan) for name, x in _published(state, recorded, filters).items()}
        if planar is not None:
            published["tracks"] = np.where(stepped, flat(recorded["track.due"]), np.nan)
        yield Chunk(Position(run, done), Position(run, stop), state, published, surge, save, whole)


def _places(fleet: Fleet, begin: Position, every: int, save_every: int) -> Iterator[tuple[int, int, int, bool]]:
    """For each chunk: index of the run, first step, end, and whether checkpoints are saved there."""
    for index in range(begin.run, len(fleet.runs)):
        length, done = len(fleet.runs[index].time), begin.step if index == begin.run else 0
        for stop in sorted({*range(every, length, every), *range(save_every, length, save_every), length}):
            if stop > done:
                yield index, done, stop, stop == length or stop % save_every == 0
                done = stop


def flat(x: np.ndarray) -> np.ndarray:
    """Numbers `(time, boats, …)` as `(time, boats, columns)`."""
    return x.reshape(*x.shape[:2], -1)


def _recorded(state: EnsembleState, filters: Sequence[str]) -> list[str]:
    """The names of the leaves that are recorded at every step."""
    thrusters = THRUSTERS if state.monitors else ()
    given = (*GIVEN, *map(_changes, filters)) if filters else ()
    forecasts = [f"forecasts.{leaf}" for leaf in FORECASTS.values()] if state.forecasts else []
    return ["predictions", "halfwidths", *thrusters, *given, *forecasts]


def _changes(name: str) -> str:
    """The leaf that counts the changes that a filter has confirmed."""
    return f"members.{name}.trial.changes"


def _published(state: EnsembleState, recorded: dict[str, np.ndarray], filters: Sequence[str]) -> dict[str, np.ndarray]:
    """What is published of every step, computed from the recorded leaves."""
    published = {name: recorded[name] for name in ("predictions", "halfwidths")}
    if state.forecasts:
        published |= {name: flat(recorded[f"forecasts.{leaf}"]) for name, leaf in FORECASTS.items()}
    if not state.monitors:
        return published
    thrusters = {name.rpartition(".")[2]: recorded[name] for name in THRUSTERS}
    evidence, raised = thrusters["evidence"][..., :2], thrusters["raised"]
    health = state.monitors.thrusters._replace(**{name: torch.from_numpy(x) for name, x in thrusters.items()})
    handed, given = np.zeros_like(raised), state.accommodation
    if filters:
        handed = recorded[GIVEN[0]]
        given = given._replace(**{name.rpartition(".")[2]: torch.from_numpy(recorded[name]) for name in GIVEN})
    share, deviation = (x.numpy() for x in thrust_remaining(health, given))
    changes = [recorded[_changes(name)][..., None] for name in filters]
    return published | {
        "thrusters": np.concatenate([share, evidence, raised.max(-1, keepdims=True)], -1),
        "health": np.concatenate([deviation, raised, handed, *changes], -1),
    }
