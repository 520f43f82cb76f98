"""The settings of a sweep, ranked: the objective over seeds, the difference to the default, the networks' verdict."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from usvlearn.evaluation.comparison import Difference, RunError, cells, compare, over_seeds
from usvlearn.evaluation.objective import Measure, differing, own_measure
from usvlearn.sweeps.jobs import Job, errors_of
from usvlearn.sweeps.seeds import SEED


class Standing(NamedTuple):
    """One setting and its jobs, which differ in the seed alone."""

    settings: dict[str, str]  # the swept keys, without the seed
    jobs: tuple[Job, ...]  # with results as of `usvlearn.evaluation.objective.scored`
    value: float | None  # of the objective, mean over seeds; None if a finished job has none, or none has finished
    deviation: float | None  # over seeds; None for fewer than two
    seconds: float | None  # of a job, mean
    contracting: bool | None  # whether all networks of the ranking member, or of all, are certified; None without one
    rate: float | None  # the largest contraction rate of them, a step
    default: bool  # whether its values are those without the sweep
    reference: bool  # whether the others are compared with this: the default, else the best
    difference: Difference | None  # to the reference

    @property
    def done(self) -> int:
        """How many jobs finished."""
        return len(self.jobs) - len(self.failed)

    @property
    def by_seed(self) -> dict[str, float]:
        """The objective of the jobs that have one, by their seed."""
        pairs = ((job.settings.get(SEED, ""), job.results.get("objective")) for job in self.jobs if job.finished)
        return {seed: float(value) for seed, value in pairs if value is not None and value == value}

    @property
    def failed(self) -> list[Job]:
        """The jobs that did not finish."""
        return [job for job in self.jobs if not job.finished]


def standings(jobs: Sequence[Job], measure: Measure | None, defaults: Mapping[str, str]) -> list[Standing]:
    """All settings, the best first; then those of which fewer seeds finished; those without a value come last.

    Fewer seeds are other data, so that such a setting may seem better than it is. The reference is the setting that has
    the values of `defaults`, else the best.
    """
    keys = [key for key in differing([job.settings for job in jobs]) if key != SEED]
    groups: dict[tuple[tuple[str | None, ...], int], list[Job]] = {}
    seen: Counter[tuple[str | None, ...]] = Counter()
    for job in jobs:
        values = tuple(job.settings.get(key) for key in keys)
        with_seed = (*values, job.settings.get(SEED))
        groups.setdefault((values, seen[with_seed]), []).append(job)  # equal jobs, as of several runs, stay apart
        seen[with_seed] += 1
    ranks = [_standing({k: v for k, v in zip(keys, values, strict=True) if v is not None}, each, measure)
             for (values, _), each in groups.items()]  # fmt: skip
    most = max((each.done for each in ranks), default=0)
    ranks.sort(key=lambda each: (each.value is None, each.done < most, _loss(each, measure)))
    if not ranks or not math.isfinite(_loss(ranks[0], measure)):
        return ranks
    is_default = [
        each.value is not None
        and each.done == most
        and all(same(each.settings.get(key), defaults.get(key)) for key in keys)
        for each in ranks
    ]
    first = is_default.index(True) if True in is_default else 0
    errors = [_cells(each, measure) for each in ranks]
    return [
        each._replace(
            default=is_default[k],
            reference=k == first,
            difference=None if k == first else _compared(each, errors[k], ranks[first], errors[first], measure),
        )
        for k, each in enumerate(ranks)
    ]


def same(one: str | None, other: str | None) -> bool:
    """Whether two values of a command are the same: as numbers, if they are numbers."""
    try:
        return float(one or "") == float(other or "")
    except ValueError:
        return one == other and one is not None


def _standing(settings: dict[str, str], jobs: Sequence[Job], measure: Measure | None) -> Standing:
    done = [job.results for job in jobs if job.finished]
    values = [each.get("objective") for each in done]
    known = [x for x in values if x is not None and x == x]
    whole = bool(known) and len(known) == len(values)
    seconds = [each["seconds"] for each in done if isinstance(each.get("seconds"), int | float)]
    networks = [network for each in done for network in _networks(each, measure)]
    rates = [each["rate"] for each in networks if each["rate"] is not None]
    return Standing(
        settings,
        tuple(jobs),
        statistics.fmean(known) if whole else None,
        statistics.stdev(known) if whole and len(known) > 1 else None,
        statistics.fmean(seconds) if seconds else None,
        all(each["contracting"] for each in networks) if networks else None,
        max(rates) if rates and len(rates) == len(networks) else None,
        False,
        False,
        None,
    )


def _networks(results: Mapping[str, Any], measure: Measure | None) -> list[Mapping[str, Any]]:
    """The verdicts of the ranking member's networks, or of all if it is no network."""
    boats = [members for members in (results.get("network") or {}).values()]
    ranked = [members[measure.estimator] for members in boats if measure and measure.estimator in members]
    return ranked or [each for members in boats for each in members.values()]


def _loss(standing: Standing, measure: Measure | None) -> float:
    return (measure or _own(standing)).loss(standing.value)


def _own(standing: Standing) -> Measure:
    """What a setting's own jobs minimise."""
    return own_measure(next((job.results for job in standing.jobs if "measure" in job.results), {}))


def _cells(standing: Standing, measure: Measure | None) -> dict:
    errors: dict[str, Sequence[RunError]] = {
        job.settings.get(SEED, ""): errors_of(job) for job in standing.jobs if job.finished
    }
    return cells(errors, measure or _own(standing))


def _compared(
    standing: Standing, one: dict, reference: Standing, other: dict, measure: Measure | None
) -> Difference | None:
    if standing.value is None or (difference := compare(one, other, measure or _own(standing))) is None:
        return None
    return difference._replace(over_seeds=over_seeds(standing.by_seed, reference.by_seed))
