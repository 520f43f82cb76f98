"""Prepared samples: what the kernels read, computed once a sample.

`prepare` decides as `usvlearn.core.samples.masks` does, and a test compares the two.
"""

import numpy as np

from usvlearn.core.arrays import fill
from usvlearn.core.jit import jit
from usvlearn.core.samples import PLAUSIBLE_INPUTS

# Places in a prepared sample: the inputs of a step, the speed, and the mode: one of the four below.
LEFT, RIGHT, SIN, COS, YAW_RATE, DT, SURGE, MODE = range(8)
ROW = 8
HOLD, START, PREDICT, LEARN = range(4)

ABSURD_COMMAND, _, ABSURD_HEADING, ABSURD_YAW_RATE, ABSURD_DT = PLAUSIBLE_INPUTS


@jit
def prepare(left, right, heading, yaw_rate, dt, surge, fresh, measured, heads, limit, row):
    """Write one prepared sample; sine and cosine of the heading where an estimator needs them (`heads`), else itself.

    A speed at or beyond `limit`, m/s, counts as missing.
    """
    row[DT] = dt  # which may be 0 in float32
    begins = row[DT] == 0
    steps = (
        fresh and row[DT] > 0 and dt < ABSURD_DT and abs(left) < ABSURD_COMMAND and abs(right) < ABSURD_COMMAND
        and abs(heading) < ABSURD_HEADING and abs(yaw_rate) < ABSURD_YAW_RATE
    )  # fmt: skip
    known = abs(surge) < limit
    if steps:
        row[LEFT], row[RIGHT], row[YAW_RATE] = left, right, yaw_rate
        row[SIN], row[COS] = (np.sin(heading), np.cos(heading)) if heads else (heading, 0.0)
        row[MODE] = LEARN if measured and known else PREDICT
    else:
        fill(row[:SURGE], 0.0)
        row[MODE] = START if begins and known else HOLD
    row[SURGE] = surge if known else 0.0


@jit(entry=True)
def prepare_all(left, right, heading, yaw_rate, dt, surge, fresh, measured, heads, limit, rows):
    """`prepare` of samples `(time, columns)`; rows are `(columns, time, ROW)`."""
    for column in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            prepare(left[k, column], right[k, column], heading[k, column], yaw_rate[k, column], dt[k, column],
                    surge[k, column], fresh[k, column], measured[k, column], heads, limit, rows[column, k])  # fmt: skip
