"""Figures; matplotlib is imported where it is used (extra `plot`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from usvlearn.errors import MissingExtraError

COLOURS = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#D55E00",
    "#999999",
    "#F0E442",
)  # Okabe & Ito


def prediction_figure(
    time: np.ndarray,
    surge: np.ndarray,
    predictions: np.ndarray,
    names: Sequence[str],
    title: str,
    halfwidth: np.ndarray | None = None,
):
    """Measured and predicted surge over time, above the errors' distributions.

    Args:
        time: s, `(time,)`.
        surge: m/s, `(time,)`; NaN where it was not measured.
        predictions: m/s, `(time, estimators)`.
        names: of the estimators.
        title: of the figure.
        halfwidth: of the interval about the last of them, m/s, `(time,)`.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot", "the figure of predictions") from error
    figure = Figure(figsize=(9, 6.3), dpi=80)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.95, bottom=0.07, hspace=0.25)
    above, below = figure.subplots(2, 1, height_ratios=(2, 1))
    above.plot(time, surge, color="black", linewidth=2.5, label="measured")
    if halfwidth is not None:
        low, high = predictions[:, -1] - halfwidth, predictions[:, -1] + halfwidth
        style = {"color": COLOURS[(len(names) - 1) % len(COLOURS)], "alpha": 0.25, "linewidth": 0}
        above.fill_between(time, low, high, label=f"{names[-1]}, 90 %", **style)
    error = predictions - surge[:, None]
    limit = np.nanpercentile(np.abs(error), 98) if np.isfinite(error).any() else 1.0
    bins = np.linspace(-limit, limit, 61)
    for k, name in enumerate(names):
        style = {"color": COLOURS[k % len(COLOURS)], "label": name, "linewidth": 1.2}
        above.plot(time, predictions[:, k], **style)
        finite = error[np.isfinite(error[:, k]), k]
        if len(finite):
            below.hist(finite.clip(-limit, limit), bins=bins, histtype="step", **style)
    seen = surge[np.isfinite(surge)]
    low, high = (seen.min(), seen.max()) if len(seen) else (0.0, 1.0)
    margin = 0.15 * (high - low) + 0.05
    above.set(xlabel="time in the run, s", ylabel="surge, m/s", title=title, ylim=(low - margin, high + margin))
    below.set(xlabel="predicted − measured, m/s (beyond the edge: in the last bin)", ylabel="steps")
    above.legend(ncols=4, fontsize="small")
    return figure
