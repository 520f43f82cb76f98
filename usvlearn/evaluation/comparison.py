"""Errors of each run of each boat, and paired differences of them between two settings.

A run's folder holds the errors in `errors.csv`:

    boat, run, ahead, steps, ESTIMATOR…     MAE in m/s; empty where it is unknown

`ahead` is `step` (one step ahead), a horizon in s such as `10`, or `free`. Differences have intervals over boats and
runs, and over seeds; equations (1) to (3) are those of `docs/theory/ensemble.md#comparing-settings`.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import PLAUSIBLE, Fleet, masks, tree_map
from usvlearn.evaluation.free_simulation import FreeErrors
from usvlearn.evaluation.horizons import HorizonSums, means
from usvlearn.evaluation.metrics import PERSISTENCE, Stretch
from usvlearn.evaluation.objective import COVERAGE, FORECAST, FREE, SKILL, Measure

STEP = "step"  # in the column ahead
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
    """Sums of |error| one step ahead, `(runs, boats, count)`, NaN once diverged; measured steps, `(runs, boats)`."""
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
    """All errors by run; runs without a measured step, or without a forecast that became due, have none."""
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
    """A table of `run_errors`."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*HEAD, *names])
    for each in errors:
        writer.writerow([*each[:4], *(each.mae.get(name) for name in names)])
    return text.getvalue()


def from_csv(text: str) -> list[RunError]:
    """What `as_csv` wrote."""
    rows = csv.reader(io.StringIO(text))
    head = next(rows, [])
    if tuple(head[:4]) != HEAD:
        raise ValueError(f"found the columns {', '.join(head[:4])}, expected {', '.join(HEAD)}")
    errors = []
    for row in rows:
        maes = {name: float(mae) for name, mae in zip(head[4:], row[4:], strict=True) if mae}
        if int(row[3]) < 1 or not all(map(np.isfinite, maes.values())):
            raise ValueError(f"line {rows.line_num}: expected steps and errors that are numbers")
        errors.append(RunError(row[0], row[1], row[2], int(row[3]), maes))
    return errors


DRAWS, LEVEL, SEED = 1000, 0.95, 0
FLEET = 3  # boats, from which on they are a sample of others, and are drawn, too
ALIKE = 0.02  # relative, of steps and of persistence's errors: the samples are the same, but for some that are rejected
EQUAL = 1e-9  # relative to the objective: differences that are the same to rounding
Place = tuple[str, str, str]  # seed, boat, run


class Cell(NamedTuple):
    """One run of a setting."""

    steps: float
    error: float  # m/s
    base: float  # m/s, persistence's; NaN if it was not run


class SeedDifference(NamedTuple):
    """The mean over seeds of the difference of two settings that have the same seed, in the objective's unit."""

    mean: float
    low: float | None  # of the 95 % interval; None with a single seed, or if all seeds gave the same difference
    high: float | None
    seeds: int

    @property
    def tie(self) -> bool | None:
        """Whether the interval contains 0; None without one."""
        return None if self.low is None or self.high is None else self.low <= 0 <= self.high


class Difference(NamedTuple):
    """The objective of a setting minus that of the reference, in the objective's unit."""

    mean: float
    low: float | None  # of the 95 % interval; None with a single run
    high: float | None
    share: float  # of the reference's
    runs: int  # different ones, each made by both
    over_seeds: SeedDifference | None = None  # None if an objective is unknown

    @property
    def tie(self) -> bool | None:
        """Whether the interval contains 0; None without one."""
        return None if self.low is None or self.high is None else self.low <= 0 <= self.high


def cells(errors: Mapping[str, Sequence[RunError]], measure: Measure) -> dict[Place, Cell]:
    """The runs of a setting, of errors by seed; coverage has no measure."""
    if measure.kind == COVERAGE:
        return {}
    ahead = {FORECAST: f"{measure.horizon:g}", FREE: FREE}.get(measure.kind, STEP)
    rows = [(seed, each) for seed, runs in errors.items() for each in runs if each.ahead == ahead]
    return {
        (seed, each.boat, each.run): Cell(each.steps, each.mae[name], each.mae.get(PERSISTENCE, math.nan))
        for seed, each in rows
        if (name := measure.estimator) in each.mae
    }


def compare(one: Mapping[Place, Cell], other: Mapping[Place, Cell], measure: Measure) -> Difference | None:
    """The difference of two settings over the seeds that both have.

    None if they have no seed in common, or did not make the same runs over the same samples with it.
    """
    seeds = {place[0] for place in one} & {place[0] for place in other}
    shared = sorted(place for place in one if place[0] in seeds)
    if not shared or shared != sorted(place for place in other if place[0] in seeds):
        return None
    if not all(_same_samples(one[place], other[place]) for place in shared):
        return None
    boats = sorted({boat for _, boat, _ in shared})
    # A unit is one boat's run over its own samples: seeds that share samples are one unit.
    units = {place: (place[2], one[place].steps, _rounded(one[place].base)) for place in shared}
    by_boat = {boat: list(dict.fromkeys(units[place] for place in shared if place[1] == boat)) for boat in boats}
    most, count = max(map(len, by_boat.values())), sum(map(len, by_boat.values()))
    values = np.zeros((2, 3, len(boats), most))  # settings; steps, sums of errors, sums of persistence's errors
    for place in shared:
        boat = boats.index(place[1])
        unit = by_boat[place[1]].index(units[place])
        for k, side in enumerate((one, other)):
            steps, error, base = side[place]
            values[k, :, boat, unit] += steps, steps * error, steps * base
    weights = np.ones((1, len(boats))), np.ones((1, len(boats), most))
    whole = _objectives(values, weights, measure)[0]
    if not np.isfinite(whole).all():
        return None
    mean, low, high = float(whole[0] - whole[1]), None, None
    if count > 1:
        rng = np.random.default_rng(SEED)
        fleet = len(boats) >= FLEET
        drawn = (
            _drawn(rng, len(boats)) if fleet else np.ones((DRAWS, len(boats))),
            np.zeros((DRAWS, len(boats), most)),
        )
        for k, name in enumerate(boats):
            drawn[1][:, k, : len(by_boat[name])] = _drawn(rng, len(by_boat[name]))
        objectives = _objectives(values, drawn, measure)
        half = _factor(len(boats) if fleet else count) * float(np.nanstd(objectives[:, 0] - objectives[:, 1]))  # (2)
        low, high = mean - half, mean + half
    return Difference(mean, low, high, mean / abs(float(whole[1])) if whole[1] else 0.0, count)


def over_seeds(one: Mapping[str, float], other: Mapping[str, float]) -> SeedDifference | None:
    """Equation (3). There is no interval over one seed, nor if all differences are equal: nothing was drawn then."""
    seeds = [seed for seed in one if seed in other]
    if not seeds:
        return None
    differences = np.array([one[seed] - other[seed] for seed in seeds])
    mean, low, high = float(differences.mean()), None, None
    if len(seeds) > 1 and np.ptp(differences) > EQUAL * max(abs(other[seed]) for seed in seeds):
        half = quantile(len(seeds)) * float(differences.std(ddof=1)) / math.sqrt(len(seeds))
        low, high = mean - half, mean + half
    return SeedDifference(mean, low, high, len(seeds))


def _same_samples(one: Cell, other: Cell) -> bool:
    """Whether two runs have about the same steps, and errors of persistence, if they are known."""
    same = all(map(math.isnan, (one.base, other.base))) or math.isclose(one.base, other.base, rel_tol=ALIKE)
    return math.isclose(one.steps, other.steps, rel_tol=ALIKE) and same


def _rounded(base: float) -> float | None:
    """Persistence's error, so that equal samples have equal numbers."""
    return None if math.isnan(base) else float(f"{base:.9e}")


def _factor(count: int) -> float:
    """The factor of (2) for so many boats, or runs."""
    return quantile(count) * math.sqrt(count / (count - 1))


def quantile(count: int) -> float:
    """Of Student's distribution, for a mean of so many: 97.5 %, with one degree of freedom less."""
    from scipy.special import stdtrit

    return float(stdtrit(count - 1, (1 + LEVEL) / 2))


def _drawn(rng: np.random.Generator, count: int) -> np.ndarray:
    """How often each of `count` was drawn, `(DRAWS, count)`."""
    return rng.multinomial(count, np.full(count, 1 / count), DRAWS).astype(float)


def _objectives(values: np.ndarray, weights: tuple[np.ndarray, np.ndarray], measure: Measure) -> np.ndarray:
    """Equation (1) of both settings for each draw, `(draws, 2)`; NaN if a draw has no step."""
    boats, units = weights
    sums = np.einsum("dbu,kxbu->kxdb", units, values, optimize=True)  # settings, numbers, draws, boats
    with np.errstate(invalid="ignore", divide="ignore"):
        scores = sums[:, 1] / (sums[:, 2] if measure.kind == SKILL else sums[:, 0])  # settings, draws, boats
        scores = 1 - scores if measure.kind == SKILL else scores
        weight = np.where(np.isfinite(scores), boats, 0.0)
        return ((weight * np.nan_to_num(scores)).sum(-1) / weight.sum(-1)).T


def short_keys(keys: Iterable[str]) -> list[str]:
    """The last part of each key; more of it where two end alike."""
    keys = list(keys)
    ends = Counter(key.rpartition(".")[2] for key in keys)
    return [".".join(key.split(".")[-(1 if ends[key.rpartition(".")[2]] == 1 else 2) :]) for key in keys]
