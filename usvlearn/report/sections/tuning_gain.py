"""The gain of tuning: on the season of the tuning, and on the next one."""

from __future__ import annotations

from collections.abc import Mapping
from operator import itemgetter
from typing import Any

from usvlearn.display.figures import PAPER
from usvlearn.display.result_table import ResultTable
from usvlearn.evaluation.metrics import by_error, mean_mae
from usvlearn.report.sections.section import Section

PAPER_RESULT = (
    "A coarse grid search and refinement by hand on 29 h of the season before. The authors found a fair comparison "
    "difficult: each method's performance depends on its tuning parameters."
)


def tuning_section(
    tuned: Mapping[str, Mapping], after: Mapping[str, Mapping], before: Mapping[str, Mapping]
) -> Section:
    """The gain of each member, and of the ensemble.

    Args:
        tuned: the content of `tuning.json`, by member.
        after: scores of the season with the tuned settings, `boats` of `results.json`.
        before: the same with the default settings.
    """
    with_tuning, without = mean_mae(after), mean_mae(before)
    rows = []
    for name in with_tuning:
        found = tuned.get(name)
        own: tuple[Any, ...] = (None,) * 5
        if found:
            settings = ", ".join(f"{key} {value:.4g}" for key, value in found["best"]["setting"].items())
            own = found["evaluations"], settings, found["default"]["mae"], found["best"]["mae"], found["best"]["gain"]
        rows.append((name, *own, without[name], with_tuning[name], 100 * (1 - with_tuning[name] / without[name])))
    columns = ("method", "evaluations", "tuned to", "tuning season: default, m/s", "tuned, m/s", "gain, %",
               "next season: default, m/s", "tuned, m/s", "gain, %")  # fmt: skip
    edges = [
        f"{name} {path}"
        for name, found in tuned.items()
        for path, value in found["best"]["setting"].items()
        if value in found.get("ranges", {}).get(path, [])
    ]
    budget = ", ".join(sorted({str(found["evaluations"]) for found in tuned.values()}))
    here = [
        f"{', '.join(tuned)} took {budget} evaluations each beside the default, on the tuning season alone.",
        *(
            f"{name}: {_percent(row[5])} there, {_percent(row[8])} on the season that it was not tuned on."
            for row in rows
            if (name := row[0]) in tuned
        ),
    ]
    if edges:
        here.append(f"At the edge of its range, so that more may be beyond: {', '.join(edges)}.")
    if three := [row for row in rows if row[0] in PAPER]:
        best = [min(three, key=itemgetter(k))[0] for k in (6, 7)]
        here.append(
            f"The lowest error of {', '.join(r[0] for r in three)}: {best[0]} by default, {best[1]} when tuned."
        )
    known = {row[0]: row for row in rows}
    result_table = ResultTable("tuning", columns, [known[name] for name in by_error(with_tuning)])
    return Section("tuning", "What tuning gained", PAPER_RESULT, here, (), [result_table])


def _percent(gain: float | None) -> str:
    return "unknown" if gain is None or gain != gain else f"{gain:+.1f} %"
