"""A run's predictions and inputs as one table, CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from itertools import chain

from usvlearn.errors import CheckpointError
from usvlearn.model.export.published_steps import COLUMNS, Stretch


def csv_table(stretches: Iterable[Stretch]) -> bytes:
    """The text: a row for each step, an empty cell where a number is unknown.

    Columns: run, time, measured_surge, inputs, then `NAME` and `NAME_halfwidth` of each estimator. Numbers are written
    so that they are read again as the same.

    Raises:
        CheckpointError: the files of the run are of several ensembles.
    """
    iterator = iter(stretches)
    first = next(iterator)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["run", *COLUMNS, *chain(*((name, f"{name}_halfwidth") for name in first.estimators))])
    for each in chain([first], iterator):
        if each.estimators != first.estimators:
            raise CheckpointError(
                f"predictions of {each.run}: found the estimators {', '.join(each.estimators)}, expected those of the "
                f"runs before, {', '.join(first.estimators)}: make the run anew"
            )
        for k in range(len(each.predicted)):
            pairs = chain(*zip(each.predicted[k].tolist(), each.halfwidths[k].tolist(), strict=True))
            numbers = [*(float(values[k]) for values in each.columns.values()), *pairs]
            writer.writerow([each.run, *(repr(x) if math.isfinite(x) else "" for x in numbers)])
    return text.getvalue().encode()
