"""Online prediction error per boat and method (paper, figure 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.display.figures import PAPER
from usvlearn.display.result_table import ResultTable
from usvlearn.evaluation.metrics import PERSISTENCE, by_error, scores
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.season_figures import box, boxes_figure
from usvlearn.report.sections.section import Drawn, Section, mean_errors, on, summary, tally

PAPER_RESULT = (
    "On all eight boats AID had the lowest online prediction error of the three methods, and the plain average (AVE) "
    "did not beat AID alone."
)
LABEL = "|predicted − measured| one step ahead, m/s"
LEAST = 2e-3  # m/s, the start of the figure's axis: far below the resolution of a measured speed
COLUMNS = ("mae", "median", "rmse", "fit", "skill", "coverage")


def online_section(
    seasons: Sequence[Season],
    names: Sequence[str],
    remarks: Mapping[str, str] | None = None,
    explained: Sequence[str] = (),
) -> Section:
    """Errors one step ahead, predicted before learning, over all runs that were replayed.

    Args:
        seasons: of all boats.
        names: of the published predictions, in their order.
        remarks, explained: about these names; see `usvlearn.evaluation.members`.
    """
    boxes, subtitles, rows, maes = {}, {}, [], {}
    for season in seasons:
        runs = [run for run in season.runs if run.published]
        if not runs:
            continue
        predictions = np.concatenate([run.published["predictions"] for run in runs])
        surge = np.concatenate([np.where(run.steps, run.samples.surge, np.nan) for run in runs])
        widths = [run.published["halfwidths"] for run in runs if "halfwidths" in run.published]
        halfwidths = np.concatenate(widths) if len(widths) == len(runs) else None
        table = scores(predictions, surge, names, halfwidths)
        error = np.abs(predictions - surge[:, None])
        counted = ~np.isnan(surge)
        boxes[season.boat] = {
            name: box(error[counted, k], int(table[name]["diverged"] or 0)) for k, name in enumerate(names)
        }
        hours = sum(float(run.samples.inputs.dt[run.steps].sum()) for run in runs) / 3600
        subtitles[season.boat] = f"{hours:.1f} h, {np.nanmean(surge):.2f} m/s"
        maes[season.boat] = {name: np.inf if row["mae"] is None else row["mae"] for name, row in table.items()}
        rest = hours, float(np.nanmean(surge))
        for name in by_error({name: row["mae"] for name, row in table.items()}):
            row, remark = table[name], (remarks or {}).get(name, "")
            found = *(row.get(column) for column in COLUMNS), row["steps"], row["diverged"]
            rows.append((season.boat, name, *found, *rest, remark))
    if not rows:
        here = ["The runs that were given were not replayed in these folders, so that there are no online predictions."]
        return Section("online", "Online prediction error", PAPER_RESULT, here)
    columns = ("boat", "method", "MAE, m/s", "median, m/s", "RMSE, m/s", "fit, %", "skill",
               "coverage of the 90 % interval", "steps", "not finite", "run time, h", "mean speed, m/s",
               "remark")  # fmt: skip
    order = by_error(mean_errors(maes))  # of all panels
    boxes = {boat: {name: row[name] for name in order} for boat, row in boxes.items()}
    return Section(
        "online",
        "Online prediction error",
        PAPER_RESULT,
        [*_findings(maes), *explained],
        [
            Drawn(
                "online",
                boxes_figure(boxes, subtitles, LABEL, points=False, reference=PERSISTENCE, least=LEAST),
                "One step ahead, predicted before learning; the lowest mean over boats first. Box: quartiles; line: 5 "
                "to 95 %; diamond: MAE; dotted: the MAE of persistence. Beside each name the measured run time and the "
                f"mean speed. What lies below {1000 * LEAST:g} mm/s is off the axis.",
            )
        ],
        [summary("online_fleet", maes, "MAE, m/s", remarks), ResultTable("online", columns, rows)],
    )


def _findings(maes: dict[str, dict[str, float]]) -> list[str]:
    names, boats = list(next(iter(maes.values()))), len(maes)
    three = [name for name in PAPER if name in names]
    here = []
    if len(three) > 1:
        here.append(tally("lowest MAE", three, [min(three, key=row.__getitem__) for row in maes.values()]))
    if "average" in names and "aid" in names:
        better = sum(row["average"] < row["aid"] for row in maes.values())
        here.append(f"The average beats AID {on(better, boats)}.")
    every = [min(row, key=row.__getitem__) for row in maes.values()]
    winners = ", ".join(f"{name} {on(every.count(name), boats)}" for name in dict.fromkeys(every))
    here.append(f"The lowest of all: {winners}.")
    if PERSISTENCE in names:
        worse = [name for name in names if all(row[name] >= row[PERSISTENCE] for row in maes.values())]
        worse = [name for name in worse if name != PERSISTENCE]
        here.append("No better than persistence on any boat: " + (", ".join(worse) or "none of them") + ".")
    return here
