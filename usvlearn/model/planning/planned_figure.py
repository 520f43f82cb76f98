"""The picture of a plan: commands, expected speed, the track in the area, and the intervals before and after."""

from __future__ import annotations

import io
import math
import re
from typing import Any

import numpy as np

from usvlearn.display.figures import INK, LINE, SIDES, themed
from usvlearn.estimators.joint.reading import Identified
from usvlearn.model.planning.course import Limits
from usvlearn.model.planning.exchange import Plan, derived

SPEED, PLANNED, MOWER = "#00897B", "#1E88E5", "#e8710a"  # visible on white and on black
MOST = 1.5  # relative half-width at the end of the axis
THEMES = """<style>svg{color:#1f2430;--line:#c8ccd4;--page:#ffffff}
@media (prefers-color-scheme:dark){svg{color:#e6e8ee;--line:#444b5a;--page:#14161c}}
text{fill:currentColor}</style><rect width="100%" height="100%" style="fill:var(--page)"/>"""


def draw(title: str, now: Identified, mower: Identified, plan: Plan, limits: Limits):
    """The figure; must be called within `themed`.

    Args:
        now, mower: before, and as expected after a lawn-mower mission of the same length.
    """
    from matplotlib.figure import Figure

    course = plan.course
    time = np.arange(len(course.left)) * course.dt
    figure = Figure(figsize=(10, 5.6), dpi=100, layout="constrained", facecolor="none")
    parts: Any = figure.subfigures(1, 2, width_ratios=(3, 2))
    left, right = parts
    for part in (left, right):
        part.set_facecolor("none")
    commands, speed, heading = left.subplots(3, 1, sharex=True)
    for name, values in (("left", course.left), ("right", course.right)):
        commands.step(time, values, where="post", color=SIDES[name], linewidth=1.3, label=name)
    commands.set(ylabel="command, share")
    commands.set_title(title, loc="left")
    commands.legend(ncols=2, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), columnspacing=1.2)
    speed.plot(time, plan.expected.speed, color=SPEED, linewidth=1.4)
    speed.set(ylabel="expected speed, m/s")
    heading.step(time, np.degrees(course.wanted) % 360, where="post", color=INK, linewidth=1.3)
    heading.set(ylabel="heading, deg", xlabel="time, s", ylim=(-15, 375), yticks=(0, 90, 180, 270, 360))
    for panel in (commands, speed, heading):
        panel.grid(color=LINE)
        panel.margins(x=0)
    track, widths = right.subplots(2, 1, height_ratios=(5, 4))
    _track(track, plan, limits)
    _widths(widths, now, mower, plan.expected.found)
    return figure


def _track(panel, plan: Plan, limits: Limits) -> None:
    half, turn = limits.area / 2, limits.heading
    corners = half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]])
    north = corners[:, 0] * math.cos(turn) - corners[:, 1] * math.sin(turn)
    east = corners[:, 0] * math.sin(turn) + corners[:, 1] * math.cos(turn)
    panel.plot(east, north, color=INK, linewidth=0.9, linestyle="--")
    path = np.concatenate([np.zeros((1, 2)), plan.path])
    panel.plot(path[:, 1], path[:, 0], color=SPEED, linewidth=1.4)
    panel.plot(0, 0, "o", color=INK, markersize=4)
    panel.annotate("start", (0, 0), xytext=(4, 4), textcoords="offset points", fontsize=8)
    panel.set(aspect="equal", xlabel="east, m", ylabel="north, m")
    panel.grid(color=LINE)


def _widths(panel, now: Identified, mower: Identified, planned: Identified) -> None:
    names = derived(now)
    places = np.arange(len(names))[::-1]
    for label, found, colour, lift in (
        ("now", now, INK, 0.25), ("lawn mower", mower, MOWER, 0.0), ("this plan", planned, PLANNED, -0.25),
    ):  # fmt: skip
        wide = [(found[name].high - found[name].low) / 2 / max(abs(now[name].value), 1e-9) for name in names]
        panel.barh(
            places + lift, np.clip(np.nan_to_num(wide, nan=MOST), 0, MOST), height=0.22, color=colour, label=label
        )
    panel.set(xlabel=f"half-width of 90 % over value, up to {MOST:g}", yticks=places, yticklabels=names)
    panel.tick_params(axis="y", labelsize=7)
    panel.grid(axis="x", color=LINE)
    panel.legend(fontsize=7)


def svg(title: str, now: Identified, mower: Identified, plan: Plan, limits: Limits) -> str:
    """The picture as SVG that follows the reader's light or dark theme.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    with themed():
        from matplotlib import rc_context

        with rc_context({"svg.fonttype": "none", "svg.hashsalt": "plan"}):
            content = io.StringIO()
            figure = draw(title, now, mower, plan, limits)
            figure.savefig(content, format="svg", transparent=True, metadata={"Date": None})
    text = content.getvalue()
    for colour, variable in {INK: "currentColor", "#000000": "currentColor", LINE: "var(--line)"}.items():
        text = re.sub(re.escape(colour), variable, text, flags=re.IGNORECASE)
    return re.sub(r"(<svg[^>]*>)", lambda found: found.group(1) + THEMES, text, count=1)
