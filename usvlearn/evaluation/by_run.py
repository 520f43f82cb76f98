"""Errors of each run of each boat, which a comparison of jobs pairs: `errors.csv` in a run's folder.

    boat, run, ahead, steps, ESTIMATOR…     MAE in m/s; empty where it is unknown

`ahead` is `step` (one step ahead), a horizon in s such as `10`, or `free`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, masks, tree_map
from usvlearn.evaluation.free_simulation import FreeErrors
from usvlearn.evaluation.horizons import HorizonSums, means
from usvlearn.evaluation.metrics import Stretch

STEP, FREE = "step", "free"
HEAD = ("boat", "run", "ahead", "steps")


class RunError(NamedTuple):
    """The errors of one run of one boat."""

    boat: str
    run: str
    ahead: str  # see above
    steps: int
    mae: Mapping[str, float]  # m/s, by estimator, those that are known


def one_step_sums(
    fleet: Fleet, published: Iterable[Stretch], count: int, surge_limit: float = PLAUSIBLE
) -> tuple[np.ndarray, np.ndarray]:
    """Sums of |error| one step ahead, `(runs, boats, count)`, NaN after a divergence; measured steps, `(runs, boats)`.

    Args:
        fleet: what was replayed.
        published: stretches with `predictions`.
        count: of the estimators.
        surge_limit: m/s, of the ensemble.
    """
    total = np.zeros((len(fleet.runs), len(fleet.boats), count))
    steps = np.zeros(total.shape[:2], int)
    for run, step, arrays in published:
        predictions = arrays["predictions"]
        part = slice(step, step + len(predictions))
        samples = tree_map(lambda x, part=part: x[part], fleet.runs[run].samples)
        learns = masks(samples, surge_limit).learns
        error = np.abs(predictions - np.where(learns, samples.surge, 0.0)[..., None])
        total[run] += np.where(learns[..., None], error, 0.0).sum(0)
        steps[run] += learns.sum(0)
    return total, steps


def run_errors(
    fleet: Fleet,
    names: Sequence[str],
    one_step: tuple[np.ndarray, np.ndarray],
    ahead: HorizonSums | None,
    free: FreeErrors | None,
) -> Iterator[RunError]:
    """All errors by run; runs without a measured step, or without a forecast that became due, have none.

    Args:
        fleet: what was replayed.
        names: of the estimators.
        one_step: of `one_step_sums`.
        ahead: of `usvlearn.evaluation.horizons.horizon_sums`.
        free: of `usvlearn.evaluation.free_simulation.free_errors`.
    """
    kinds = [(STEP, names, *one_step, 0 * one_step[0])]
    if ahead is not None:
        kinds += [(f"{horizon:g}", ahead.names, ahead.errors[:, :, j], ahead.steps[:, :, j], ahead.missing[:, :, j])
                  for j, horizon in enumerate(ahead.horizons)]  # fmt: skip
    kinds += [] if free is None else [(FREE, names, free.errors, free.steps, 0 * free.errors)]
    for kind, columns, total, count, missing in kinds:
        for element, boat in enumerate(fleet.boats):
            for index, run in enumerate(fleet.runs):
                if steps := int(count[index, element]):
                    maes = means(total[index, element], steps, missing[index, element])
                    known = {name: mae for name, mae in zip(columns, maes.tolist(), strict=True) if np.isfinite(mae)}
                    yield RunError(boat, run.names[element], kind, steps, known)


def as_csv(errors: Iterable[RunError], names: Sequence[str]) -> str:
    """A table of `run_errors`.

    >>> print(as_csv([RunError("heron", "a.alog", "10", 40, {"aid": 0.1})], ["aid", "rls"]))
    boat,run,ahead,steps,aid,rls
    heron,a.alog,10,40,0.1,
    <BLANKLINE>
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*HEAD, *names])
    for each in errors:
        writer.writerow([*each[:4], *(each.mae.get(name) for name in names)])
    return text.getvalue()


def from_csv(text: str) -> list[RunError]:
    """What `as_csv` wrote.

    Raises:
        ValueError: it is damaged.

    >>> from_csv(as_csv([RunError("heron", "a.alog", "10", 40, {"aid": 0.1})], ["aid", "rls"]))
    [RunError(boat='heron', run='a.alog', ahead='10', steps=40, mae={'aid': 0.1})]
    """
    rows = csv.reader(io.StringIO(text))
    head = next(rows, [])
    if tuple(head[:4]) != HEAD:
        raise ValueError(f"found the columns {', '.join(head[:4])}, expected {', '.join(HEAD)}")
    found = []
    for row in rows:
        maes = {name: float(mae) for name, mae in zip(head[4:], row[4:], strict=True) if mae}
        if int(row[3]) < 1 or not all(map(np.isfinite, maes.values())):
            raise ValueError(f"line {rows.line_num}: expected steps and errors that are numbers")
        found.append(RunError(row[0], row[1], row[2], int(row[3]), maes))
    return found
