"""The batch fit of each boat: its quantities beside those learned online, sets of terms, diagnostics, figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.samples import tree_map
from usvlearn.display.figures import INK, SIDES, figure_of, guarded, set_reach
from usvlearn.display.terminal import ResultTable
from usvlearn.estimators.axis.turning_quantities import MEANING_OF_FIT, OF_FIT
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import Curve
from usvlearn.estimators.joint.excitation_warnings import WIDE, Quantity
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.evaluation.diagnostics import Truth, identified_boats
from usvlearn.evaluation.metrics import MINUTE
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.fit_file import Course, Diagnostics, Lags, Sailed, SavedFit
from usvlearn.report.sections.section import Drawn, Section

WEAR = ", wear"  # what the name of a set ends with, if the boat wears
STRONG = 0.6  # m/s, a current that is larger than what is expected, twice its prior deviation
TINY = 1e-12
UNKNOWN, DOUBTED = "no: not determined", "no: see above"
USES = (
    "Use the values of the fit: it has learned from all missions at once, the online estimate sees each sample once. "
    f"“{UNKNOWN}” marks an interval that is wider than ± half of the value."
)
CURVES = (
    "Curves of the fit with 90 % bands; below, for how long the boat sailed at such commands and speeds. Shaded and "
    "dotted: it sailed there for less than 5 s, so that the curve is an extrapolation."
)
RESIDUALS = (
    "Correlations of the errors, simulated − measured, with 99 % bounds (Ljung 1999, section 16.6). Those of the left "
    "panel are for errors that do not depend on each other; the others take into account that errors and commands do. "
    "By chance, one lag in a hundred is beyond them. A peak within some seconds after a command is thrust or its delay "
    "that the model lacks, a broad one drag; before 0 s, a controller answers the speed."
)
WORST = "The missions with the largest errors: their worst minute, shaded, and 30 s around it."


def fit_section(
    seasons: Sequence[Season], ensemble: Ensemble, fits: Mapping[str, SavedFit | str], truth: Truth
) -> Section | None:
    """Tables of quantities, sets of terms and missions, and three figures a boat; None without a fit."""
    if not fits:
        return None
    here, drawn, held = [], [], []
    rows: dict[str, list[tuple]] = {"fit": [], "fit_sets": [], "fit_missions": []}
    for season in seasons:
        if isinstance(fit := fits.get(season.boat), str):
            here.append(fit)
        if not isinstance(fit, SavedFit):
            continue
        last = tree_map(lambda leaf: leaf[-1:], season.state)
        online, known = identified_boats(ensemble, last, [season.boat]).get(season.boat), truth.get(season.boat, {})
        beside = {name: online.displayed(name) for name in online} if online is not None else {}
        rows["fit"] += _quantities(season.boat, fit, beside, known)
        rows["fit_sets"] += [
            (
                season.boat,
                name,
                *map(_known, (each.parameters, 0.0 - each.gain, each.error, each.mae)),
                name == fit.terms,
            )
            for name, each in fit.sets.items()
        ]
        held += [each.low <= known[name] <= each.high for name, each in fit.quantities.items() if name in known]
        here += _findings(season, fit)
        rows["fit_missions"] += [(season.boat, each.name, *map(_known, each[1:])) for each in fit.diagnostics.missions]
        drawn += _figures(season.boat, fit.diagnostics, known)
    if rows["fit"]:
        here += [*([] if any(DOUBTED in row for row in rows["fit"]) else [USES]), MEANING, MEANING_OF_FIT]
    if held:
        here.insert(0, f"The intervals of the fit hold {100 * np.mean(held):.0f} % of the truths (90 % asked).")
    true = any(row[-1] is not None for row in rows["fit"])
    columns = {
        "fit": ("boat", "quantity", "unit", "fit", "from (90 %)", "to (90 %)", "online", "from (90 %) online",
                "to (90 %) online", "use the fit", *(["truth"] if true else [])),
        "fit_sets": ("boat", "terms", "parameters", "worse by, a step", "± (one deviation)", "MAE, m/s", "used"),
        "fit_missions": ("boat", "mission", "measured steps", "sailed, min", "MAE, m/s", "fit, %", "bias, m/s",
                         "current, m/s", "worst minute from, s", "its MAE, m/s"),
    }  # fmt: skip
    if not true:
        rows["fit"] = [row[:-1] for row in rows["fit"]]
    sheets = [ResultTable(name, columns[name], each) for name, each in rows.items() if each]
    return Section("fit", "Batch fit: the best parameters of the whole log", "", here, drawn, sheets, first=2)


def _quantities(boat: str, fit: SavedFit, online: Mapping[str, Quantity], truth: Mapping[str, float]) -> list[tuple]:
    """Rows of the table."""
    rows, sure = [], {name for name in OF_FIT if name in fit.quantities and math.isfinite(fit.quantities[name].value)}
    for name, (value, low, high, unit) in fit.quantities.items():
        beside = [_known(x) for x in online[name][:3]] if name in online else [None] * 3
        use = DOUBTED if fit.doubts else "yes" if name in sure or high - low <= 2 * WIDE * abs(value) else UNKNOWN
        rows.append((boat, name, unit, *map(_known, (value, low, high)), *beside, use, truth.get(name)))
    return rows


def _known(x: float) -> float | None:
    """None for NaN; a whole number as such."""
    return None if math.isnan(x) else int(x) if x == int(x) and abs(x) >= 1 else x


def _findings(season: Season, fit: SavedFit) -> list[str]:
    """Sentences about one boat."""
    boat, used = season.boat, fit.sets.get(fit.terms)
    here = [f"{boat}: fitted to {_count(fit.missions, 'mission')} with the terms “{fit.terms}”."]
    if used is not None and used.mae == used.mae:
        here.append(
            f"{boat}: its simulation of these missions errs by {used.mae:.3f} m/s. It follows from the commands; the "
            "current of a mission is estimated along the way."
        )
    if fit.terms.endswith(WEAR):
        here.append(
            f"{boat}: the boat wears: the parameters are those of its last mission, and each mission is simulated with "
            "its own."
        )
    if fit.simulation:
        here.append(f"{boat}: {fit.simulation}")
    if fit.missions > len(season.runs):
        here.append(
            f"{boat}: the report has {_count(len(season.runs), 'run')}, less than the fit: run usvlearn fit again."
        )
    here += [f"{boat}: do not use these values before this is settled: {each}" for each in fit.doubts]
    here += [f"{boat}: {each}" for each in fit.lacks if each not in fit.doubts]
    return here + [f"{boat}: {each}" for each in _diagnosed(fit.diagnostics)]


def _diagnosed(saved: Diagnostics) -> list[str]:
    """Sentences about the diagnostics of one boat."""
    here = []
    fits = sorted((each.fit, each.name) for each in saved.missions if each.fit == each.fit)
    if fits:
        median = float(np.median([fit for fit, _ in fits]))
        least = f", least {_signed(fits[0][0])} % in {fits[0][1]}" if len(fits) > 1 else ""
        here.append(f"fit of a mission, 100 (1 − NRMSE): median {_signed(median)} %{least}.")
    strong = sum(each.current > STRONG for each in saved.missions)
    if strong:
        here.append(
            f"in {_count(strong, 'mission')} the current is above {STRONG:g} m/s. If it was weaker, the missions are "
            "too short, or turn too little, to separate a current from thrust."
        )
    ranges = [f"{side} commands from {_range(saved.sailed[side])}" for side in SIDES if _partly(saved.sailed[side])]
    if ranges:
        here.append(f"it sailed with {' and '.join(ranges)}: what is beyond is an extrapolation.")
    lags = saved.autocorrelation
    inside = np.flatnonzero(np.abs(lags.values) <= lags.bounds)
    if np.isfinite(lags.values).any():
        memory = f"until {lags.lags[inside[0]]:g} s" if len(inside) else f"beyond {lags.lags[-1]:g} s"
        here.append(f"errors are alike {memory} (autocorrelation outside its bounds), {lags.values[0]:.2f} at first.")
    for name, what in (("mean", "the mean command"), ("difference", "the difference of the commands")):
        here.append(_driven(saved.cross_correlation[name], what))
    return here


def _driven(correlation: Lags, what: str) -> str:
    """Whether errors follow a command."""
    after = correlation.lags >= 0
    values, bounds, lags = correlation.values[after], correlation.bounds[after], correlation.lags[after]
    if not np.isfinite(values).any():
        return f"{what} never changed, so that nothing is known of errors that follow it."
    beyond = np.abs(values) > bounds
    if not beyond.any():
        return f"errors do not follow {what}: all lags are within their bounds."
    most = int(np.argmax(np.where(beyond, np.abs(values) / np.maximum(bounds, TINY), 0.0)))
    return (
        f"errors follow {what}: {int(beyond.sum())} of {len(values)} lags are beyond their bounds, most at "
        f"{lags[most]:g} s ({values[most]:+.2f}).".replace("(-", "(−")
    )


def _partly(where: Sailed) -> bool:
    """Whether the boat sailed at some of the commands, and not at the least or not at the largest."""
    sailed = sailed_at(where)
    return bool(sailed.any() and not (sailed[0] and sailed[-1]))


def _range(where: Sailed) -> str:
    places = np.flatnonzero(sailed_at(where))
    return f"{where.edges[places[0]]:.2f} to {where.edges[places[-1] + 1]:.2f}".replace("-", "−")


def _signed(x: float) -> str:
    return f"{x:.0f}".replace("-", "−")


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def _figures(boat: str, saved: Diagnostics, truth: Mapping[str, float]) -> list[Drawn]:
    drawn = [
        Drawn(f"fit_curves_{boat}", curves_figure(saved, boat, truth), CURVES + (" Crosses: truth." if truth else "")),
        Drawn(f"fit_residuals_{boat}", residuals_figure(saved, boat), RESIDUALS),
    ]
    if saved.worst:
        drawn.append(Drawn(f"fit_worst_{boat}", worst_figure(saved.worst, boat), WORST))
    return drawn


FITTED = "#D55E00"  # the colour of what is simulated with a fit
ENOUGH = 5.0  # s in a bin or beside it: the boat sailed there
ACROSS = 3  # worst minutes in a row
ROOM = 0.6  # of the height of a curve, by which its band may be higher


def sailed_at(where: Sailed) -> np.ndarray:
    """Whether the boat sailed at each bin, or at one beside it, for ENOUGH seconds, bool `(bins,)`."""
    enough = where.seconds >= ENOUGH
    return enough | np.append(enough[1:], False) | np.append(False, enough[:-1])


@guarded
def curves_figure(saved: Diagnostics, title: str, truth: Mapping[str, float]):
    """Thrust of each side over its command and drag over the speed, with bands; below, the seconds sailed there."""
    points = {f"thrust_{side}": (1.0, truth.get(f"thrust_full_{side}")) for side in SIDES}
    points["drag"] = (truth.get("steady_speed_full", 0.0) / 2, truth.get("drag_half_speed"))
    panels = (
        ("thrust_left", "left", SIDES["left"], "command of the left side", "thrust at standstill, N"),
        ("thrust_right", "right", SIDES["right"], "command of the right side", "thrust at standstill, N"),
        ("drag", "speed", FITTED, "speed, m/s", "drag, N"),
    )
    figure = figure_of(9.5, 3.7)
    above, below = figure.subplots(2, 3, sharex="col", height_ratios=(3, 1))
    for upper, lower, (name, place, colour, xlabel, ylabel) in zip(above, below, panels, strict=True):
        curve, where = saved.curves[name], saved.sailed[place]
        known = _drawn(upper, curve, where, colour)
        if points[name][1] is not None:
            upper.plot(*points[name], marker="x", color=INK, linestyle="", clip_on=False, label="truth")
        lower.stairs(where.seconds / 60, where.edges, fill=True, color=colour, alpha=0.55)
        upper.set(ylabel=ylabel, xmargin=0)
        lower.set(xlabel=xlabel, xmargin=0)
        set_reach(upper, *_limits(curve, known))
    below[0].set_ylabel("sailed, min")
    above[0].set_title(title)
    handles, labels = above[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=5, loc="outside lower center")
    return figure


def _drawn(panel: Any, curve: Curve, where: Sailed, colour: str) -> np.ndarray:
    """Draw a curve; returns where the boat sailed, bool `(points,)`."""
    sailed = sailed_at(where)
    bins = np.clip(np.searchsorted(where.edges, curve.at, side="right") - 1, 0, len(sailed) - 1)
    known: np.ndarray = sailed[bins] | sailed[np.clip(bins - np.isin(curve.at, where.edges), 0, None)]
    panel.fill_between(curve.at, curve.low, curve.high, color=colour, alpha=0.22, linewidth=0, label="90 %")
    panel.plot(curve.at, np.where(known, curve.value, np.nan), color=colour, linewidth=1.6, label="fitted")
    panel.plot(curve.at, curve.value, color=colour, linewidth=1.1, linestyle=":", label="where it has not sailed")
    edges = np.flatnonzero(np.diff(np.concatenate([[True], sailed, [True]])))
    for k, (first, last) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        style = {"color": INK, "alpha": 0.1, "linewidth": 0, "label": "not sailed" if k == 0 else None}
        panel.axvspan(where.edges[first], where.edges[last], **style)
    return known


def _limits(curve: Curve, known: np.ndarray) -> tuple[float, float]:
    """Of the axis: the whole curve, the band where the boat sailed, and some of the rest of the band."""
    low, high = float(curve.value.min()), float(curve.value.max())
    room = ROOM * max(high - low, 1e-3)
    if known.any():
        low, high = min(low, float(curve.low[known].min())), max(high, float(curve.high[known].max()))
    low, high = min(low, max(float(curve.low.min()), low - room)), max(high, min(float(curve.high.max()), high + room))
    margin = 0.04 * max(high - low, 1e-3)
    return low - margin, high + margin


@guarded
def residuals_figure(saved: Diagnostics, title: str):
    """The autocorrelation of the errors, and their correlation with mean and difference of the commands."""
    cross = saved.cross_correlation
    parts = (
        (saved.autocorrelation, "errors with themselves", "lag, s"),
        (cross["mean"], "with the mean command", "error after the command by, s"),
        (cross["difference"], "with the difference, left − right", "error after the command by, s"),
    )
    figure = figure_of(9.5, 2.5)
    panels = figure.subplots(1, 3, width_ratios=(3, 4, 4))
    for panel, (lags, name, xlabel) in zip(panels, parts, strict=True):
        at, values, bounds = (x[np.isfinite(lags.values)] for x in lags)  # a slow sensor has few lags
        panel.fill_between(at, -bounds, bounds, color=INK, alpha=0.14, linewidth=0)
        panel.axhline(0.0, color=INK, linewidth=0.8)
        panel.plot(at, values, color=FITTED, linewidth=1.4)
        if lags.lags[0] < 0:
            panel.axvline(0.0, color=INK, linewidth=0.8, linestyle=":")
        panel.set(title=name, xlabel=xlabel, ylim=_correlations(lags), xmargin=0)
        panel.grid(False, axis="x")
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def _correlations(lags: Lags) -> tuple[float, float]:
    """Of the axis: the values and, if they are not too wide, the bounds."""
    wide = float(np.nanmedian(lags.bounds)) if np.isfinite(lags.bounds).any() else 0.1
    known = lags.values[np.isfinite(lags.values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    return min(1.1 * low, -1.5 * wide), max(1.1 * high, 1.5 * wide)


@guarded
def worst_figure(courses: Sequence[Course], title: str):
    """The worst minutes, shaded, and what is around them: measured and simulated speed, and below the commands."""
    across = min(ACROSS, len(courses))
    down = -(-len(courses) // across)
    figure = figure_of(1.0 + 3.2 * across, 0.5 + 2.7 * down)
    panels = figure.subplots(2 * down, across, squeeze=False, height_ratios=(2, 1) * down)
    for panel in panels.reshape(-1):
        panel.set_visible(False)
    for k, each in enumerate(courses):
        row, column = divmod(k, across)
        speed, command = panels[2 * row, column], panels[2 * row + 1, column]
        speed.plot(*_joined(each.time, each.measured), color=INK, linewidth=1.8, label="measured")
        speed.plot(each.time, each.simulated, color=FITTED, linewidth=1.2, label="simulated")
        for side, colour in SIDES.items():
            command.plot(each.time, getattr(each, side), color=colour, linewidth=1.1, label=side)
        for panel in (speed, command):
            panel.set_visible(True)
            panel.axvspan(each.start, each.start + MINUTE, color=INK, alpha=0.1, linewidth=0)
            known = each.time[np.isfinite(each.time)]
            panel.set_xlim(*((known.min(), known.max()) if len(known) > 1 else (0.0, 1.0)))
        speed.tick_params(labelbottom=False)
        speed.set(title=_short(each.name), ylabel="" if column else "speed, m/s")
        command.set(xlabel="time in the log, s", ylabel="" if column else "command")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    more, names = panels[1, 0].get_legend_handles_labels()
    figure.legend([*handles, *more], [*labels, *names], ncols=4, loc="outside upper right")
    figure.suptitle(title, x=0.01, ha="left")
    return figure


def _joined(time: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The known speeds, joined by lines across gaps of less than 3 s."""
    known = np.isfinite(speed)
    time, speed = time[known], speed[known]
    gaps = np.flatnonzero(np.diff(time) > 3.0) + 1
    return np.insert(time, gaps, np.nan), np.insert(speed, gaps, np.nan)


def _short(name: str) -> str:
    return name if len(name) <= 40 else f"…{name[-39:]}"
