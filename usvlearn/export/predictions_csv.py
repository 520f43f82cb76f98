"""A run's predictions and inputs as one table, CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from itertools import chain

from usvlearn.export.published_steps import COLUMNS, Stretch

UNITS = {"time": "s", "measured_surge": "m/s", "heading": "rad", "yaw_rate": "rad/s", "dt": "s"}  # commands: shares


def csv_table(stretches: Iterable[Stretch]) -> bytes:
    """The text: a row for each step, an empty cell where a number is unknown.

    Columns: run, time, measured_surge, inputs, then `NAME` and `NAME_halfwidth` of each estimator. Numbers are written
    so that they are read again as the same.
    """
    iterator = iter(stretches)
    first = next(iterator)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", *COLUMNS, *chain(*((name, f"{name}_halfwidth") for name in first.estimators))])
    for each in chain([first], iterator):
        for k in range(len(each.predicted)):
            pairs = chain(*zip(each.predicted[k].tolist(), each.halfwidths[k].tolist(), strict=True))
            numbers = [*(float(values[k]) for values in each.columns.values()), *pairs]
            writer.writerow([each.run, *("" if math.isnan(x) else repr(x) for x in numbers)])
    return text.getvalue().encode()
