"""The picture of a speed controller: the curve with its band, the linearised boat, and the closed loop of all boats."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np

from usvlearn.display.figures import INK, LINE, themed
from usvlearn.errors import printable
from usvlearn.model.controller.design import Controller, Loop

DARK = {INK: "#e6e8ec", LINE: "#3d4450"}
PAGE = {"light": "#ffffff", "dark": "#14171c"}
COLOURS = {"ArduRover": "#1E88E5", "MOOS-IvP": "#e8710a"}
MOST = 60  # boats of a panel that are drawn one by one
BEFORE, LEAST, AFTER, BETWEEN = 1.0, 3.0, 1.3, 0.1  # s before a step; after it: shares of the longest settling


def pictures(found: Controller) -> dict[str, bytes]:
    """The files by their endings: an SVG that follows the reader's theme, and a PNG for each theme.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    drawn = _figure(found, {})
    return {
        ".svg": _themed_svg(drawn, found.boat.name),
        ".png": _saved(drawn, "png", dpi=130, facecolor=PAGE["light"]),
        "_dark.png": _saved(_figure(found, DARK), "png", dpi=130, facecolor=PAGE["dark"]),
    }


def _saved(figure: Any, kind: str, **options: Any) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format=kind, **options)
    return content.getvalue()


def _themed_svg(figure: Any, name: str) -> bytes:
    from matplotlib import rc_context

    with rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        text = _saved(figure, "svg", transparent=True, metadata={"Date": None}).decode()
    variables = {INK: "var(--ink)", LINE: "var(--line)", "#000000": "var(--ink)"}
    for colour, variable in variables.items():
        text = re.sub(re.escape(colour), variable, text, flags=re.IGNORECASE)
    themes = [f"--ink: {INK}; --line: {LINE}; background: {PAGE['light']}",
              f"--ink: {DARK[INK]}; --line: {DARK[LINE]}; background: {PAGE['dark']}"]  # fmt: skip
    style = f"<style>svg {{ {themes[0]} }} @media (prefers-color-scheme: dark) {{ svg {{ {themes[1]} }} }}</style>"
    return re.sub(r"(<svg[^>]*>)", rf"\1{style}", text, count=1, flags=re.DOTALL).encode()


def _figure(found: Controller, theme: dict[str, str]) -> Any:
    from contextlib import nullcontext

    ink, line = theme.get(INK, INK), theme.get(LINE, LINE)
    with themed() as Figure:
        from matplotlib import rc_context

        keys = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
        changed: Any = {**dict.fromkeys(keys, ink), "grid.color": line}
        with rc_context(changed) if theme else nullcontext():
            figure = Figure(figsize=(9, 6.4), layout="constrained")
            axes = figure.subplot_mosaic([["curve", "rover"], ["plant", "moos"]], width_ratios=[2, 3])
            figure.suptitle(printable(f"{found.boat.name}: speed controller"), fontsize=11)
            _curve(axes["curve"], found, ink)
            _plant(axes["plant"], found)
            for place, loop in zip(("rover", "moos"), found.loops, strict=True):
                _responses(axes[place], loop, ink)
            axes["moos"].set_xlabel("time, s; what follows the settling is left out")
            for each in axes.values():
                each.grid(True)
    return figure


def _curve(axes: Any, found: Controller, ink: str) -> None:
    forward = found.feedforward
    axes.fill_between(100 * forward.command, forward.low, forward.high, color="#9334e6", alpha=0.25, linewidth=0)
    axes.plot(100 * forward.command, forward.speed, color="#9334e6", label="identified, 90 %")
    low, high = found.speeds[0], found.speeds[-1]
    both = np.array([low, high])
    axes.plot(
        100 * found.rover.slope * both, both, color=COLOURS["ArduRover"], linestyle="--", label="ArduRover's base"
    )
    axes.axhspan(low, high, color=ink, alpha=0.07, linewidth=0, label="range of the gains")
    axes.set(xlabel="command of both sides, %", ylabel="steady speed, m/s", xlim=(0, 100), ylim=(0, None))
    axes.legend(fontsize=7.5, loc="upper left")


def _plant(axes: Any, found: Controller) -> None:
    for curve, colour, label in ((found.linear.time_constant, "#00897B", "time constant, s"),
                                 (found.linear.gain, "#CC6677", "gain b, m/s²")):  # fmt: skip
        axes.fill_between(found.speeds, curve.low, curve.high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(found.speeds, curve.value, color=colour, label=label)
    axes.set(xlabel="speed, m/s", ylabel="s or m/s², with 90 %", ylim=(0, None))
    axes.legend(fontsize=7.5, loc="lower left")


def _responses(axes: Any, loop: Loop, ink: str) -> None:
    """Each step of the wanted speed until all boats have settled; the time between is left out."""
    responses, colour = loop.responses, COLOURS[loop.name]
    settled = np.concatenate([step.settled for step in loop.steps])
    after = AFTER * float(settled[np.isfinite(settled)].max(initial=LEAST))
    begin, boats = 0.0, responses.speed.shape[1]
    for number, at in enumerate(np.flatnonzero(np.diff(responses.wanted))):
        zero = responses.time[at]
        shown = (responses.time > zero - BEFORE) & (responses.time <= zero + after)
        time, speed = responses.time[shown] - zero + BEFORE + begin, responses.speed[shown]
        labels = ("", "", "") if number else (f"all {boats} boats", "median", "wanted")
        label = dict(zip(("all", "median", "wanted"), labels, strict=True))
        band = {"color": colour, "alpha": 0.25, "linewidth": 0}
        axes.fill_between(time, speed.min(1), speed.max(1), label=label["all"], **band)
        axes.plot(time, speed[:, :MOST], color=colour, alpha=0.15, linewidth=0.5)
        axes.plot(time, np.median(speed, axis=1), color=colour, linewidth=1.4, label=label["median"])
        wanted = {"color": ink, "linewidth": 0.9, "linestyle": "--", "drawstyle": "steps-pre"}
        axes.plot(time, responses.wanted[shown], label=label["wanted"], **wanted)
        begin += BEFORE + after + BETWEEN * after
    axes.set(title=f"closed loop, {loop.name}", ylabel="speed, m/s")
    axes.margins(x=0)
    axes.legend(fontsize=7.5, loc="upper right", ncols=3)
    low, high = float(responses.wanted.min()), float(responses.wanted.max())
    axes.set_ylim(low - 0.25 * (high - low), high + 0.35 * (high - low))
