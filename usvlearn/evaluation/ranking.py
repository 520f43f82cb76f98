"""What ranks the jobs of a sweep: `objective`, else the error of the member, or of the combiner, that the swept keys
name.

They are ranked by the MAE of their outputs if the keys name no member (`align.inputs`), several, or one that is not in
every job.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from usvlearn.evaluation.measure import Measure, measure_of, own_columns
from usvlearn.evaluation.metrics import mean_mae


def differing(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """The keys whose values are not the same in all jobs.

    >>> differing([{"dt": "0.4", "gain": "1"}, {"dt": "0.4", "gain": "3"}])
    ['gain']
    """
    keys = dict.fromkeys(key for each in settings for key in each)
    return [key for key in keys if len({each.get(key) for each in settings}) > 1]


def named(key: str) -> str | None:
    """The member or combiner that a key of a command names, or None.

    >>> [named(key) for key in ("estimators.rnn.neurons", "+estimator@estimators.x", "~combiners.average", "align.dt")]
    ['rnn', 'x', 'average', None]
    """
    found = re.match(r"[+~]*(?:.*@)?(?:estimators|combiners)\.(\w+)", key)
    return found and found[1]


def ranked_by(objective: Any, swept: Iterable[str], results: Iterable[Mapping]) -> Measure | None:
    """What ranks jobs; None if each job's own output does.

    Args:
        objective: of the configuration, or None.
        swept: the keys that have several values.
        results: as in `results.json`; without `boats` for jobs that did not finish.

    Raises:
        ConfigError: the objective has another form.

    >>> str(ranked_by(None, ["estimators.rnn.neurons"], [{"boats": {"heron": {"rnn": {"mae": 0.1}}}}]))
    'rnn.mae'
    """
    if objective is not None:
        return measure_of(objective, "")
    names = {name for key in swept if (name := named(key)) is not None}
    if len(names) != 1:
        return None
    (name,) = names
    found = all(own_columns(name, mean_mae(each["boats"])) for each in results if "boats" in each)
    return Measure(name) if found else None


def own_objective(results: Iterable[Mapping]) -> str | None:
    """The objective that all jobs were given; None if they differ, or if it is the default, the MAE of their output.

    >>> own_objective([{"output": "average", "measure": "rnn.skill"}])
    'rnn.skill'
    """
    found = {each.get("measure") if each.get("measure") != f"{each.get('output')}.mae" else None for each in results}
    return found.pop() if len(found) == 1 else None


def own_measure(result: Mapping[str, Any]) -> Measure:
    """What ranks a job whose results are `scored`.

    >>> own_measure({"measure": "rnn.skill"})
    Measure(estimator='rnn', kind='skill', horizon=0.0)
    """
    return measure_of(result.get("measure"), "output")


def scored(result: Mapping[str, Any], by: Measure | None) -> dict[str, Any]:
    """The results of a job, with what ranks it as `objective`, and its name as `measure`.

    >>> found = scored({"boats": {"heron": {"rnn": {"mae": 0.1}}}, "objective": 0.2}, Measure("rnn"))
    >>> found["objective"], found["measure"]
    (0.1, 'rnn.mae')
    """
    if "boats" not in result:
        return dict(result)
    if by is None:
        own = result.get("measure") or f"{result.get('output') or 'tuned'}.mae"
        return {**result, "measure": own}
    return {**result, "measure": str(by), "objective": by.value(result)}
