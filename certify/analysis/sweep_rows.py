"""The rows of the table over a sweep: verdicts, rates and errors of each job and network, or of several seeds."""

from __future__ import annotations

import os
import re
import statistics
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from certify.analysis.sweep_jobs import Job, printable
from certify.networks.shallow import Network

SEED = "seed"  # the key whose values are repetitions of one job


def differing(settings: Iterable[Mapping[str, str] | None]) -> list[str]:
    """The keys whose values are not the same in all jobs whose settings are known.

    >>> differing([{"dt": "0.4", "gain": "1"}, {"dt": "0.4", "gain": "3"}, None])
    ['gain']
    """
    known = [each for each in settings if each is not None]
    keys = dict.fromkeys(key for each in known for key in each)
    return [key for key in keys if len({each.get(key) for each in known}) > 1]


def rows(
    jobs: Sequence[Job], networks: Sequence[Network], found: Sequence[Mapping[str, Any]], held: Sequence[bool]
) -> list[dict[str, Any]]:
    """A row for each network of a job, or of jobs that differ only in their seed.

    First those of which every judged checkpoint holds, then by the error of open-loop simulations, or one step ahead
    without open-loop simulations.

    Args:
        jobs: of the sweep.
        networks: the judged checkpoints of these jobs.
        found: see `certify.analysis.assess.assess`, for each.
        held: whether the asked condition holds, for each.

    Returns:
        Counts of sets by condition; `rate`, the largest exact rate K; errors in m/s, mean over boats, then mean and
        sample deviation over seeds, None where a boat lacks it.
    """
    keys = differing(job.settings for job in jobs)
    groups: dict[tuple[str, Any], dict[int, list[int]]] = {}  # network, settings -> job -> sets
    for k, network in enumerate(networks):
        j = next(j for j, job in enumerate(jobs) if network.path.startswith(str(job.folder) + os.sep))
        groups.setdefault((estimator(network), _repeated(jobs[j], keys)), {}).setdefault(j, []).append(k)
    made = []
    for (name, _), members in groups.items():
        sets = [k for each in members.values() for k in each]
        own = [jobs[j] for j in members]
        free = [_mean_over_boats(job.free, name) for job in own]
        mae = [_mean_over_boats(job.mae, name) for job in own]
        settings = own[0].settings
        row: dict[str, Any] = {
            "jobs": [job.name for job in own],
            "unfinished": [job.name for job in own if job.state == "not finished"],
            "settings": None if settings is None else {key: settings.get(key) for key in keys if key != SEED},
            "network": name,
            "sets": len(sets),
            "certified": {name: sum(found[k]["certified"][name] for k in sets) for name in found[sets[0]]["certified"]},
            "holds": all(held[k] for k in sets),
            "rate": max(found[k]["rate"] for k in sets),
            "rates": [max(found[k]["rate"] for k in each) for each in members.values()],
            **dict(zip(("free", "free_deviation"), _over_seeds(free), strict=True)),
            **dict(zip(("mae", "mae_deviation"), _over_seeds(mae), strict=True)),
        }
        if "box" in found[sets[0]]:
            boxes = [found[k]["box"] for k in sets]
            row["certified"] |= {
                "interval": sum(box["interval"] == "certified" for box in boxes),
                "box": sum(box["verdict"] == "certified" for box in boxes),
            }
            row["box_rate"] = max(box["bracket"][1] for box in boxes)
        made.append({**row, "paths": [networks[k].path for k in sets]})
    return sorted(made, key=lambda row: (not row["holds"], *_by_error(row["free"]), *_by_error(row["mae"])))


def unjudged(jobs: Sequence[Job], judged: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The jobs without a row: their settings that differ, and the reason."""
    seen = {name for row in judged for name in row["jobs"]}
    keys = differing(job.settings for job in jobs)
    return [
        {
            "jobs": [job.name],
            "settings": None if job.settings is None else {key: job.settings.get(key) for key in keys},
            "error": job.state if job.failed or not job.sets else "no checkpoint could be judged",
        }
        for job in jobs
        if job.name not in seen
    ]


def _repeated(job: Job, keys: Sequence[str]) -> Any:
    """What jobs of one row have in common: their settings without the seed, or the job's own name."""
    if SEED not in keys or job.settings is None or SEED not in job.settings:
        return job.name
    return tuple((key, job.settings.get(key)) for key in keys if key != SEED)


def _by_error(error: float | None) -> tuple[bool, float]:
    return error is None, error or 0.0


def estimator(network: Network) -> str:
    """The member of the ensemble that a network is, as errors are named, and its batch element if it has several.

    >>> estimator(Network("", None, "members.rnn.weights[1]")), estimator(Network("", None, ""))
    ('rnn[1]', 'network')
    """
    found = re.match(r"members\.([^.\[]+)[^\[]*(\[.*\])?$", network.tensors)
    return printable(found[1] + (found[2] or "") if found else network.tensors or "network")


def _mean_over_boats(table: Mapping[str, Mapping[str, float | None]], name: str) -> float | None:
    """The mean; None if there is none, or if the estimator diverged on a boat."""
    known = [row[name] for row in table.values() if name in row]
    numbers = [x for x in known if x is not None]
    return statistics.fmean(numbers) if numbers and len(numbers) == len(known) else None


def _over_seeds(errors: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Mean and sample deviation; no mean if one is missing, no deviation of a single one.

    >>> _over_seeds([0.25, 0.75]), _over_seeds([0.25]), _over_seeds([0.25, None])
    ((0.5, 0.3535533905932738), (0.25, None), (None, None))
    """
    known = [x for x in errors if x is not None]
    if len(known) < len(errors):
        return None, None
    return statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None


def narrowest(row: Mapping[str, Any]) -> str | None:
    """The first condition, from the narrowest to the widest, that all sets of a row hold; None if there is none.

    >>> narrowest({"sets": 2, "certified": {"simple": 0, "gershgorin": 1, "lmi": 2, "tight": 2}})
    'lmi'
    """
    return next((name for name, count in row["certified"].items() if count == row["sets"]), None)


def short_keys(keys: Iterable[str]) -> list[str]:
    """The last part of each key; more of it where two end alike.

    >>> short_keys(["estimators.rnn.rate", "estimators.aid.rate", "align.dt"])
    ['rnn.rate', 'aid.rate', 'dt']
    """
    keys = list(keys)
    ends = Counter(key.rpartition(".")[2] for key in keys)
    return [".".join(key.split(".")[-(1 if ends[key.rpartition(".")[2]] == 1 else 2) :]) for key in keys]


def short_values(settings: Mapping[str, str | None] | None) -> str:
    """The values of a job's settings; "?" if they are not known.

    >>> short_values({"estimators.rnn.stability": "project", "estimators.rnn.condition": None})
    'project, –'
    """
    return "?" if settings is None else ", ".join("–" if value is None else value for value in settings.values())


def ranges(names: Sequence[str]) -> list[str]:
    """Names of jobs; consecutive numbers as a range.

    >>> ranges(["0", "1", "2", "7"])
    ['0–2', '7']
    """
    found: list[list[str]] = []
    for name in names:
        if found and name.isdecimal() and found[-1][-1].isdecimal() and int(name) == int(found[-1][-1]) + 1:
            found[-1].append(name)
        else:
            found.append([name])
    return [each[0] if len(each) == 1 else f"{each[0]}–{each[-1]}" for each in found]
