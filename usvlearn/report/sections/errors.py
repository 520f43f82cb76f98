"""Errors one step ahead (paper, figure 3), what is left in them, and forecasts by horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.display.figures import INK, LINE, PAPER, colours, guarded, panels_of, themed
from usvlearn.display.terminal import ResultTable
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.horizons import GROUPS, Scores, ensemble_scores
from usvlearn.evaluation.metrics import PERSISTENCE, Autocorrelation, autocorrelation_of_runs, by_error, scores
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.season_figures import box, boxes_figure
from usvlearn.report.sections.section import Drawn, Section, mean_errors, on, summary, tally
from usvlearn.runs.figures import forecast_figure

PAPER_RESULT = (
    "On all eight boats AID had the lowest online prediction error of the three methods, and the plain average (AVE) "
    "did not beat AID alone."
)
LABEL = "|predicted − measured| one step ahead, m/s"
LEAST = 2e-3  # m/s, the start of the figure's axis: far below the resolution of a measured speed
COLUMNS = ("mae", "median", "rmse", "fit", "skill", "coverage")
LAGS = 25  # steps, the largest
ACROSS = 3  # panels in a row
UNEVEN = 0.05  # relative scatter of the lengths of steps, from which on they are called uneven


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
        remarks, explained: about these names; see `usvlearn.evaluation.diagnostics`.
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


def residual_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """The autocorrelation of the errors of the combiner that predicts; None if no run was replayed.

    Args:
        seasons: of all boats.
        ensemble: that was replayed.
    """
    column, found, here, uneven = ensemble.names.index(ensemble.output), {}, [], False
    for season in seasons:
        runs = [run for run in season.runs if run.published]
        if not runs or np.isnan((each := autocorrelation_of_runs(runs, column, LAGS)).values[0]):
            continue
        found[season.boat] = each
        beyond = np.abs(each.values) > each.bounds
        here.append(
            f"{season.boat}, {ensemble.output}: {each.values[0]:.2f} at a lag of 1 step; {int(beyond.sum())} of {LAGS} "
            f"lags are beyond ± {each.bounds[0]:.3f}."
        )
        lengths = np.concatenate([run.samples.inputs.dt[run.steps] for run in runs])
        uneven = uneven or bool(lengths.std() > UNEVEN * lengths.mean())
    if not found:
        return None
    here.append(
        "The bounds hold 99 % of the values if errors do not depend on each other. Values beyond them mean that there "
        "is more to learn: waves, gusts, a slow drift. With many steps, small values are beyond them, too."
    )
    if uneven:
        here.append("The steps of these logs are of different lengths: a lag is a number of steps, not a time.")
    caption = (
        f"Autocorrelation of the errors of {ensemble.output} one step ahead, up to {LAGS} steps apart. Pairs are "
        "within a segment of a run; steps that do not count are left out. Shaded: ± 2.58/√N, N the number of pairs."
    )
    rows = [
        (boat, lag, float(value), float(bound), int(pairs))
        for boat, each in found.items()
        for lag, (value, bound, pairs) in enumerate(zip(each.values, each.bounds, each.pairs, strict=True), 1)
    ]
    columns = ("boat", "lag, steps", "autocorrelation", "99 % bound", "pairs")
    drawn = Drawn("residuals", residual_figure(found, ensemble.output), caption)
    table = ResultTable("residuals", columns, rows)
    return Section("residuals", "Residuals: what is left in the errors", "", here, [drawn], [table])


@guarded
def residual_figure(boats: Mapping[str, Autocorrelation], name: str):
    """A panel per boat: the autocorrelation against the lag, and the 99 % bounds.

    Args:
        boats: by name.
        name: of the estimator, for its colour.

    >>> figure = residual_figure({"heron": Autocorrelation(np.array([0.3, 0.1]), np.array([90, 80]))}, "ensemble")
    >>> figure.axes[0].get_xlabel()
    'lag, steps'
    """
    colour, across = colours([name])[name], min(ACROSS, len(boats))
    down = -(-len(boats) // across)
    with themed() as Figure:
        figure = Figure(figsize=(1.2 + 2.9 * across, 0.4 + 1.7 * down), layout="constrained")
        panels = panels_of(figure, len(boats), across, sharex=True, sharey=True)
        for panel, (boat, found) in zip(panels, boats.items(), strict=False):
            lags = np.arange(1, len(found.values) + 1)
            panel.fill_between(lags, -found.bounds, found.bounds, color=INK, alpha=0.14, linewidth=0)
            panel.axhline(0.0, color=INK, linewidth=0.8)
            panel.vlines(lags, 0, found.values, color=colour, linewidth=2)
            panel.plot(lags, found.values, ".", color=colour, markersize=5)
            panel.set_title(boat, loc="left", fontsize=8.5)
            panel.set_xlabel("lag, steps", fontsize=8)
            panel.grid(axis="y", color=LINE)
            panel.tick_params(labelsize=8)
        return figure


def forecast_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """Errors of the forecasts that became due in all runs that were replayed; None of an ensemble without forecasts.

    Args:
        seasons: of all boats.
        ensemble: that was replayed.
    """
    if ensemble.forecasts is None:
        return None
    found: Scores = {}
    for season in seasons:
        found |= _scores(season, ensemble)
    if not found:
        return None
    rows = [
        (
            boat,
            name,
            float(horizon),
            row["mae"],
            row["skill"],
            row.get("covers"),
            *(row.get(f"covers_{x}") for x in GROUPS),
            row.get("halfwidth"),
            row.get("interval"),
            row["steps"],
        )
        for boat, table in found.items()
        for name, each in table.items()
        for horizon, row in each.items()
    ]
    columns = ("boat", "method", "horizon, s", "MAE, m/s", "skill", "coverage of the 90 % interval",
               "where commands stay", "move", "move much", "mean half-width, m/s", "interval score, m/s",
               "forecasts")  # fmt: skip
    caption = (
        "Skill of forecasts, 1 − MAE/MAE(persistence), against the horizon. A forecast is made at its origin, from the "
        "measurements until then, and is given the commands, headings and yaw rates between. Dotted: persistence."
    )
    drawn = [Drawn("forecast", forecast_figure(found), caption)]
    here = _forecast_findings(found, ensemble.output)
    return Section("forecast", "Forecasts", "", here, drawn, [ResultTable("forecast", columns, rows)])


def _scores(season: Season, ensemble: Ensemble) -> Scores:
    """The scores of one boat; {} if its forecasts were not kept."""
    runs = [run for run in season.runs if "forecasts" in run.published]
    if not runs:
        return {}
    fleet, published = season._replace(runs=tuple(runs)).replayed
    return ensemble_scores(ensemble, fleet, published)


def _forecast_findings(found: Scores, output: str) -> list[str]:
    """What the figure shows, in words."""
    horizons = list(next(iter(found.values()))[output])
    skills = {h: [x for table in found.values() if (x := table[output][h]["skill"]) is not None] for h in horizons}
    shown = ", ".join(f"{sum(each) / len(each):.2f} at {h} s" for h, each in skills.items() if each)
    here = [f"Skill of {output}, mean over boats: {shown}."]
    below = [
        f"{boat} at {h} s" for boat, table in found.items() for h in horizons if (table[output][h]["skill"] or 0.0) < 0
    ]
    here.append(
        f"Worse than persistence: {', '.join(below)}." if below else "Better than persistence wherever it is judged."
    )
    rows = [row for table in found.values() for row in table[output].values()]
    held = [share for row in rows if (share := row.get("covers")) is not None]
    if held:
        here.append(f"The intervals hold {100 * min(held):.0f} … {100 * max(held):.0f} % of the speeds (90 % asked).")
    for group, words in zip(GROUPS, ("stay", "move", "move much"), strict=True):
        if own := [share for row in rows if (share := row.get(f"covers_{group}")) is not None]:
            here.append(f"Where the commands {words}: {100 * min(own):.0f} … {100 * max(own):.0f} %.")
    return here
