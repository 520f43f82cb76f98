"""The parts of a report's section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from usvlearn.display.terminal import ResultTable
from usvlearn.evaluation.metrics import by_error


class Drawn(NamedTuple):
    """A figure."""

    name: str  # of its files
    figure: Any  # of matplotlib
    caption: str


class Section(NamedTuple):
    """A part of a report."""

    key: str
    title: str
    paper: str  # the paper's result; "" if it has none
    here: Sequence[str]  # sentences
    figures: Sequence[Drawn] = ()
    sheets: Sequence[ResultTable] = ()
    first: int = 0  # tables that stand open before the figures


def summary(
    name: str, boats: Mapping[str, Mapping[str, float]], what: str, remarks: Mapping[str, str] | None = None
) -> ResultTable:
    """A table, best first: the mean over boats of each method's error, and the number of boats on which it is least.

    Args:
        name: of the table.
        boats: errors by boat and method.
        what: the error, with its unit.
        remarks: on methods; see `usvlearn.evaluation.diagnostics.remarks`.

    >>> summary("mae", {"a": {"rls": 0.4, "aid": 0.1}, "b": {"rls": 0.2, "aid": 0.3}}, "MAE, m/s", {"rls": "map"}).rows
    [('aid', 0.2, 1, ''), ('rls', 0.30000000000000004, 1, 'map')]
    """
    means, best = mean_errors(boats), [min(row, key=row.__getitem__) for row in boats.values()]
    rows = [(method, means[method], best.count(method), (remarks or {}).get(method, "")) for method in by_error(means)]
    return ResultTable(name, ("method", f"{what}, mean over boats", "lowest on boats", "remark"), rows)


def mean_errors(boats: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """The mean over boats of each method's error.

    >>> mean_errors({"a": {"rls": 0.5}, "b": {"rls": 0.25}})
    {'rls': 0.375}
    """
    return {name: sum(row[name] for row in boats.values()) / len(boats) for name in next(iter(boats.values()), ())}


def on(count: int, boats: int) -> str:
    """The number of boats in words.

    >>> on(8, 8), on(0, 8), on(3, 8), on(1, 1), on(0, 1)
    ('on all 8 boats', 'on none of 8 boats', 'on 3 of 8 boats', 'on this boat', 'not on this boat')
    """
    if boats == 1:
        return "on this boat" if count else "not on this boat"
    return f"on all {boats} boats" if count == boats else f"on {count or 'none'} of {boats} boats"


def tally(what: str, names: Sequence[str], winners: Sequence[str]) -> str:
    """A sentence that says which name wins on how many boats.

    >>> tally("lowest MAE", ["aid", "rls"], ["aid", "aid", "rls"])
    'Of aid, rls the lowest MAE: aid on 2, rls on 1 of 3 boats.'
    >>> tally("lowest MAE", ["aid", "rls"], ["aid"])
    'Of aid, rls the lowest MAE: aid.'
    """
    if len(winners) == 1:
        return f"Of {', '.join(names)} the {what}: {winners[0]}."
    each = ", ".join(f"{name} on {winners.count(name)}" for name in names)
    return f"Of {', '.join(names)} the {what}: {each} of {len(winners)} boats."
