"""The figure of an event: commands, speed, yaw rate, and what remains of each thruster's thrust, over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.samples import Inputs
from usvlearn.display.figures import INK, SIDES, colours, guarded, themed

FAULT, MARK = "#B0417A", "#AA4499"
BEFORE, AFTER = 120.0, 300.0  # s about an event, which are shown


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
    """The course of a run from what was published of it (`usvlearn.runs.published`), arrays `(time, …)`.

    Args:
        names: of the predictions.
        output: the one that is the ensemble's.
        time: s.
        inputs: of the steps.
        surge: m/s, where it was measured.
        published: by name. Older runs have no `health`: their deviations are unknown.
    """
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
    """Five panels over time, about the first mark if there is one.

    Args:
        course: what is drawn.
        threshold: of the evidence.
        marks: time, s, and kind of each event, in order.
        fault: time of a simulated fault, s; None if there was none.
        title: of the figure.

    Raises:
        MissingExtraError: matplotlib is not installed.

    >>> t = np.arange(5.0)
    >>> two = np.ones((5, 2))
    >>> figure = event_figure(Course(t, two, t, {"aid": t}, t, two, 0.1 * two, 0 * two), 20.0, [(3.0, "loss")], 2.0)
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['command', 'surge, m/s', 'yaw rate, rad/s', 'share of the thrust', 'evidence of a loss']
    """
    if marks:
        course = course.about(marks[0][0] - BEFORE, marks[0][0] + AFTER)
        marks = [(time, kind) for time, kind in marks if time <= course.time[-1]]
    palette, minutes = colours(list(course.predictions)), course.time / 60
    with themed() as Figure:
        figure = Figure(figsize=(9, 9.5), dpi=80)
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
            panel.grid(alpha=0.25)
            panel.margins(x=0, y=0.08)
        _mark(command, fault, marks)
        labels = ("command", "surge, m/s", "yaw rate, rad/s", "share of the thrust", "evidence of a loss")
        for panel, label in zip(axes, labels, strict=True):
            panel.set_ylabel(label)
            low, high = panel.get_ylim()
            if panel is thrust:
                low, high = max(low, -0.6), min(high, 1.8)
            panel.set_ylim(low, high + 0.28 * (high - low))  # room for the legend
            panel.legend(loc="upper left", ncols=6, fontsize=8)
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
