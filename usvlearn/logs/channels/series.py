"""What readers of logs do, and all numbers of a log, before anybody has said what they mean: for `usvlearn inspect`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Channel, Source


class Series(NamedTuple):
    """All values of one name and field of a log, as they stand there.

    A reader's `survey(path)` gives them in the order of the log. Text is left out, as are arrays of more than
    `ELEMENTS` numbers.
    """

    name: str  # column, variable, topic or message: a `Source.name` that finds it
    field: str | None  # a `Source.field` that finds it; None where the reader has no fields
    time: np.ndarray  # (n,) float64, s since the log's start, as in a `Channel`
    value: np.ndarray  # (n,) float64 as logged, NaN where there was no number
    order: np.ndarray  # (n,) int64, place in the log
    unit: str = ""  # as the log declares it, such as "deg" or "km/h" of a header "Speed (km/h)"; "" where it does not
    kind: str = ""  # type of the message or the posting app, where there is one
    start: float = math.nan  # as of a `Channel`


ELEMENTS = 16  # of an array, at most


class OtherBoats(LogFormatError):
    """No row of a log is of the boat that is read."""


class Reader(Protocol):
    """A reader of one log: `Alog`, `DataFlash`, `Rosbag`, `Table`, `Tlog`, `Ulog`.

    A reader may have a `marker`, the name of a file and what it contains: a folder with such a file is one log. Or it
    may have a method `is_log(folder, files, names)`, which tells this from a folder's files and the names of channels.

    >>> from tempfile import TemporaryDirectory
    >>> from usvlearn.logs.formats.moos.alog import Alog
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.alog"
    ...     _ = path.write_text("0.5 NAV_SPEED iGPS 1.2\\n0.9 NAV_SPEED iGPS off\\n")
    ...     channels, dropped = Alog().read(path, {"surge": Source("NAV_SPEED")})
    ...     survey = [(each.name, each.value.tolist()) for each in Alog().survey(path)]
    >>> channels["surge"].value, dropped, survey
    (array([1.2]), {'surge': {'not_a_number': 1}}, [('NAV_SPEED', [1.2, nan])])
    """

    suffixes: ClassVar[tuple[str, ...]]

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        """The channels of a log.

        Args:
            path: the log, a file or a folder that is one.
            sources: channel -> where it is found.

        Returns:
            The channels, in SI units; and the counts of unusable values: channel -> cause -> count.

        Raises:
            LogFormatError: the file is no log of this format, or lacks a channel.
            MissingExtraError: the package that reads it is not installed.
        """
        ...

    def survey(self, path: Path) -> list[Series]:
        """All numbers that a log holds, also while a vehicle is disarmed; without images and stamps.

        Columns and variables have numbers in at least half of their cells; a quaternion is its yaw.

        Args:
            path: as of `read`.

        Returns:
            The numbers, as they stand in the log, in their order there.

        Raises:
            LogFormatError, MissingExtraError: as `read`.
        """
        ...
