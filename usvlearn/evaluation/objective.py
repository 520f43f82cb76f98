"""The objective: which error of which estimator a run, a sweep or a tuning minimises.

objective=null                  the MAE of the combiner that predicts; in a sweep, of the member that it varies
objective=rnn                   the MAE of this member or combiner one step ahead; so does rnn.mae
objective=rnn.skill             1 − MAE/MAE(persistence), one step ahead; greater is better
objective=rnn.coverage          the share of measured speeds within its 90 % intervals; 0.9 is best
objective=rnn.forecast.10       the MAE of its forecasts over 10 s, one of forecasts.horizons
objective=rnn.free              the MAE of its open-loop simulations: each boat's second half of runs, from commands,
                                with the parameters learned by the end of the first half

Without one, the jobs of a sweep are ranked by the member, or the combiner, that the swept keys name. They are ranked by
the MAE of their outputs if the keys name no member (`align.inputs`), several, or one that is not in every job.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.samples import Fleet
from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.evaluation.free_simulation import check_halves
from usvlearn.evaluation.metrics import mean, mean_mae

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble

ONE_STEP, SKILL, COVERAGE, FORECAST, FREE = "mae", "skill", "coverage", "forecast", "free"
KINDS = (ONE_STEP, SKILL, COVERAGE, FREE, f"{FORECAST}.SECONDS")
NOMINAL = 0.9  # of the intervals


class Measure(NamedTuple):
    """An estimator of an ensemble, a member or a combiner, and which of its errors counts."""

    estimator: str
    kind: str = ONE_STEP
    horizon: float = 0.0  # s, of FORECAST

    def __str__(self) -> str:
        return f"{self.estimator}.{self.kind}" + (f".{self.horizon:g}" if self.kind == FORECAST else "")

    @property
    def unit(self) -> str:
        """m/s, or nothing for a share."""
        return "" if self.kind in (SKILL, COVERAGE) else "m/s"

    def shown(self, value: float | None) -> str:
        """A value with its unit."""
        return "unknown" if value is None else f"{value:.4f} {self.unit}".strip()

    def title(self) -> str:
        """In words."""
        name = {SKILL: "skill of {}", COVERAGE: "coverage of the 90 % intervals of {}",
            FREE: "MAE of open-loop simulations of {}",
                FORECAST: f"MAE of {{}} {self.horizon:g} s ahead"}.get(self.kind, "MAE of {}")  # fmt: skip
        return name.format(self.estimator)

    def loss(self, value: float | None) -> float:
        """What is to be minimised; infinite for no value."""
        if value is None or math.isnan(value):
            return math.inf
        return {SKILL: -value, COVERAGE: abs(value - NOMINAL)}.get(self.kind, value)

    def known(self, results: Mapping[str, Any]) -> bool:
        """Whether `results.json` has a number of it, or says that there is none: the estimator was measured so."""
        rows: Mapping[str, Any] = next(iter(self._tables(results).values()), {})
        if self.estimator not in rows:
            return False
        key = f"{self.horizon:g}" if self.kind == FORECAST else self.kind
        return self.kind == FREE or key in rows[self.estimator]

    def value(self, results: Mapping[str, Any]) -> float | None:
        """What `results.json` says of it, mean over boats; None where it is unknown of a boat, or diverged."""
        tables = self._tables(results)
        if not any(self.estimator in rows for rows in tables.values()):
            return None
        return mean(self._of(rows.get(self.estimator)) for rows in tables.values())

    def _tables(self, results: Mapping[str, Any]) -> Mapping[str, Any]:
        """The errors by boat and estimator among which it is."""
        return results.get(self.kind if self.kind in (FORECAST, FREE) else "boats") or {}

    def _of(self, row: Any) -> float | None:
        """The number in an estimator's row of its table."""
        if self.kind == FREE or row is None:
            return row
        return row.get(f"{self.horizon:g}", {}).get("mae") if self.kind == FORECAST else row.get(self.kind)


def measure_of(objective: Any, default: str) -> Measure:
    """What `objective` names; without one, the MAE of `default` one step ahead."""
    name, _, kind = str(default if objective is None else objective).partition(".")
    kind, _, horizon = kind.partition(".")
    named = re.fullmatch(r"[\w-]+", name) is not None
    try:
        if named and kind in ("", ONE_STEP, SKILL, COVERAGE, FREE) and not horizon:
            return Measure(name, kind or ONE_STEP)
        if named and kind == FORECAST and 0 < float(horizon) < math.inf:
            return Measure(name, FORECAST, float(horizon))
    except ValueError:
        pass
    raise ConfigError(f"objective: found {objective!r}, expected MEMBER or MEMBER.KIND, KIND one of {', '.join(KINDS)}")


def check_measure(measure: Measure, ensemble: Ensemble, fleet: Fleet) -> None:
    """Raise a ConfigError unless an ensemble makes what is measured, and there are enough runs."""
    forecasts = ensemble.forecasts
    if measure.estimator not in ensemble.names:
        known = [*ensemble.members, *ensemble.combiners]
        hint = did_you_mean(measure.estimator, known)
        raise ConfigError(f"objective: found {measure.estimator!r}, expected one of {', '.join(known)}{hint}")
    if measure.kind == FORECAST:
        horizons = [] if forecasts is None else forecasts.horizons.tolist()
        if measure.horizon not in horizons:
            raise ConfigError(
                f"objective: found a forecast over {measure.horizon:g} s, expected one of forecasts.horizons: "
                f"{', '.join(f'{h:g}' for h in horizons) or 'there are none'}"
            )
        if forecasts is not None and measure.estimator not in (*forecasts.columns[:-1], ensemble.output):
            raise ConfigError(
                f"objective: found forecasts of {measure.estimator}, which makes none: add it to forecasts.members"
            )
    if measure.kind == FREE:
        check_halves(fleet)


def differing(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """The keys whose values are not the same in all jobs."""
    keys = dict.fromkeys(key for each in settings for key in each)
    return [key for key in keys if len({each.get(key) for each in settings}) > 1]


def named(key: str) -> str | None:
    """The member or combiner that a key of a command names, or None."""
    match = re.match(r"[+~]*(?:.*@)?(?:estimators|combiners)\.(\w+)", key)
    return match and match[1]


def ranked_by(objective: Any, swept: Iterable[str], results: Iterable[Mapping]) -> Measure | None:
    """What ranks jobs; None if each job's own output does."""
    if objective is not None:
        return measure_of(objective, "")
    names = {name for key in swept if (name := named(key)) is not None}
    if len(names) != 1:
        return None
    (name,) = names
    everywhere = all(name in mean_mae(each["boats"]) for each in results if "boats" in each)
    return Measure(name) if everywhere else None


def own_objective(results: Iterable[Mapping]) -> str | None:
    """The objective that all jobs were given; None if they differ, or if it is the default, the MAE of their output."""
    measures = {each.get("measure") if each.get("measure") != f"{each.get('output')}.mae" else None for each in results}
    return measures.pop() if len(measures) == 1 else None


def own_measure(result: Mapping[str, Any]) -> Measure:
    """What ranks a job whose results are `scored`."""
    return measure_of(result.get("measure"), "output")


def scored(result: Mapping[str, Any], by: Measure | None) -> dict[str, Any]:
    """The results of a job, with what ranks it as `objective`, and its name as `measure`."""
    if "boats" not in result:
        return dict(result)
    if by is None:
        measure = result.get("measure") or f"{result.get('output') or 'tuned'}.mae"
        return {**result, "measure": measure}
    return {**result, "measure": str(by), "objective": by.value(result)}
