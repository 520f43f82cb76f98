"""The figure of a failing thruster: remaining thrust, speed, and evidence over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.display.figures import INK, SIDES, colours, themed

FAULT, ALARM = "#B0417A", "#AA4499"


def fault_figure(
    time: np.ndarray,
    effectiveness: np.ndarray,
    surge: np.ndarray,
    predictions: Mapping[str, np.ndarray],
    evidence: np.ndarray,
    threshold: float,
    fault: float | None = None,
    alarms: Sequence[float] = (),
    title: str = "",
    unit: str = "share of the thrust",
):
    """Three panels over time: thrust of both sides, measured and predicted speed, evidence of a loss.

    Args:
        time: s, `(time,)`.
        effectiveness: of the left and right thruster, or their thrust, `(time, 2)`; NaN where unknown.
        surge: m/s, `(time,)`; NaN where it was not measured.
        predictions: m/s, `(time,)` each, by the estimator's name.
        evidence: against the left and right thruster, `(time, 2)`.
        threshold: of the evidence.
        fault: time of the fault, s; None if there was none.
        alarms: times at which they were raised, s.
        title: of the figure.
        unit: of `effectiveness`, for its axis.

    Raises:
        MissingExtraError: matplotlib is not installed.

    >>> t = np.arange(5.0)
    >>> figure = fault_figure(t, np.ones((5, 2)), t, {"aid": t}, np.zeros((5, 2)), 20.0, fault=2.0, alarms=[3.0])
    >>> [axes.get_ylabel() for axes in figure.axes]
    ['share of the thrust', 'surge, m/s', 'evidence of a loss']
    """
    palette = colours(list(predictions))
    with themed() as Figure:
        figure = Figure(figsize=(9, 7.5), dpi=80)
        figure.subplots_adjust(left=0.08, right=0.98, top=0.91, bottom=0.07, hspace=0.12)
        thrust, speed, proof = axes = figure.subplots(3, 1, sharex=True, height_ratios=(2, 3, 2))
        minutes = time / 60
        for k, (side, colour) in enumerate(SIDES.items()):
            thrust.plot(minutes, effectiveness[:, k], color=colour, linewidth=1.4, label=side)
            proof.plot(minutes, evidence[:, k], color=colour, linewidth=1.4, label=side)
        speed.plot(minutes, surge, color=INK, linewidth=2.2, label="measured")
        for name, prediction in predictions.items():
            speed.plot(minutes, prediction, color=palette[name], linewidth=0.9, label=name)
        proof.axhline(threshold, color=INK, linewidth=1, linestyle=":", label="threshold")
        for panel in axes:
            if fault is not None:
                panel.axvline(fault / 60, color=FAULT, linewidth=1.5, linestyle="--")
            for alarm in alarms:
                panel.axvline(alarm / 60, color=ALARM, linewidth=1.5)
            panel.grid(alpha=0.25)
            panel.margins(x=0, y=0.08)
        _mark(thrust, fault, alarms)
        thrust.set(ylabel=unit)
        speed.set(ylabel="surge, m/s")
        proof.set(ylabel="evidence of a loss", xlabel="time, min")
        for panel in axes:
            low, high = panel.get_ylim()
            panel.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
            panel.legend(loc="upper left", ncols=6, fontsize=8)
        figure.suptitle(title)
        return figure


def _mark(panel, fault: float | None, alarms: Sequence[float]) -> None:
    """Label the vertical lines above the panel. Only the first alarm gets a label, on the right of the fault's."""
    style = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": 8}
    if fault is not None:
        panel.annotate("fault ", (fault / 60, 1), (0, 4), ha="right", color=FAULT, **style)
    if len(alarms):
        after = "" if fault is None else f" {alarms[0] - fault:.0f} s after"
        panel.annotate(f" alarm{after}", (alarms[0] / 60, 1), (0, 4), ha="left", color=ALARM, **style)
