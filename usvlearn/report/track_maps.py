"""Tracks of each boat's last mission, which is replayed, forecast at moments of it with the commands that came."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.checkpoint import checkpoints
from usvlearn.core.forecasts import Track
from usvlearn.core.samples import Fleet, PlanarSample, Sample
from usvlearn.engine.online import Online
from usvlearn.engine.validate import read_checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.planar.state import HEADING, NORTH, TURN
from usvlearn.evaluation.season import Season, SeasonRun
from usvlearn.runs.files import CHECKPOINTS, PLANAR, digest, runs_file
from usvlearn.runs.prediction_files import position

EVERY, MOST = 10.0, 240  # s between two tracks, at least; and how many, at most
LEAST = 120.0  # s of a mission, if there is one of that length
UNEVEN = 0.05  # of a step's usual length: a plan has steps of one length
LEVEL = 0.9  # of the ellipses

Scores = Mapping[str, Mapping[str, Any]]  # horizon -> of `usvlearn.evaluation.horizons.track_scores`


class Ellipse(NamedTuple):
    """Where the boat is with 90 % at a horizon."""

    horizon: float  # s
    step: int  # of the track, whose end is its centre
    major: float  # m, semi-axis; infinite where nothing is known
    minor: float  # m
    bearing: float  # rad, of the major


class Ahead(NamedTuple):
    """A track that was forecast at one moment."""

    step: int  # of the run, at whose end it begins
    time: np.ndarray  # (steps,) s from then
    north: np.ndarray  # (steps,) m from the boat's position then
    east: np.ndarray
    turn: float  # rad, by which the heading changes, in either direction
    ellipses: tuple[Ellipse, ...]

    @property
    def drawn(self) -> list[Ellipse]:
        """The ellipses that fit on a map: their semi-axes are at most the length of the track until their horizon."""
        gone = np.cumsum(np.hypot(np.diff(self.north, prepend=0), np.diff(self.east, prepend=0)))
        return [each for each in self.ellipses if each.major <= gone[each.step]]


class Mission(NamedTuple):
    """A mission, replayed."""

    run: SeasonRun
    position: np.ndarray  # (time, 2) m north and east; NaN where unknown
    pose: np.ndarray  # (time, 2) heading, rad, and yaw rate, rad/s
    logged: bool  # else the position is reckoned from speed and heading
    learned: bool  # whether the boat has learned from the mission before it was replayed
    ahead: tuple[Ahead, ...]


class BoatTracks(NamedTuple):
    """Scores of a boat's tracks, and its last mission."""

    scores: Scores  # {} of a run that is not finished
    mission: Mission | None
    lacks: str = ""  # why there is no mission, a sentence


def saved_tracks(
    folders: Sequence[Path], outcomes: Sequence[Mapping[str, Any]], seasons: Sequence[Season], fleets: Sequence[Fleet]
) -> dict[str, BoatTracks]:
    """The tracks of each boat from the newest run that has any; no boat without."""
    tracks = {}
    for season in seasons:
        for folder, results in zip(reversed(folders), reversed(outcomes), strict=True):
            scores = (results.get("tracks") or {}).get(season.boat) or {}
            begun = not results and checkpoints(folder / PLANAR / CHECKPOINTS / season.boat)
            if begun or any(row["count"] for row in scores.values()):
                try:
                    tracks[season.boat] = BoatTracks(scores, last_mission(folder, season, fleets))
                except (CheckpointError, ConfigError) as error:
                    tracks[season.boat] = BoatTracks(scores, None, f"{season.boat}: there is no map: {error}.")
                break
    return tracks


def last_mission(folder: Path, season: Season, fleets: Sequence[Fleet]) -> Mission | None:
    """Replay a boat's last mission, and forecast tracks on the way; None if its logs tell no positions.

    It begins with the newest checkpoint that has not learned from the mission, or else with the newest.
    """
    long = [each for each in season.runs if each.time[-1] - each.time[0] >= LEAST]
    run = (long or season.runs)[-1]
    if (poses := _poses(season.boat, run.key, fleets)) is None or not np.isfinite(poses[:, NORTH:]).any():
        return None
    keys = [key for _, _, key in runs_file(folder)["boats"].get(season.boat, [])]
    index = keys.index(run.key) if run.key in keys else len(keys)
    paths = checkpoints(folder / PLANAR / CHECKPOINTS / season.boat)
    if not paths:
        raise CheckpointError(f"{folder / PLANAR}: has no checkpoint of {season.boat}")
    before = [path for path in paths if (at := position(path)) is not None and at.run < index]
    made = tuple(forecast_along(Online.of(*read_checkpoint((before or paths)[-1])), run, poses))
    return Mission(run, poses[:, NORTH:], poses[:, [HEADING, TURN]], run.position is not None, not before, made)


def _poses(boat: str, key: str, fleets: Sequence[Fleet]) -> np.ndarray | None:
    """What the log of a run says of the boat's pose, `(time, 5)`."""
    for fleet in (each for each in reversed(fleets) if boat in each.boats):
        element = fleet.boats.index(boat)
        for run in reversed(fleet.runs):
            if run.poses is not None and run.lengths[element] and digest(run, element) == key:
                return run.poses[: run.lengths[element], element]
    return None


def forecast_along(online: Online, run: SeasonRun, poses: np.ndarray) -> list[Ahead]:
    """Learn from a run, and forecast tracks at moments of it, to the longest horizon or the next gap."""
    horizons = ((online.description or {}).get("vectors") or {}).get("horizons")
    if not horizons:
        raise ConfigError(f"{run.name}: found a checkpoint without tracks, expected one below {PLANAR}")
    inputs, usual = run.samples.inputs, run.spacing
    even = run.masks.steps & (np.abs(inputs.dt - usual) <= UNEVEN * usual)
    gaps = np.append(np.flatnonzero(~even), len(even))
    commands = np.clip(np.stack([inputs.command_left, inputs.command_right], -1), -1, 1)
    columns = [x.tolist() for x in (*inputs, run.samples.surge, run.samples.fresh, run.samples.measured)]
    rows, tracks, after = poses.tolist(), [], max(EVERY, float(np.nanmax(run.time)) / MOST)
    due, most = after, round(horizons[-1] / usual) if usual else 0
    for k, values in enumerate(zip(*columns, strict=True)):
        online.step(PlanarSample(Sample(type(inputs)(*values[:-3]), *values[-3:]), *rows[k]))
        end = min(k + 1 + most, int(gaps[np.searchsorted(gaps, k + 1)]))
        if run.time[k] >= due and even[k] and np.isfinite(poses[k, [HEADING, NORTH]]).all() and end > k + 1:
            track = online.forecast(commands[k + 1 : end], dt=usual)
            if track.time[-1] >= horizons[0]:
                tracks.append(_ahead(k, track, horizons))
                due = run.time[k] + after
    return tracks


def _ahead(step: int, track: Track, horizons: Sequence[float]) -> Ahead:
    """A track of one boat with its ellipses, as far as its steps go."""
    axes = track.ellipse(LEVEL)
    at = [int(np.searchsorted(track.time, h + 1e-6, side="right")) - 1 for h in horizons if h <= track.time[-1] + 1e-6]
    ellipses = [Ellipse(h, i, *(float(x[i]) for x in axes)) for h, i in zip(horizons, at, strict=False) if i >= 0]
    turn = float(np.abs(np.diff(track.heading)).sum())
    return Ahead(step, track.time, track.north, track.east, turn, tuple(ellipses))
