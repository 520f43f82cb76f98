"""The ranking of a sweep's jobs: by the error of the member, or of the rule, that the swept keys name.

They are ranked by the ensemble's output instead if the keys name no member (`align.inputs`), several, or one that is
not in every job, or if the command sets `output`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from usvlearn.evaluation.metrics import mean_mae


def differing(settings: Sequence[Mapping[str, str]]) -> list[str]:
    """The keys whose values are not the same in all jobs.

    >>> differing([{"dt": "0.4", "gain": "1"}, {"dt": "0.4", "gain": "3"}])
    ['gain']
    """
    keys = dict.fromkeys(key for each in settings for key in each)
    return [key for key in keys if len({each.get(key) for each in settings}) > 1]


def named(key: str) -> str | None:
    """The member or rule that a key of a command names, or None.

    >>> [named(key) for key in ("estimators.rnn.neurons", "+estimator@estimators.x", "~combiners.average", "align.dt")]
    ['rnn', 'x', 'average', None]
    """
    found = re.match(r"[+~]*(?:.*@)?(?:estimators|combiners)\.(\w+)", key)
    return found and found[1]


def own_columns(member: str, names: Iterable[str]) -> list[str]:
    """The rows of a table of errors that belong to a member; those of a bank are called NAME_LABEL.

    >>> own_columns("wind", ["aid", "wind_short", "wind_long"])
    ['wind_short', 'wind_long']
    """
    names = list(names)
    return [member] if member in names else [name for name in names if name.startswith(f"{member}_")]


def ranked_by(swept: Iterable[str], settings: Iterable[Mapping[str, str]], results: Iterable[Mapping]) -> str | None:
    """The member or rule whose error ranks jobs; None for the ensemble's output.

    Args:
        swept: the keys that have several values.
        settings: of the jobs, by key.
        results: as in `results.json`; without `boats` for jobs that did not finish.

    >>> ranked_by(["estimators.rnn.neurons"], [{}], [{"boats": {"heron": {"rnn": {"mae": 0.1}}}}])
    'rnn'
    """
    names = {name for key in swept if (name := named(key)) is not None}
    if len(names) != 1 or any("output" in each for each in settings):
        return None
    (name,) = names
    return name if all(own_columns(name, _maes(each)) for each in results if "boats" in each) else None


def scored(result: Mapping[str, Any], by: str | None) -> dict[str, Any]:
    """The results of a job, with the error that ranks it as `objective`, m/s, and whose error it is as `ranked_by`.

    For a bank it is the least error of its settings. It is None where the member diverged.

    >>> scored({"boats": {"heron": {"rnn": {"mae": 0.1}}}, "output": "average", "objective": 0.2}, "rnn")["objective"]
    0.1
    """
    if "boats" not in result:
        return dict(result)
    if by is None:
        return {**result, "ranked_by": result.get("output", "")}
    maes = _maes(result)
    known = [maes[column] for column in own_columns(by, maes) if not math.isnan(maes[column])]
    return {**result, "ranked_by": by, "objective": min(known, default=None)}


def ranked(jobs: Sequence) -> list:
    """Jobs by their objective, the best first; those that failed come last, in their order.

    >>> ranked([({}, {"error": "bad"}), ({}, {"boats": {}, "objective": 0.1})])[0]
    ({}, {'boats': {}, 'objective': 0.1})
    """

    def objective(job) -> tuple[bool, float]:
        found = job[-1].get("objective")
        return "boats" not in job[-1], float("inf") if found is None else found

    return sorted(jobs, key=objective)


def _maes(result: Mapping[str, Any]) -> dict[str, float]:
    return mean_mae(result.get("boats", {}))
