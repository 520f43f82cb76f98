"""All numbers that a log holds, before anybody has said what they mean: what `usvlearn inspect` looks at."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


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
