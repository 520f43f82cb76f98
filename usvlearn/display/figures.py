"""Colours, themes and panels of figures. Matplotlib (extra `plot`) is imported inside the functions that use it."""

from __future__ import annotations

import functools
import io
import logging
import textwrap
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

import numpy as np

from usvlearn.errors import MissingExtraError, cause_of, printable

P = ParamSpec("P")
T = TypeVar("T")

INK, LINE = "#1f2430", "#c8ccd4"  # text and axes; grids. A report replaces them by the colours of its theme
SEVEN = {  # the colours of TensorBoard's runs, in its order, and who has them: estimators that are never compared share
    ("persistence",): "#425066", ("aid",): "#12b5cb", ("ensemble",): "#e52592", ("sift_map", "rls"): "#f9ab00",
    ("joint",): "#9334e6", ("rnn",): "#7cb342", ("arx",): "#e8710a",
}  # fmt: skip
KNOWN = {name: colour for names, colour in SEVEN.items() for name in names} | {  # visible on white and on black
    "average": "#5C6BC0", "weighted": "#1E88E5", "joint_quick": "#BA68C8",
    "joint_averaged": "#00897B",
}  # fmt: skip
# The paper's methods. `sift_map` is the thruster map of the default ensemble, which forgets by SIFt.
PAPER = ("aid", "rls", "sift_map", "rnn")
OTHERS = ("#CC6677", "#AA4499", "#B8A13E", "#A0522D", "#6699CC")
SIDES = {"left": "#6A5ACD", "right": "#44AA99"}  # colours of the thrusters, which no estimator has


def colours(names: Sequence[str]) -> dict[str, str]:
    """The colour of each estimator: a fixed one if it is in the default ensemble, else one of OTHERS by its name.

    So an estimator has one colour in all figures, whichever others are beside it. Only where two of the same figure
    would share a colour, the second one has the next. NAME+ has the colour of NAME.
    """
    palette = dict(KNOWN)
    for name in dict.fromkeys(name.rstrip("+") for name in names):
        if name not in palette:
            first = zlib.crc32(name.encode()) % len(OTHERS)
            order = (*OTHERS[first:], *OTHERS[:first])
            palette[name] = next((each for each in order if each not in palette.values()), order[0])
    return {name: palette[name.rstrip("+")] for name in names}


@contextmanager
def themed() -> Iterator[type]:
    """A context with Matplotlib's Figure and one look: text INK, lines LINE, small letters, no names as formulas."""
    try:
        from matplotlib import rc_context
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plot", "a figure") from error
    for package in ("matplotlib", "fontTools"):  # which say what they do where a command has set up logging
        logging.getLogger(package).setLevel(logging.WARNING)
    ink = dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK)
    plain = {"axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True, "grid.color": LINE}
    frame = {"legend.frameon": False, "axes.facecolor": "none", "axes.grid": True, "grid.linewidth": 0.6}
    small = dict.fromkeys(("axes.labelsize", "xtick.labelsize", "ytick.labelsize", "legend.fontsize"), 8)
    title = {"axes.titlesize": 8.5, "axes.titlelocation": "left", "figure.titlesize": 9, "figure.labelsize": 9}
    settings: Any = {**ink, **plain, **frame, **small, **title, "font.size": 9, "text.parse_math": False}
    with rc_context(settings):
        yield Figure


def attempted(draw: Callable[[], T], what: str, instead: Callable[[Any], T] = lambda figure: figure) -> T:
    """What `draw` returns. If it fails, there is a warning, and what `instead` makes of a figure that says why.

    So no figure ends a command. Errors as of `themed`.
    """
    with themed() as Figure:  # some labels are made only when a figure is rendered
        try:
            return draw()
        except (MissingExtraError, Warning):
            raise
        except Exception as error:
            sentence = printable(f"{what} could not be drawn ({cause_of(error)})")
            warnings.warn(f"{sentence}: the numbers are not affected", stacklevel=2)
        figure = Figure(figsize=(7, 1.2), dpi=100)
        figure.text(0.02, 0.5, textwrap.fill(sentence, 110), va="center", fontsize=8)
        return instead(figure)


def guarded(draw: Callable[P, Any]) -> Callable[P, Any]:
    """A function that draws, in `attempted`, and so in `themed`."""

    @functools.wraps(draw)
    def drawn(*args: P.args, **options: P.kwargs) -> Any:
        return attempted(lambda: draw(*args, **options), draw.__name__.strip("_").replace("_", " "))

    return drawn


def rendered(figure: Any, **options: Any) -> bytes:
    """A figure as PNG; `options` are those of `savefig`."""

    def saved(figure: Any) -> bytes:
        content = io.BytesIO()
        figure.savefig(content, format="png", **options)
        return content.getvalue()

    return attempted(lambda: saved(figure), "a figure", saved)


def figure_of(width: float, height: float, **options: Any) -> Any:
    """An empty figure, inches, in `themed`."""
    from matplotlib.figure import Figure

    return Figure(**{"figsize": (width, height), "layout": "constrained", **options})


def panels_of(
    count: int, across: int, size: tuple[float, float], room: tuple[float, float] = (0.0, 0.0), least: float = 0.0,
    shared: bool | str = True,
) -> tuple[Any, list[Any]]:  # fmt: skip
    """A figure and its panels, in rows of at most `across`, each of a size in inches, with `room` beside and above.

    `least` is of the whole width; `shared`: both axes of the panels, or "x" or False.
    """
    across = min(across, count)
    down = -(-count // across)
    figure = figure_of(max(least, room[0] + size[0] * across), room[1] + size[1] * down)
    every = figure.subplots(down, across, squeeze=False, sharex=bool(shared), sharey=shared is True).reshape(-1)
    for k, panel in enumerate(every):
        panel.set_visible(k < count)
        panel.tick_params(labelbottom=not shared or k + across >= count)
    return figure, list(every[:count])


def set_reach(panel: Any, low: float, high: float) -> None:
    """Set the ends of a vertical axis if both are known; else those of what is drawn hold."""
    if np.isfinite(low) and np.isfinite(high):
        panel.set_ylim(low, high)
