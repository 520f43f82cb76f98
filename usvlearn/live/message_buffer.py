"""The messages of the last minutes, on which a node runs the data check that a replay runs on its logs."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Channel, Recording
from usvlearn.logs.setup import Setup

MOST = 20_000  # messages of a channel, at most: half an hour at 10 Hz
LIVE_KNOWS = ("stale",)  # kinds of findings that the health of a node tells itself
PASSING = ("rejected", "jumps", "frozen", "clock drift")  # kinds that are told only while the last messages have them
LAST = 6  # part of the messages that counts as the last
ABOARD = {  # what helps ashore -> what helps aboard
    "sort the rows of the log by their stamps": "stamps that rise: set patience to the longest delay of a message",
    "leave out rows whose stamps lie in the future": "stamps that do not lie in the future: set the sender's clock",
    "write those of two boats or sensors to a log of each": "send those of two boats or sensors under two names",
    "; or leave out the log": "", ", or leave out the log": "", "data.channels.": "", "vehicle.surge_max": "surge_max",
    "set align.": "start from a run with align.",
}  # fmt: skip
Columns = dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]  # channel -> time, value and place of its messages
LEAST = 300  # of each channel; with fewer nothing is checked


class Recent:
    """Keeps the last messages of each channel, in SI units."""

    def __init__(self, setup: Setup):
        self._setup, self._count = setup, 0
        self._columns: dict[str, tuple[array, array, array]] = {}

    def add(self, channel: str, time: float, value: float) -> None:
        """Keep one message, s and SI units."""
        columns = self._columns.get(channel)
        if columns is None:
            columns = self._columns[channel] = array("d"), array("d"), array("q")
        self._count += 1
        columns[0].append(time)
        columns[1].append(value)
        columns[2].append(self._count)

    @property
    def full(self) -> bool:
        """Whether the messages are so many that they are to be forgotten."""
        return any(len(time) >= MOST for time, _, _ in self._columns.values())

    def clear(self, keep_held: bool = False) -> None:
        """Forget all messages, or all but the commands in force."""
        held = {name for name, each in self._setup.aligned.items() if each.held and keep_held}
        self._columns = {k: (x[0][-1:], x[1][-1:], x[2][-1:]) for k, x in self._columns.items() if k in held}

    def copy(self) -> Columns:
        """Time, value and place of the messages of each channel."""
        return {
            name: (np.array(columns[0]), np.array(columns[1]), np.array(columns[2]))
            for name, columns in self._columns.items()
        }

    def findings(self, columns: Columns, boat: str, horizons: Sequence[float] = ()) -> list[str]:
        """What the data check says of `copy`: sentences, warnings only."""
        sources = self._setup.aligned
        few = [k for k, x in sources.items() if k not in columns or (len(columns[k][0]) < LEAST and not x.held)]
        if few:
            return []
        found = self._check(columns, boat, horizons)
        if any(kind in PASSING for kind, _ in found):
            end = max(order[-1] for _, _, order in columns.values())
            begin = end - sum(len(order) for _, _, order in columns.values()) // LAST
            last = {k: (time[x > begin], value[x > begin], x[x > begin]) for k, (time, value, x) in columns.items()}
            lasts = {kind for kind, _ in self._check(last, boat, horizons)}
            found = [each for each in found if each[0] in lasts or each[0] not in PASSING]
        for ashore, aboard in ABOARD.items():
            found = [(kind, sentence.replace(ashore, aboard)) for kind, sentence in found]
        return [sentence for _, sentence in found]

    def _check(self, columns: Columns, boat: str, horizons: Sequence[float]) -> list[tuple[str, str]]:
        """Kinds and sentences of the warnings."""
        from usvlearn.logs.checks.data_check import check_data
        from usvlearn.logs.checks.finding import WARNING
        from usvlearn.logs.recordings import align_fleet

        recording = recording_of(self._setup, columns, boat, "live")
        declared = self._setup.json()["channels"]
        top = math.inf if self._setup.surge_max is None else self._setup.surge_max
        try:
            fleet = align_fleet([recording], **self._setup.align)
        except LogFormatError:  # the check says why
            fleet = None
        findings = check_data([recording], fleet, self._setup.align, top, declared, horizons)
        return [(x.kind, x.sentence()) for x in findings if x.severity == WARNING and x.kind not in LIVE_KNOWS]


def recording_of(setup: Setup, columns: Mapping[str, Sequence[np.ndarray]], boat: str, run: str) -> Recording:
    """The messages of `Recent.copy` as a log."""
    channels = {}
    for name, (time, value, order) in columns.items():
        source = setup.aligned[name]
        channels[name] = Channel(time, value, order, source.held, source.window, source.delay, source.period)
    return Recording(boat, run, channels, {})
