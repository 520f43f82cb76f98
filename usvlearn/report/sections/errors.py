"""Errors one step ahead (paper, figure 3), their autocorrelation, and forecasts by horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.display.figures import INK, PAPER, colours, guarded, panels_of
from usvlearn.display.terminal import ResultTable
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.horizons import GROUPS, Scores, ensemble_scores
from usvlearn.evaluation.metrics import NORMAL_99, PERSISTENCE, by_error, scores
from usvlearn.evaluation.season import Season
from usvlearn.model.fit.correlations import lagged_sums
from usvlearn.report.sections.section import WORSE, Drawn, Section, mean_errors, on, summary, tally
from usvlearn.runs.figures import forecast_figure

ROW, BOXES_ACROSS = 0.19, 4  # inch, of a method; panels
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
    """Errors one step ahead, predicted before learning, over all runs that were replayed."""
    boxes, subtitles, rows, maes = {}, {}, [], {}
    for season in seasons:
        runs = [run for run in season.runs if run.published]
        if not runs:
            continue
        predictions = np.concatenate([run.published["predictions"] for run in runs])
        surge = np.concatenate([run.measured for run in runs])
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
            cells = *(row.get(column) for column in COLUMNS), row["steps"], row["diverged"]
            rows.append((season.boat, name, *cells, *rest, remark))
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


class Autocorrelation(NamedTuple):
    """Of errors at lags of 1, 2, … steps."""

    values: np.ndarray  # (lags,); NaN where there is no pair
    pairs: np.ndarray  # (lags,)

    @property
    def bounds(self) -> np.ndarray:
        """The half-width of the 99 % bounds for errors that do not depend on each other, `(lags,)`."""
        return NORMAL_99 / np.sqrt(np.maximum(self.pairs, 1))


def autocorrelation(errors: Sequence[np.ndarray], lags: int) -> Autocorrelation:
    """(1) of `usvlearn.model.fit.correlations` of segments, `(time,)`, NaN where a step does not count."""
    every = np.concatenate([*errors, np.empty(0)])
    mean = float(every[np.isfinite(every)].mean()) if np.isfinite(every).any() else 0.0
    centred = [np.where(np.isfinite(x), x - mean, np.nan) for x in errors if len(x)]
    sums, pairs = lagged_sums(centred, centred, lags)
    known = (pairs[1:] > 0) & (sums[0] > 0)
    values = sums[1:] / np.maximum(pairs[1:], 1) * (max(pairs[0], 1) / (sums[0] or 1.0))
    return Autocorrelation(np.where(known, values, np.nan), pairs[1:])


def residual_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """The autocorrelation of the errors of the combiner that predicts; None if no run was replayed."""
    column, correlations, here, uneven = ensemble.names.index(ensemble.output), {}, [], False
    for season in seasons:
        runs = [run for run in season.runs if run.published]
        errors = ((run.published["predictions"][:, column] - run.measured, run.masks.starts) for run in runs)
        each = autocorrelation([part for x, starts in errors for part in np.split(x, np.flatnonzero(starts))], LAGS)
        if np.isnan(each.values[0]):
            continue
        correlations[season.boat] = each
        beyond = np.abs(each.values) > each.bounds
        here.append(
            f"{season.boat}, {ensemble.output}: {each.values[0]:.2f} at a lag of 1 step; {int(beyond.sum())} of {LAGS} "
            f"lags are beyond ± {each.bounds[0]:.3f}."
        )
        lengths = np.concatenate([run.samples.inputs.dt[run.steps] for run in runs])
        uneven = uneven or bool(lengths.std() > UNEVEN * lengths.mean())
    if not correlations:
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
        for boat, each in correlations.items()
        for lag, (value, bound, pairs) in enumerate(zip(each.values, each.bounds, each.pairs, strict=True), 1)
    ]
    columns = ("boat", "lag, steps", "autocorrelation", "99 % bound", "pairs")
    drawn = Drawn("residuals", residual_figure(correlations, ensemble.output), caption)
    table = ResultTable("residuals", columns, rows)
    return Section("residuals", "Residuals: what is left in the errors", "", here, [drawn], [table])


@guarded
def residual_figure(boats: Mapping[str, Autocorrelation], name: str):
    """A panel per boat: the autocorrelation against the lag, and the 99 % bounds."""
    colour = colours([name])[name]
    figure, panels = panels_of(len(boats), ACROSS, (2.9, 1.7), (1.2, 0.4))
    for panel, (boat, result) in zip(panels, boats.items(), strict=False):
        lags = np.arange(1, len(result.values) + 1)
        panel.fill_between(lags, -result.bounds, result.bounds, color=INK, alpha=0.14, linewidth=0)
        panel.axhline(0.0, color=INK, linewidth=0.8)
        panel.vlines(lags, 0, result.values, color=colour, linewidth=2)
        panel.plot(lags, result.values, ".", color=colour, markersize=5)
        panel.set(title=boat, xlabel="lag, steps")
        panel.grid(False, axis="x")
    return figure


def forecast_section(seasons: Sequence[Season], ensemble: Ensemble) -> Section | None:
    """Errors of the forecasts that became due in all runs that were replayed; None of an ensemble without forecasts."""
    if ensemble.forecasts is None:
        return None
    scores: Scores = {}
    for season in seasons:
        scores |= _scores(season, ensemble)
    if not scores:
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
        for boat, table in scores.items()
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
    drawn = [Drawn("forecast", forecast_figure(scores), caption)]
    here = _forecast_findings(scores, ensemble.output)
    return Section("forecast", "Forecasts", "", here, drawn, [ResultTable("forecast", columns, rows)])


def _scores(season: Season, ensemble: Ensemble) -> Scores:
    """The scores of one boat; {} if its forecasts were not kept."""
    runs = [run for run in season.runs if "forecasts" in run.published]
    if not runs:
        return {}
    fleet, published = season._replace(runs=tuple(runs)).replayed
    return ensemble_scores(ensemble, fleet, published)


def _forecast_findings(scores: Scores, output: str) -> list[str]:
    """What the figure shows, in words."""
    horizons = list(next(iter(scores.values()))[output])
    skills = {h: [x for table in scores.values() if (x := table[output][h]["skill"]) is not None] for h in horizons}
    shown = ", ".join(f"{sum(each) / len(each):.2f} at {h} s" for h, each in skills.items() if each)
    here = [f"Skill of {output}, mean over boats: {shown}."]
    below = [
        f"{boat} at {h} s" for boat, table in scores.items() for h in horizons if (table[output][h]["skill"] or 0.0) < 0
    ]
    here.append(
        f"Worse than persistence: {', '.join(below)}." if below else "Better than persistence wherever it is judged."
    )
    rows = [row for table in scores.values() for row in table[output].values()]
    held = [share for row in rows if (share := row.get("covers")) is not None]
    if held:
        here.append(f"The intervals hold {100 * min(held):.0f} … {100 * max(held):.0f} % of the speeds (90 % asked).")
    for group, words in zip(GROUPS, ("stay", "move", "move much"), strict=True):
        if shares := [share for row in rows if (share := row.get(f"covers_{group}")) is not None]:
            here.append(f"Where the commands {words}: {100 * min(shares):.0f} … {100 * max(shares):.0f} %.")
    return here


class Box(NamedTuple):
    """A distribution, as it appears in figures and tables."""

    median: float
    lower: float  # quartile
    upper: float
    low: float  # 5 %
    high: float  # 95 %
    mean: float
    number: int  # of values
    beyond: np.ndarray  # the values outside low … high
    outliers: int  # more than 1.5 quartile distances above the box
    diverged: int = 0


def box(values: np.ndarray, diverged: int = 0) -> Box | None:
    """The box of some errors, or None if there are none."""
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low, lower, median, upper, high = (float(x) for x in np.percentile(values, (5, 25, 50, 75, 95)))
    beyond = values[(values < low) | (values > high)]
    outliers = int((values > upper + 1.5 * (upper - lower)).sum())
    return Box(median, lower, upper, low, high, float(values.mean()), len(values), beyond, outliers, diverged)


@guarded
def boxes_figure(
    boats: Mapping[str, Mapping[str, Box | None]],
    subtitles: Mapping[str, str],
    xlabel: str,
    points: bool = True,
    reference: str | None = None,
    least: float = 0.0,
):
    """A panel per boat, a row per method: quartiles, 5 and 95 %, mean, values beyond, and the number of diverged runs.

    The axis is logarithmic and starts at `least` or above; the mean of `reference` is a line.
    """
    names = list(next(iter(boats.values())))
    palette = colours(names)
    values = [x for row in boats.values() for each in row.values() if each for x in (each.low, each.high, each.mean)]
    values += [x for row in boats.values() for each in row.values() if each and points for x in each.beyond]
    known = np.array([x for x in values if x > 0])
    room = 4.0 if any(each and each.diverged for row in boats.values() for each in row.values()) else 1.3
    limits = (max(least, known.min() * 0.8), known.max() * room) if len(known) else (0.01, 1.0)
    figure, panels = panels_of(len(boats), BOXES_ACROSS, (2.3, ROW * len(names) + 0.55), (1.4, 0.45))
    for panel, (boat, row) in zip(panels, boats.items(), strict=True):
        panel.set(title=f"{boat}, {subtitles[boat]}", xscale="log", xlim=limits, ylim=(len(names) - 0.4, -0.6))
        panel.set_yticks(range(len(names)), names)
        panel.tick_params(axis="y", length=0)
        panel.grid(False, axis="y")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
        if reference is not None and (base := row.get(reference)) is not None:
            panel.axvline(base.mean, color=INK, linewidth=0.8, linestyle=":")
        for k, name in enumerate(names):
            _draw_box(panel, k, row[name], palette[name], name.endswith("+"), points)
    figure.supxlabel(xlabel)
    return figure


def _draw_box(panel, place: int, box: Box | None, colour: str, learning: bool, points: bool) -> None:
    if box is None:
        return
    panel.plot([box.low, box.high], [place, place], color=colour, linewidth=1.1, solid_capstyle="butt")
    wide = [box.lower, max(box.upper, box.lower * 1.01)]
    panel.fill_between(
        wide, place - 0.33, place + 0.33, facecolor="none" if learning else colour, edgecolor=colour, linewidth=1.1
    )
    panel.plot([box.median] * 2, [place - 0.33, place + 0.33], color=INK, linewidth=1.4)
    panel.plot(box.mean, place, marker="D", markersize=3.2, color="white", markeredgecolor=INK, markeredgewidth=0.8)
    if points and len(box.beyond):
        style = {"linestyle": "none", "marker": ".", "markersize": 2.2, "color": colour, "alpha": 0.5}
        panel.plot(box.beyond, np.full(len(box.beyond), place), rasterized=len(box.beyond) > 500, **style)
    if box.diverged:
        at = {"xycoords": ("axes fraction", "data"), "fontsize": 7, "ha": "right", "va": "center"}
        panel.annotate(f"{box.diverged} div.", (1.0, place), color=WORSE, **at)
