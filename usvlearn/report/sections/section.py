"""The parts of a report's section."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from usvlearn.display.terminal import ResultTable
from usvlearn.evaluation.metrics import by_error

WORSE = "#C0392B"  # colour of failures


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
    """A table, best first: the mean over boats of each method's error, and the number of boats on which it is least."""
    means, best = mean_errors(boats), [min(row, key=row.__getitem__) for row in boats.values()]
    rows = [(method, means[method], best.count(method), (remarks or {}).get(method, "")) for method in by_error(means)]
    return ResultTable(name, ("method", f"{what}, mean over boats", "lowest on boats", "remark"), rows)


def mean_errors(boats: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """The mean over boats of each method's error."""
    return {name: sum(row[name] for row in boats.values()) / len(boats) for name in next(iter(boats.values()), ())}


def on(count: int, boats: int) -> str:
    """The number of boats in words, such as "on 3 of 8 boats"."""
    if boats == 1:
        return "on this boat" if count else "not on this boat"
    return f"on all {boats} boats" if count == boats else f"on {count or 'none'} of {boats} boats"


def tally(what: str, names: Sequence[str], winners: Sequence[str]) -> str:
    """A sentence that says which name wins on how many boats."""
    if len(winners) == 1:
        return f"Of {', '.join(names)} the {what}: {winners[0]}."
    counts = ", ".join(f"{name} on {winners.count(name)}" for name in names)
    return f"Of {', '.join(names)} the {what}: {counts} of {len(winners)} boats."
