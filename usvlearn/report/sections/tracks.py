"""Tracks: errors of the position by horizon, how often the ellipses hold it, and tracks on a map."""

from __future__ import annotations

import math
from collections.abc import Mapping

from usvlearn.display.result_table import ResultTable
from usvlearn.evaluation.manoeuvres import GROUPS
from usvlearn.evaluation.metrics import mean
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.report.sections.track_figures import errors_figure, map_figure
from usvlearn.report.track_maps import BoatTracks, Mission, Scores

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


def tracks_section(tracks: Mapping[str, BoatTracks]) -> Section | None:
    """A table and a figure of errors by boat and horizon, and a map of each boat; None without tracks.

    Args:
        tracks: of `usvlearn.report.track_maps.saved_tracks`.
    """
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


def _findings(found: Mapping[str, Scores]) -> list[str]:
    """What the table shows, in words."""
    rows: dict[str, list[Mapping]] = {}
    for scores in found.values():
        for horizon, row in scores.items():
            rows.setdefault(horizon, []).append(row)
    here = []
    for horizon, each in rows.items():
        ours, turn, held = (mean(row[key] for row in each) for key in ("position", *BASELINES))
        if ours is not None and turn is not None and held is not None:
            here.append(f"{ours:.2f} m at {horizon} s (constant turn {turn:.2f} m, held yaw rate {held:.2f} m)")
    mean_of = ", mean over boats" if len(found) > 1 else ""
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
