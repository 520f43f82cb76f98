"""Figures of a boat's runs: what was predicted, identified, forecast and lost; and which of them TensorBoard gets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.samples import Fleet, Inputs, tree_map
from usvlearn.display.figures import (
    INK,
    KNOWN,
    SIDES,
    colours,
    figure_of,
    guarded,
    panels_of,
    set_reach,
)
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.monitors.state import THRESHOLD
from usvlearn.estimators.joint.curves import Curve, curves
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import COMMANDS
from usvlearn.evaluation.diagnostics import Truth
from usvlearn.evaluation.horizons import Scores
from usvlearn.evaluation.metrics import MINUTE, PERSISTENCE, worst_minute
from usvlearn.evaluation.season import measured
from usvlearn.runs.prediction_files import Published, joined

READ, LEFT, RIGHT = KNOWN["joint_averaged"], *SIDES.values()  # colours: of what is identified, of the thrusters
ACROSS = 4  # panels of boats in a row
FAULT, MARK = "#B0417A", "#AA4499"
BEFORE, AFTER = 120.0, 300.0  # s about an event, which are shown
LEAST_FIGURES, STEPS_PER_FIGURE = 4, 100_000  # of a replay: a figure takes as long as ten thousand compiled steps
RUNS = 24  # in a figure
SEASONS = 4  # bands of identified curves


class Traces(NamedTuple):
    """A run of one boat."""

    name: str
    time: np.ndarray  # (time,) s
    surge: np.ndarray  # (time,) m/s, NaN where it was not measured
    predicted: np.ndarray  # (time,) m/s


@guarded
def runs_figure(runs: Sequence[Traces], name: str, title: str):
    """Measured and predicted speed of a boat's runs above each other, with their MAE; beside each its worst minute."""
    known = [run.surge[np.isfinite(run.surge)] for run in runs]
    errors = [run.predicted - run.surge for run in runs]
    parts = [
        slice(*(worst_minute(run.time, error) or (0, len(error)))) for run, error in zip(runs, errors, strict=True)
    ]
    worst = np.concatenate([np.abs(error[part]) for error, part in zip(errors, parts, strict=True)])
    floor = min((float(x.min()) for x in known if len(x)), default=0.0)
    span = max((float(x.max()) for x in known if len(x)), default=0.0) - floor + 0.1  # m/s, between two runs
    scale = 2 * float(np.nanmax(worst)) + 0.02 if np.isfinite(worst).any() else 1.0  # m/s, between two errors
    height = 1.2 + 0.42 * max(len(runs), 4)
    figure = figure_of(9, height, dpi=90, layout=None)
    figure.subplots_adjust(left=0.25, right=0.985, top=1 - 0.6 / height, bottom=0.45 / height, wspace=0.06)
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    colour, whole = colours([name])[name], [slice(None)] * len(runs)
    measured, predicted = [run.surge - floor for run in runs], [run.predicted - floor for run in runs]
    left.plot(*_rows(runs, measured, whole, span), color=INK, linewidth=1.6, label="measured")
    left.plot(*_rows(runs, predicted, whole, span), color=colour, linewidth=0.9, label=name)
    right.plot(*_rows(runs, errors, parts, scale), color=colour, linewidth=1.0)
    right.hlines([-k * scale for k in range(len(runs))], 0, MINUTE, color=INK, linewidth=0.5)
    for k, (run, part) in enumerate(zip(runs, parts, strict=True)):
        if len(run.time[part]):
            ends = run.time[part][[0, -1]]
            left.fill_between(ends, -k * span, (0.9 - k) * span, color=INK, alpha=0.12, linewidth=0)
    labels = [f"{_short(run.name)}  {_mae(error)}" for run, error in zip(runs, errors, strict=True)]
    left.set_yticks([-k * span for k in range(len(runs))], labels)
    left.set(xlabel=f"time in the run, s; {span:.1f} m/s between two runs", ylim=((0.5 - len(runs)) * span, span))
    right.set(xlabel=f"s; {scale:.2f} m/s between two runs", title="predicted − measured, worst minute", yticks=[])
    right.set_ylim((0.5 - len(runs)) * scale, 0.6 * scale)
    for panel in (left, right):
        panel.margins(x=0)
        panel.grid(False, axis="y")
    figure.suptitle(f"{title}, MAE in m/s", x=0.01, ha="left")
    left.legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1)
    return figure


def _rows(
    runs: Sequence[Traces], lines: Sequence[np.ndarray], parts: Sequence[slice], span: float
) -> tuple[np.ndarray, np.ndarray]:
    """Time and height of a part of each run, one below the other, with gaps between; a part begins at 0 s."""
    times, heights = [], []
    for k, (run, line, part) in enumerate(zip(runs, lines, parts, strict=True)):
        time = run.time[part]
        times.append(np.append(time - (time[0] if part.start and len(time) else 0.0), np.nan))
        heights.append(np.append(line[part] - k * span, np.nan))
    return np.concatenate(times), np.concatenate(heights)


def _short(name: str) -> str:
    return name if len(name) <= 18 else f"{name[:17]}…"


def _mae(error: np.ndarray) -> str:
    return f"{np.nanmean(np.abs(error)):.3f}" if np.isfinite(error).any() else "–"


@guarded
def identified_figure(
    seasons: Sequence[Mapping[str, Curve]], identified: Identified, truth: Mapping[str, float], title: str
):
    """Drag over speed, thrust and steady speed over command, with bands and known truths."""
    lines = {"drag": (0, READ), "thrust_left": (1, LEFT), "thrust_right": (1, RIGHT), "steady_speed": (2, READ)}
    labels = (
        ("speed, m/s", "drag, N"),
        ("command, share of full scale", "thrust of a side at standstill, N"),
        ("command of both sides, share", "steady speed, m/s"),
    )
    half = identified["steady_speed_full"].value / 2
    points = [
        (0, half, "drag_half_speed", INK),
        (1, 1.0, "thrust_full_left", LEFT),
        (1, 1.0, "thrust_full_right", RIGHT),
        *((2, at, f"steady_speed_{name}", INK) for name, at in COMMANDS.items()),
    ]
    figure = figure_of(9.5, 2.9, dpi=90, layout=None)
    figure.subplots_adjust(left=0.06, right=0.985, top=0.88, bottom=0.17, wspace=0.22)
    panels = figure.subplots(1, 3)
    for k, shown in enumerate(seasons, 1):
        strength, last = k / len(seasons), k == len(seasons)
        for name, (place, colour) in lines.items():
            curve, label = shown[name], name.rpartition("_")[2] if last else None
            panels[place].plot(curve.at, curve.value, color=colour, linewidth=1.4, alpha=strength, label=label)
            style = {"color": colour, "alpha": 0.22 * strength if last else 0.06, "linewidth": 0}
            panels[place].fill_between(curve.at, curve.low, curve.high, **style)
    for place, at, name, colour in points:
        if name in truth:
            panels[place].plot(at, truth[name], marker="x", color=colour, linestyle="", clip_on=False)
    for panel, (xlabel, ylabel) in zip(panels, labels, strict=True):
        panel.set(xlabel=xlabel, ylabel=ylabel)
    if len(seasons) > 1:  # early bands may be very wide
        for name, (place, _) in lines.items():
            set_reach(panels[place], min(0.0, 1.1 * seasons[-1][name].low.min()), 1.3 * seasons[-1][name].high.max())
    panels[1].legend()
    figure.suptitle(f"{title}: identified")
    return figure


@guarded
def forecast_figure(scores: Scores):
    """Skill against horizon, of `evaluation.horizons.horizon_scores`; a panel per boat, a line per estimator."""
    names = list(next(iter(scores.values())))
    palette = colours(names)
    figure, panels = panels_of(len(scores), ACROSS, (2.4, 2.3), (0.0, 0.8), least=4.6)
    for panel, (boat, table) in zip(panels, scores.items(), strict=False):
        panel.axhline(0.0, color=palette[PERSISTENCE], linewidth=1.0, linestyle=":")
        for name in (each for each in names if each != PERSISTENCE):
            at = [float(h) for h in table[name]]
            skill = [np.nan if row["skill"] is None else row["skill"] for row in table[name].values()]
            wide = 2.0 if name == names[-1] else 1.1
            panel.plot(at, skill, color=palette[name], linewidth=wide, marker="o", markersize=3, label=name)
        panel.set(title=boat, xlabel="horizon, s", xscale="log")
        ticks = [float(h) for h in table[names[0]]]
        panel.set_xticks(ticks, [f"{h:g}" for h in ticks])
        panel.minorticks_off()
    least = min((row["skill"] for t in scores.values() for r in t.values() for row in r.values()
                 if row["skill"] is not None), default=0.0)  # fmt: skip
    panels[0].set_ylim(max(-0.5, min(least, 0.0)) - 0.05, 1.0)
    figure.supylabel("skill")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=min(6, len(labels)), loc="outside lower center")
    return figure


class Course(NamedTuple):
    """One run of one boat. Arrays are `(time,)`, or `(time, 2)` of left and right; NaN where unknown."""

    time: np.ndarray  # s
    commands: np.ndarray  # (time, 2) share of full scale
    surge: np.ndarray  # m/s, where it was measured
    predictions: Mapping[str, np.ndarray]  # m/s, by the estimator's name
    yaw_rate: np.ndarray  # rad/s
    effectiveness: np.ndarray  # (time, 2) share of the thrust
    deviation: np.ndarray  # (time, 2) its standard deviation
    evidence: np.ndarray  # (time, 2) of a loss

    def about(self, first: float, last: float) -> Course:
        """The part between two times, s."""
        part = (self.time >= first) & (self.time <= last)
        cut = {name: x[part] for name, x in self._asdict().items() if name != "predictions"}
        return Course(**cut, predictions={name: x[part] for name, x in self.predictions.items()})


def course_of(
    names: Sequence[str],
    output: str,
    time: np.ndarray,
    inputs: Inputs,
    surge: np.ndarray,
    published: Mapping[str, np.ndarray],
) -> Course:
    """The course of a run from what was published of it, arrays `(time, …)`; older runs have no `health`."""
    shown = [name for name in ("aid", output) if name in names]  # the ensemble is drawn last
    thrusters = published["thrusters"]
    health = published.get("health", np.full((len(time), 2), np.nan))
    return Course(
        time,
        np.stack([inputs.command_left, inputs.command_right], -1),
        surge,
        {name: published["predictions"][:, names.index(name)] for name in shown},
        np.asarray(inputs.yaw_rate),
        thrusters[:, :2],
        health[:, :2],
        thrusters[:, 2:4],
    )


@guarded
def event_figure(
    course: Course,
    threshold: float,
    marks: Sequence[tuple[float, str]] = (),
    fault: float | None = None,
    title: str = "",
):
    """Five panels over time, s, about the first mark if there is one; `fault` is when a simulated one begins."""
    if marks:
        course = course.about(marks[0][0] - BEFORE, marks[0][0] + AFTER)
        marks = [(time, kind) for time, kind in marks if time <= course.time[-1]]
    palette, minutes = colours(list(course.predictions)), course.time / 60
    figure = figure_of(9, 9.5, dpi=80, layout=None)
    figure.subplots_adjust(left=0.09, right=0.98, top=0.92, bottom=0.06, hspace=0.12)
    axes = figure.subplots(5, 1, sharex=True, height_ratios=(2, 3, 2, 3, 2))
    command, speed, turn, thrust, proof = axes
    for k, (side, colour) in enumerate(SIDES.items()):
        share = course.effectiveness[:, k]
        spread = np.where(share == 1, np.nan, NINETY * course.deviation[:, k])  # 1: there is little evidence
        command.plot(minutes, course.commands[:, k], color=colour, linewidth=1.1, label=side)
        thrust.fill_between(minutes, share - spread, share + spread, color=colour, alpha=0.18, linewidth=0)
        thrust.plot(minutes, share, color=colour, linewidth=1.4, label=side)
        proof.plot(minutes, course.evidence[:, k], color=colour, linewidth=1.4, label=side)
    speed.plot(minutes, course.surge, color=INK, linewidth=2.2, label="measured")
    for name, prediction in course.predictions.items():
        speed.plot(minutes, prediction, color=palette[name], linewidth=0.9, label=name)
    turn.plot(minutes, course.yaw_rate, color=INK, linewidth=1.1, label="measured")
    proof.axhline(threshold, color=INK, linewidth=1, linestyle=":", label="threshold")
    for panel in axes:
        if fault is not None and course.time[0] <= fault <= course.time[-1]:
            panel.axvline(fault / 60, color=FAULT, linewidth=1.5, linestyle="--")
        for time, _ in marks:
            panel.axvline(time / 60, color=MARK, linewidth=1.5)
        panel.margins(x=0, y=0.08)
    _mark(command, fault, marks)
    labels = ("command", "surge, m/s", "yaw rate, rad/s", "share of the thrust", "evidence of a loss")
    for panel, label in zip(axes, labels, strict=True):
        panel.set_ylabel(label)
        low, high = panel.get_ylim()
        if panel is thrust:
            low, high = max(low, -0.6), min(high, 1.8)
        panel.set_ylim(low, high + 0.28 * (high - low))  # room for the legend
        panel.legend(loc="upper left", ncols=6)
    proof.set_xlabel("time, min")
    figure.suptitle(title)
    return figure


def _mark(panel, fault: float | None, marks: Sequence[tuple[float, str]]) -> None:
    """Label the vertical lines above the panel. Only the first event gets a label, on the right of the fault's."""
    style = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": 8}
    if fault is not None:
        panel.annotate("fault ", (fault / 60, 1), (0, 4), ha="right", color=FAULT, **style)
    if marks:
        time, kind = marks[0]
        after = "" if fault is None else f" {time - fault:.0f} s after"
        panel.annotate(f" {kind}{after}", (time / 60, 1), (0, 4), ha="left", color=MARK, **style)


class Replayed(NamedTuple):
    """What is drawn of a replay."""

    fleet: Fleet
    ensemble: Ensemble
    seasons: Sequence[tuple[np.ndarray, Mapping[str, Identified]]]  # clock of the boats, and what was identified then
    truth: Truth  # quantities of simulated boats
    data: Mapping[str, Any]  # section of the configuration, which says when a simulated thruster fails
    results: Mapping[str, Any]  # of `results.json`
    published: Published


def figures(replayed: Replayed, everything: bool) -> Iterator[tuple[str, str, int, Callable[[], Any]]]:
    """The boat, the title, the index of the last run, and what draws each figure of a replay.

    The first event of each boat is drawn in any case; of the rest LEAST_FIGURES or one for each boat, and one more for
    each STEPS_PER_FIGURE steps of its boats; with `everything` all, of every run.
    """
    fleet, seasons, results = replayed.fleet, replayed.seasons, replayed.results
    ends = {boat: max(k for k, run in enumerate(fleet.runs) if run.lengths[e]) for e, boat in enumerate(fleet.boats)}
    parts = [range(max(0, stop - RUNS), stop) for stop in range(len(fleet.runs), 0, -RUNS)]
    wanted: list[tuple[str, str, int, Callable[[], Any]]] = []
    for part in parts if everything else parts[:1]:
        for boat, runs in ((boat, [k for k in part if fleet.runs[k].lengths[e]]) for e, boat in enumerate(fleet.boats)):
            if runs:
                wanted.append((boat, "runs", runs[-1], partial(_runs, replayed, boat, runs)))
    for boat in fleet.boats if seasons else ():
        wanted.append((boat, "identified curves", ends[boat], partial(_identified, replayed, boat)))
    for boat, scores in (results.get("forecast") or {}).items():
        wanted.append((boat, "forecasts", ends[boat], partial(forecast_figure, {boat: scores})))
    allowed = max(LEAST_FIGURES, len(fleet.boats)) + fleet.steps * len(fleet.boats) // STEPS_PER_FIGURE
    chosen = wanted if everything else wanted[:allowed]
    for boat, happened in results["events"].items():
        if happened:
            index = next(k for k, r in enumerate(fleet.runs) if r.names[fleet.boats.index(boat)] == happened[0]["run"])
            chosen.append((boat, "thrusters", index, partial(_thrusters, replayed, boat, index)))
    yield from sorted(chosen, key=lambda each: (fleet.boats.index(each[0]), each[2]))


def _of(replayed: Replayed, boat: str, index: int, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, dict]:
    """Time, measured speed, and what was published of a boat's run; all `(time, …)`."""
    places = [place for place in replayed.published.places() if place[0] == index]
    arrays = joined([replayed.published.read(*place, names).arrays for place in places])
    run, element = replayed.fleet.runs[index], replayed.fleet.boats.index(boat)
    part = slice(0, run.lengths[element])
    surge = measured(run.samples, replayed.ensemble.surge_limit)[part, element]
    return run.time[part, element], surge, {name: array[part, element] for name, array in arrays.items()}


def _runs(replayed: Replayed, boat: str, indices: Sequence[int]) -> Any:
    """The ensemble's prediction of some runs."""
    name, element, shown = replayed.ensemble.output, replayed.fleet.boats.index(boat), []
    for index in indices:
        time, surge, arrays = _of(replayed, boat, index, ("predictions",))
        predicted = arrays["predictions"][:, replayed.ensemble.names.index(name)]
        shown.append(Traces(replayed.fleet.runs[index].names[element], time, surge, predicted))
    return runs_figure(shown, name, f"{boat}: {len(shown)} runs")


def _identified(replayed: Replayed, boat: str) -> Any:
    """Curves of forces at some times of the season."""
    seasons = replayed.seasons
    chosen = np.unique(np.linspace(0, len(seasons) - 1, SEASONS + 1).astype(int)[1:])
    if not (shown := [each for k in chosen if (each := curves(seasons[k][1][boat]))]):
        return None
    hours = seasons[-1][0][replayed.fleet.boats.index(boat)] / 3600
    title = f"{boat} after {hours:.2g} h" + (" (fainter: earlier)" if len(shown) > 1 else "")
    return identified_figure(shown, seasons[-1][1][boat], replayed.truth.get(boat, {}), title)


def _thrusters(replayed: Replayed, boat: str, index: int) -> Any:
    """Health of the thrusters; if the log is simulated, also the fault."""
    time, surge, arrays = _of(replayed, boat, index, ("predictions", "thrusters", "health"))
    run, element, fault = replayed.fleet.runs[index], replayed.fleet.boats.index(boat), replayed.data.get("fault")
    began = None if fault is None else 60 * (fault["minute"] - index * replayed.data["mission_minutes"])
    inputs = tree_map(lambda x: x[: len(time), element], run.samples.inputs)
    course = course_of(replayed.ensemble.names, replayed.ensemble.output, time, inputs, surge, arrays)
    happened = replayed.results["events"][boat]
    marks = [(each["time"], each["kind"]) for each in happened if each["run"] == run.names[element]]
    seen = began if began is not None and time[0] <= began <= time[-1] else None
    return event_figure(course, THRESHOLD, marks, seen, f"{boat}, {run.names[element]}")
