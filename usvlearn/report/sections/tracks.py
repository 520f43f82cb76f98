"""Tracks: errors of the position by horizon, how often the ellipses hold it, and tracks on a map."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.display.figures import INK, KNOWN, OTHERS, figure_of, guarded, panels_of
from usvlearn.display.terminal import ResultTable
from usvlearn.evaluation.horizons import GROUPS
from usvlearn.evaluation.metrics import mean
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.report.track_maps import Ahead, BoatTracks, Ellipse, Mission, Scores

BASELINES = {
    "position_constant_turn": "constant turn: the measured speed and yaw rate of the origin go on",
    "position_held_rate": "held yaw rate: the forecast speed, and the yaw rate of the origin goes on",
}
GIVEN = (
    "A track says where the boat will be. It begins at its origin, from what was measured until then, and is given the "
    "commands that came. Its error at a horizon is the distance between forecast and measured position. Two simpler "
    f"forecasts are beside it. {'. '.join(each.capitalize() for each in BASELINES.values())}."
)
ELLIPSES = (
    "An ellipse is to hold the position in 90 % of the cases. Its shape and size are learned from the errors of "
    "earlier tracks to the same horizon. It is infinite, and not counted here, before ten tracks to the horizon have "
    "been compared with measured positions, and beyond the longest horizon."
)
ERRORS = "Mean position error of the tracks against the horizon, and of the two baselines. Both axes are logarithmic."
SHARES = {
    "inside": "The ellipses hold the position (90 % asked):",
    "inside_stay": "Where the commands stay:",
    "inside_move": "Where they move:",
    "inside_move_much": "Where they move much:",
}
UNFINISHED = "its run is not finished, so that its tracks have no scores yet."
RECKONED = (
    "The log has no positions: the measured path is reckoned from measured speed and heading, so that it drifts, and "
    "a current is in it only as far as the speed is over ground."
)
LEARNED = (
    "from the newest checkpoint. That checkpoint has learned from this mission, so that these tracks may be more "
    "accurate than those of the table, which were made while it was sailed."
)
UNSEEN = "from the newest checkpoint that had not learned from it."
LINES = {  # key of the scores -> name, colour, style
    "position": ("tracks", KNOWN["ensemble"], "-"),
    "position_held_rate": ("held yaw rate", OTHERS[-1], "--"),
    "position_constant_turn": ("constant turn", OTHERS[2], ":"),
}
ACROSS = 4  # panels of boats in a row
SHOWN = 6  # tracks on a map
BEFORE, TURNING = 5.0, 10.0  # s of the way that was gone before an origin; of the constant turn
POINTS = 2000  # of a mission's way
LEAST = 4.0  # m, of the smaller side of a panel


def tracks_section(tracks: Mapping[str, BoatTracks]) -> Section | None:
    """A table and a figure of errors by boat and horizon, and a map of each boat; None without tracks."""
    if not tracks:
        return None
    rows = [_row(boat, horizon, row) for boat, each in tracks.items() for horizon, row in each.scores.items()]
    columns = ("boat", "horizon, s", "position error, m", "constant turn, m", "held yaw rate, m", "heading error, °",
               "inside the ellipses", "commands stay", "move", "move much", "median radius, m",
               "tracks")  # fmt: skip
    scores = {boat: each.scores for boat, each in tracks.items() if each.scores}
    drawn = [Drawn("tracks", errors_figure(scores), ERRORS)] if scores else []
    here = [*_findings(scores), GIVEN, ELLIPSES]
    for boat, each in tracks.items():
        if not each.scores:
            here.append(f"{boat}: {UNFINISHED}")
        if each.lacks:
            here.append(each.lacks)
        if each.mission is not None and each.mission.ahead:
            drawn.append(Drawn(f"tracks_{boat}", map_figure(each.mission, boat), _caption(boat, each.mission)))
    sheets = [ResultTable("tracks", columns, rows)] if rows else []
    return Section("tracks", "Tracks: where the boat will be", "", here, drawn, sheets, first=1)


def _row(boat: str, horizon: str, row: Mapping) -> tuple:
    heading = row["heading"]
    return (
        boat,
        float(horizon),
        row["position"],
        *(row[key] for key in BASELINES),
        None if heading is None else math.degrees(heading),
        row["inside"],
        *(row[f"inside_{name}"] for name in GROUPS),
        row["radius"],
        row["count"],
    )


def _findings(boats: Mapping[str, Scores]) -> list[str]:
    """What the table shows, in words."""
    rows: dict[str, list[Mapping]] = {}
    for scores in boats.values():
        for horizon, row in scores.items():
            rows.setdefault(horizon, []).append(row)
    here = []
    for horizon, each in rows.items():
        ours, turn, held = (mean(row[key] for row in each) for key in ("position", *BASELINES))
        if ours is not None and turn is not None and held is not None:
            here.append(f"{ours:.2f} m at {horizon} s (constant turn {turn:.2f} m, held yaw rate {held:.2f} m)")
    mean_of = ", mean over boats" if len(boats) > 1 else ""
    said = [f"Position error{mean_of}: {', '.join(here)}."] if here else []
    for key, words in SHARES.items():
        if shares := [100 * x for each in rows.values() for row in each if (x := row[key]) is not None]:
            said.append(f"{words} {min(shares):.0f} … {max(shares):.0f} %.")
    return said


def _caption(boat: str, mission: Mission) -> str:
    """What the map shows."""
    replayed = LEARNED if mission.learned else UNSEEN
    text = (
        f"{boat}: its last mission, {mission.run.name}, replayed {replayed} Left: where the boat was, and the tracks "
        "at their origins. Right: each track beside the measured path, m from the origin, with dots and ellipses at "
        "the horizons, and the constant turn until 10 s. The triangle points to the bow. An ellipse with a semi-axis "
        "longer than the track until there is not drawn."
    )
    return text if mission.logged else f"{text} {RECKONED}"


@guarded
def errors_figure(scores: Mapping[str, Scores]):
    """Mean position error against the horizon, a panel for each boat."""
    known = any(row[key] for table in scores.values() for row in table.values() for key in LINES)
    figure, panels = panels_of(len(scores), ACROSS, (2.4, 2.3), (0.0, 0.8), least=4.6)
    for panel, (boat, table) in zip(panels, scores.items(), strict=False):
        at = [float(h) for h in table]
        for key, (name, colour, style) in LINES.items():
            errors = [np.nan if row[key] is None else max(row[key], 1e-3) for row in table.values()]
            panel.plot(at, errors, style, color=colour, marker="o", markersize=3, linewidth=1.6, label=name)
        panel.set(title=boat, xlabel="horizon, s", xscale="log", yscale="log" if known else "linear")
        panel.set_xticks(at, [f"{h:g}" for h in at])
        panel.yaxis.set_major_formatter(lambda y, _: f"{y:g}")
        panel.minorticks_off()
    figure.supylabel("position error, m")
    figure.legend(*panels[0].get_legend_handles_labels(), ncols=3, loc="outside lower center")
    return figure


def chosen(ahead: Sequence[Ahead], count: int = SHOWN) -> list[Ahead]:
    """Tracks that are spread over a mission: of each second part the one that turns most, of the others the middle one.

    Those with an ellipse at the longest horizon that any of them has go first.
    """

    def known(each: Ahead) -> int:
        return sum(math.isfinite(ellipse.major) for ellipse in each.ellipses)

    most = max(map(known, ahead))
    best = [each for each in ahead if known(each) == most]
    parts = [best[k * len(best) // count : (k + 1) * len(best) // count] for k in range(count)]
    return [
        part[len(part) // 2] if k % 2 else max(part, key=lambda each: each.turn)
        for k, part in enumerate(parts) if part
    ]  # fmt: skip


@guarded
def map_figure(mission: Mission, title: str):
    """The way of a boat in one mission, and beside it six tracks with their ellipses, each in a panel of its own."""
    shown = chosen(mission.ahead)
    figure = figure_of(11, 5.2)
    whole, *panels = figure.subplot_mosaic("wabc;wdef", width_ratios=(1.5, 1, 1, 1)).values()
    way = mission.position[:: 1 + len(mission.position) // POINTS]
    whole.plot(way[:, 1], way[:, 0], color=INK, linewidth=0.8)
    whole.set_aspect("equal", adjustable="datalim")
    whole.set(title=f"{title}, {mission.run.name}", xlabel="east, m", ylabel="north, m")
    for panel in panels[len(shown) :]:
        panel.set_visible(False)
    for k, (panel, each) in enumerate(zip(panels, shown, strict=False)):
        north, east = mission.position[each.step]
        whole.plot(east + each.east, north + each.north, color=KNOWN["ensemble"], linewidth=1.6)
        whole.plot(east, north, color=INK, marker="o", markersize=3)
        whole.annotate(str(k + 1), (east, north), (4, 4), textcoords="offset points", fontsize=9, weight="bold")
        draw_track(panel, mission, each)
        minutes, seconds = divmod(int(mission.run.time[each.step]), 60)
        panel.set_title(f"{k + 1}: at {minutes}:{seconds:02d}")
    figure.legend(*panels[0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
    return figure


def draw_track(panel: Any, mission: Mission, each: Ahead) -> None:
    """A track and what came, m from its origin."""
    time, colour = mission.run.time - mission.run.time[each.step], KNOWN["ensemble"]
    part = (time >= -BEFORE) & (time <= each.time[-1] + 1e-6)
    way, begin = mission.position[part] - mission.position[each.step], int(np.argmax(part))
    panel.plot(way[:, 1], way[:, 0], color=INK, linewidth=1.6, label="measured")
    panel.plot([0, *each.east], [0, *each.north], color=colour, linewidth=1.4, label="forecast")
    panel.plot(*_turn(mission, each), color=OTHERS[2], linewidth=1.4, linestyle=":", label="constant turn")
    seen, label = [way, np.stack([each.north, each.east], -1)], "ellipse of 90 %"
    for ellipse in each.ellipses:
        k = each.step + 1 + ellipse.step - begin
        if k < len(way):
            panel.plot(way[k, 1], way[k, 0], color=INK, marker="o", markersize=3.5)
        panel.plot(each.east[ellipse.step], each.north[ellipse.step], color=colour, marker="o", markersize=2.5)
    for outline in (_outline(each, ellipse) for ellipse in each.drawn):
        panel.fill(outline[:, 1], outline[:, 0], facecolor=colour, alpha=0.18, linewidth=0)
        panel.plot(outline[:, 1], outline[:, 0], color=colour, linewidth=0.8, label=label)
        seen, label = [*seen, outline], "_"
    ahead = (3, 0, -math.degrees(mission.pose[each.step, 0]))  # a triangle that points to the bow
    panel.plot(0, 0, color=INK, marker=ahead, markersize=7)
    points = np.concatenate(seen)
    points = points[np.isfinite(points).all(-1)]
    low, high = points.min(0), points.max(0)
    middle, half = (low + high) / 2, 0.54 * max(LEAST, *(high - low))
    panel.set(xlim=(middle[1] - half, middle[1] + half), ylim=(middle[0] - half, middle[0] + half), aspect="equal")


def _outline(each: Ahead, ellipse: Ellipse) -> np.ndarray:
    """Points of an ellipse, m north and east of the origin, `(points, 2)`."""
    round_ = np.linspace(0, 2 * math.pi, 73)
    along, aside = ellipse.major * np.cos(round_), ellipse.minor * np.sin(round_)
    c, s = math.cos(ellipse.bearing), math.sin(ellipse.bearing)
    centre = each.north[ellipse.step], each.east[ellipse.step]
    return np.stack([centre[0] + c * along - s * aside, centre[1] + s * along + c * aside], -1)


def _turn(mission: Mission, each: Ahead) -> tuple[np.ndarray, np.ndarray]:
    """East and north of the constant turn, m from the origin."""
    heading, rate = mission.pose[each.step]
    speed = mission.run.samples.surge[each.step]
    t = np.linspace(0, TURNING, 41)
    psi = heading + rate * t
    step = t[1] * speed
    north, east = (np.append(0, np.cumsum(step * (f(psi[1:]) + f(psi[:-1])) / 2)) for f in (np.cos, np.sin))
    return east, north
