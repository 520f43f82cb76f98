"""Joins recordings to a `Fleet`: each boat is a batch element, with its runs one after the other."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from usvlearn.core.activity import doing
from usvlearn.core.samples import Fleet, Inputs, PlanarSample, Run, Sample, tree_map
from usvlearn.errors import ConfigError, LogFormatError, under
from usvlearn.logs.alignment.align import Aligned, align
from usvlearn.logs.channels.channel import CHANNELS, COMMANDS, Recording
from usvlearn.logs.channels.poses import poses
from usvlearn.logs.channels.positions import track

POSE = len(PlanarSample._fields) - 1  # numbers of a pose
SHORTEST = 3  # least number of samples in a run


def align_fleet(recordings: Iterable[Recording], **options) -> Fleet:
    """Align recordings and set the boats side by side; the k-th run of every boat shares the k-th batch.

    Each boat's recordings come in the order in which they are replayed; the options are those of `Aligner`. A run of
    less than three samples is left out with a warning, or a LogFormatError if there is no other.
    """
    boats: dict[str, list[BoatRun]] = {}
    rejected: dict[str, dict[str, dict[str, int]]] = {}
    short = []
    for recording in recordings:
        if recording.boat in ("", ".", "..") or set(recording.boat) & set("/\\"):
            raise ConfigError(f"data.boat: found the name {recording.boat!r}, expected one that can name a folder")
        with under("align", options):
            doing(f"aligning {recording.boat}, run {recording.run}")
            used = {name: recording.channels[name] for name in CHANNELS if name in recording.channels}
            aligned = align(used, **options)
        counts = rejected.setdefault(recording.boat, {})
        for channel, causes in (*recording.dropped.items(), *aligned.rejected.items()):
            for cause, count in causes.items():
                if count:
                    total = counts.setdefault(channel, {})
                    total[cause] = total.get(cause, 0) + count
        steps = int(aligned.samples.measured.sum())
        if steps < SHORTEST:
            lost = [f"{name} {cause} {n}" for name, causes in aligned.rejected.items() for cause, n in causes.items()]
            reasons = ", ".join(lost) or "nothing"
            short.append(f"{recording.boat}, run {recording.run}: {steps} (rejected: {reasons})")
        else:
            position = track(recording.channels, aligned.time)
            pose = poses(recording.channels, aligned.time, aligned.samples, aligned.came)
            boats.setdefault(recording.boat, []).append(BoatRun(recording.run, aligned, position, pose))
    if not boats:
        raise LogFormatError(
            f"measured steps: expected at least {SHORTEST} in a run, found {'; '.join(short[:3]) or 'no run'}: "
            "give a longer log, or fix what was rejected (window, held, unit of channels; limits, patience of align)"
        )
    for text in short:
        warnings.warn(f"run left out, expected at least {SHORTEST} measured steps: {text}", stacklevel=2)
    runs = [_side_by_side([boats[boat][k] if k < len(boats[boat]) else None for boat in boats])
            for k in range(max(map(len, boats.values())))]  # fmt: skip
    return Fleet(tuple(boats), tuple(runs), rejected)


def delayed(recordings: Iterable[Recording], delay: float) -> list[Recording]:
    """The recordings, with a delay of the commands of both sides, s, in place of their own."""
    return [
        one._replace(channels=one.channels | {side: one.channels[side]._replace(delay=delay) for side in COMMANDS})
        for one in recordings
    ]


class BoatRun(NamedTuple):
    """A run of one boat."""

    name: str
    aligned: Aligned
    position: np.ndarray | None  # (time, 2) m
    poses: np.ndarray  # (time, 5), see `usvlearn.logs.channels.poses`


def _side_by_side(elements: list[BoatRun | None]) -> Run:
    """One run per boat, padded to the longest with samples that are neither fresh nor measured."""
    lengths = [0 if element is None else len(element.aligned.time) for element in elements]
    longest = max((each.aligned for each in elements if each is not None), key=lambda aligned: len(aligned.time))
    shape = (max(lengths), len(elements))

    def empty(fill) -> np.ndarray:
        return np.full(shape, fill, dtype=type(fill))

    dt = float(longest.samples.inputs.dt.max())
    inputs = Inputs(empty(0.0), empty(0.0), empty(0.0), empty(0.0), empty(dt))
    padded = Sample(inputs, empty(np.nan), empty(False), empty(False))
    time, position, pose = empty(np.nan), np.full((*shape, 2), np.nan), np.full((*shape, POSE), np.nan)
    for element, one in enumerate(elements):
        if one is not None:
            part = slice(lengths[element]), element
            own, step = one.aligned.time, one.aligned.samples.inputs.dt.max(initial=0.0)
            ahead = np.diff(own, prepend=own[:1])
            time[part] = own - own[0] + np.cumsum(np.where(ahead < 0, step - ahead, 0.0))  # a clock set back goes on
            tree_map(lambda whole, x, part=part: whole.__setitem__(part, x), padded, one.aligned.samples)
            pose[part] = one.poses
            if one.position is not None:
                position[part] = one.position
    names = tuple("" if element is None else element.name for element in elements)
    known = any(element is not None and element.position is not None for element in elements)
    return Run(time, padded, names, tuple(lengths), position if known else None, pose)
