"""Draws maps with their equilibria, and rates of networks; matplotlib is imported where it is used (extra `plot`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs.equilibria import Equilibrium, PiecewiseLinear, piecewise, sweep


class Mark(NamedTuple):
    """The mark of a class: filled if states come to it, hollow if they leave it, half filled if they do both."""

    colour: str  # Okabe & Ito
    marker: str
    fill: str


MARKS = {
    "deadbeat": Mark("#56B4E9", "s", "full"),
    "stable": Mark("#0072B2", "o", "full"),
    "stable oscillatory": Mark("#009E73", "D", "full"),
    "neutral two-cycles": Mark("#CC79A7", "h", "none"),
    "half-stable": Mark("#E69F00", "o", "left"),
    "unstable": Mark("#D55E00", "o", "none"),
    "unstable oscillatory": Mark("#D55E00", "D", "none"),
    "continuum": Mark("#F0E442", "o", "full"),
}
TIER_COLOURS = {
    "simple": "#D55E00", "gershgorin": "#E69F00", "lmi": "#CC79A7", "exact": "#0072B2", "interval": "#56B4E9",
    "box": "#009E73",
}  # fmt: skip
INK, PALE = "#222222", "#8A8A8A"
LISTED = 6  # equilibria of a class that the legend of one map lists one by one


def blank(purpose: str, **options: Any):
    """An empty matplotlib figure; a CertifyError, which names the purpose, without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise CertifyError(f"{purpose} needs matplotlib: run `pip install 'usvlearn[plot]'`") from error
    return Figure(**options)


def equilibria_figure(
    weights: ShallowWeights, u, title: str, lo: float = 0.0, hi: float = 1.0, headings: np.ndarray | None = None
):
    """The map x_k → x_{k+1} at constant input, its critical points, the identity line, and the equilibria by class.

    u is `(m,)`, or `(k, m)` for a map at each of k headings, rad, by which the maps are coloured. A CertifyError if the
    input does not fit, or without matplotlib.
    """
    figure = blank("the figure of equilibria", figsize=(8.4, 6.0), dpi=110)
    inputs = [u] if np.ndim(u) < 2 else u
    points = sweep(weights, inputs, lo, hi)
    if lo == hi:
        raise CertifyError(f"lo, hi: found {lo}, {hi}, expected lo < hi: give an interval that can be drawn")
    if len(inputs) != 1 and (headings is None or np.shape(headings) != (len(inputs),)):
        raise CertifyError(
            f"headings: found {'none' if headings is None else np.shape(headings)} for {len(inputs)} inputs, expected "
            "one each, rad: give the headings that u was made of"
        )
    maps = [piecewise(weights, each, lo, hi) for each in inputs]
    axes = figure.add_axes((0.09, 0.09, 0.6, 0.84), aspect="equal", anchor="NW")
    heights = np.concatenate([each.y for each in maps])
    width = hi - lo
    bottom = np.clip(heights.min(), lo - 0.5 * width, lo)
    top = np.clip(heights.max(), hi, hi + 0.5 * width)
    beyond = " (goes beyond the picture)" if heights.min() < bottom or heights.max() > top else ""
    axes.plot([lo, hi], [lo, hi], color=PALE, linewidth=1.1, dashes=(6, 3), label="identity line", zorder=1)
    if len(maps) == 1:
        _draw_map(axes, maps[0], f"map{beyond}")
    else:
        _draw_maps(axes, maps, np.asarray(headings), f"{len(maps)} maps{beyond}")
    _draw_equilibria(axes, [each for some in points for each in some], single=len(maps) == 1)
    room = 0.04 * width
    axes.set(xlim=(lo - room, hi + room), ylim=(bottom - room, top + room), xlabel="$x_k$", ylabel="$x_{k+1}$")
    axes.set_title(title, loc="left", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#EEEEEE", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.legend(
        loc="upper left", bbox_to_anchor=(1.03, 1), borderaxespad=0, frameon=False, fontsize=9, labelspacing=0.9
    )
    return figure


def _draw_map(axes, shape: PiecewiseLinear, label: str) -> None:
    axes.plot(shape.x, shape.y, color=INK, linewidth=1.8, label=label, zorder=2, solid_joinstyle="round")
    if len(shape.x) > 2:
        style = {"linestyle": "none", "marker": "o", "markersize": 4.5, "color": INK, "markerfacecolor": "white"}
        axes.plot(shape.x[1:-1], shape.y[1:-1], label="critical points", zorder=3, **style)


def _draw_maps(axes, maps: list[PiecewiseLinear], headings: np.ndarray, label: str) -> None:
    """Draw the maps, coloured by heading; all hues have the same lightness."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    colours = ScalarMappable(Normalize(0, 360), ListedColormap(_hues(256)))
    for shape, degrees in zip(maps, np.degrees(headings) % 360, strict=True):
        axes.plot(shape.x, shape.y, color=colours.to_rgba(degrees), linewidth=1.2, alpha=0.8, label=label, zorder=2)
        label = "_nolegend_"
    bar = axes.figure.colorbar(colours, cax=axes.inset_axes((1.05, 0, 0.035, 0.45)), ticks=range(0, 361, 90))
    bar.set_label("heading, °")
    bar.outline.set_visible(False)


def _hues(count: int) -> np.ndarray:
    """A circle of hues, equal in lightness and evenly spaced to the eye (Ottosson 2020, Oklab), sRGB `(count, 3)`."""
    turn = 2 * np.pi * np.arange(count) / count
    lightness, chroma = 0.68, 0.115
    a, b = chroma * np.cos(turn), chroma * np.sin(turn)
    to_cones = [[1, 0.3963377774, 0.2158037573], [1, -0.1055613458, -0.0638541728], [1, -0.0894841775, -1.2914855480]]
    to_linear = [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
    linear = (to_linear @ (to_cones @ np.stack([np.full(count, lightness), a, b])) ** 3).clip(0, 1).T
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _draw_equilibria(axes, points: list[Equilibrium], single: bool) -> None:
    from matplotlib.patheffects import withStroke

    outline = [withStroke(linewidth=9, foreground=INK)]
    for kind, (colour, marker, fill) in MARKS.items():
        some = [each for each in points if each.kind == kind]
        label = _findings(kind, some, LISTED if single else 1)
        for each in some:
            if kind == "continuum":
                style = {"linewidth": 6.5, "solid_capstyle": "round", "path_effects": outline}
            else:
                filled_right = fill == "left" and each.slope_left > 1  # filled on the stable side
                style = {
                    "linestyle": "none",
                    "marker": marker,
                    "markersize": 9.5 if single else 6,
                    "fillstyle": "right" if filled_right else "full" if fill == "none" else fill,
                    "markerfacecolor": "white" if fill == "none" else colour,
                    "markerfacecoloralt": "white",
                    "markeredgecolor": colour if fill == "none" else INK,
                    "markeredgewidth": 2.2 if fill == "none" else 0.9 if single else 0.5,
                }
            axes.plot([each.lo, each.hi], [each.lo, each.hi], color=colour, label=label, zorder=5, **style)
            label = "_nolegend_"  # once is enough
    if not points:
        axes.plot([], [], linestyle="none", label="no equilibrium here")


def _findings(kind: str, points: list[Equilibrium], listed: int) -> str:
    """The legend's lines of a class."""
    if len(points) > listed:
        lo, hi = min(each.lo for each in points), max(each.hi for each in points)
        return f"{kind}\n{len(points)} from x = {lo:.3g} to {hi:.3g}"
    places = [f"{each.lo:.4g}" if each.lo == each.hi else f"{each.lo:.4g} … {each.hi:.4g}" for each in points]
    return "\n".join([kind, *(f"x = {place}" for place in places)])


def save(figure, path: str | Path) -> None:
    """Write a figure to a file, in the format that its ending names; a CertifyError if that cannot be."""
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
    except (ValueError, OSError) as error:
        raise CertifyError(f"{path}: cannot be written ({error}): give a file such as map.png") from error


def comparison_figure(families: Mapping[str, Sequence[Mapping[str, Any]]], conditions: Sequence[str]):
    """The smallest rate at which each condition holds: a dot for each network; below 1 it is certified.

    `families` are rows of `certify.command.compare.examine` by name. A CertifyError without matplotlib.
    """
    figure = blank("the figure of the comparison", figsize=(1.5 + 3.2 * len(families), 4.2), dpi=110,
                   layout="constrained")  # fmt: skip
    rng = np.random.default_rng(0)  # places of dots within a column mean nothing
    for axes, (name, rows) in zip(figure.subplots(1, len(families), sharey=True, squeeze=False)[0], families.items(),
                                  strict=True):  # fmt: skip
        axes.axhline(1, color=PALE, linewidth=1)
        for k, condition in enumerate(conditions):
            rates = [row["rates"][condition] for row in rows if row["rates"][condition]]
            axes.plot(k + rng.uniform(-0.2, 0.2, len(rates)), rates, ".", color=TIER_COLOURS[condition], alpha=0.7)
        axes.set(yscale="log", title=Path(name).name, xlim=(-0.6, len(conditions) - 0.4))
        axes.set_xticks(range(len(conditions)), conditions, rotation=30)
        axes.spines[["top", "right"]].set_visible(False)
    figure.supylabel("smallest rate at which the condition holds", fontsize=10, color=INK)
    return figure
