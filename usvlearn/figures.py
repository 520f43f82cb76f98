"""Figures. Matplotlib (extra `plot`) is imported inside the functions that use it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from usvlearn.errors import MissingExtraError

INK, LINE = "#1f2430", "#c8ccd4"  # text and axes; grids. A report replaces them by the colours of its theme
KNOWN = {  # Okabe & Ito; then hues between them that are visible on white and on black
    "aid": "#0072B2", "rls": "#E69F00", "sift_map": "#E69F00", "rnn": "#009E73", "average": "#CC79A7",
    "weighted": "#56B4E9", "ensemble": "#D55E00", "persistence": "#999999",
    "joint": "#6A5ACD", "joint_quick": "#B0417A", "arx": "#44AA99", "reader": "#999933",
}  # fmt: skip
# The paper's methods. `sift_map` is the thruster map of the default ensemble, which forgets by SIFt.
PAPER = ("aid", "rls", "sift_map", "rnn")
OTHERS = ("#CC6677", "#AA4499", "#B8A13E", "#A0522D", "#6699CC")


def colours(names: Sequence[str]) -> dict[str, str]:
    """The colour of each estimator: a fixed one if it is in the default ensemble, else the next free colour.

    NAME+ has the colour of NAME.

    >>> colours(["aid", "my_rls", "ensemble", "ensemble+"])
    {'aid': '#0072B2', 'my_rls': '#CC6677', 'ensemble': '#D55E00', 'ensemble+': '#D55E00'}
    """
    rest = iter(OTHERS * (1 + len(names) // len(OTHERS)))
    found = dict(KNOWN)
    for name in names:
        if name.rstrip("+") not in found:
            found[name.rstrip("+")] = next(rest)
    return {name: found[name.rstrip("+")] for name in names}


@contextmanager
def themed() -> Iterator[type]:
    """A context with Matplotlib's Figure, in which text is INK and lines are LINE.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot", "a figure") from error
    ink = dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK)
    plain = {"axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True, "grid.color": LINE}
    frame = {"legend.frameon": False, "axes.facecolor": "none", "grid.linewidth": 0.6, "font.size": 9}
    settings: Any = {**ink, **plain, **frame}
    with rc_context(settings):
        yield Figure


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
    with themed() as Figure:
        figure = Figure(figsize=(9, 6.3), dpi=80)
        figure.subplots_adjust(left=0.07, right=0.98, top=0.95, bottom=0.07, hspace=0.25)
        above, below = figure.subplots(2, 1, height_ratios=(2, 1))
        above.plot(time, surge, color=INK, linewidth=2.5, label="measured")
        palette = colours(names)
        if halfwidth is not None:
            low, high = predictions[:, -1] - halfwidth, predictions[:, -1] + halfwidth
            style = {"color": palette[names[-1]], "alpha": 0.25, "linewidth": 0}
            above.fill_between(time, low, high, label=f"{names[-1]}, 90 %", **style)
        error = predictions - surge[:, None]
        limit = np.nanpercentile(np.abs(error), 98) if np.isfinite(error).any() else 1.0
        bins = np.linspace(-limit, limit, 61)
        for k, name in enumerate(names):
            style = {"color": palette[name], "label": name, "linewidth": 1.2}
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
