"""An animated picture of a boat's last mission: where it is, and the track that was forecast from there."""

from __future__ import annotations

import math
from pathlib import Path

from usvlearn.core.checkpoint import write_atomically
from usvlearn.display.figures import INK, KNOWN, figure_of, themed
from usvlearn.errors import printable
from usvlearn.report.sections.tracks import POINTS, draw_track
from usvlearn.report.track_maps import Mission

MOST, RATE = 120, 4  # frames, and how many a second


def write_animation(path: Path, mission: Mission, title: str) -> Path:
    """A GIF with a frame for each track: left on the boat's way, right beside the measured path; returns its path."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    shown = mission.ahead[:: 1 + (len(mission.ahead) - 1) // MOST]
    with themed():
        figure = figure_of(9, 4.6, dpi=80)
        whole, near = figure.subplots(1, 2)
        way = mission.position[:: 1 + len(mission.position) // POINTS]
        whole.plot(way[:, 1], way[:, 0], color=INK, linewidth=0.8)
        whole.set(aspect="equal", xlabel="east, m", ylabel="north, m")
        (track,) = whole.plot([], [], color=KNOWN["ensemble"], linewidth=1.8)
        (boat,) = whole.plot([], [], color=INK, marker="o", markersize=4)

        def draw(k: int) -> None:
            moment = shown[k]
            north, east = mission.position[moment.step]
            track.set_data(east + moment.east, north + moment.north)
            boat.set_data([east], [north])
            near.clear()
            draw_track(near, mission, moment)
            near.set_xlabel("m from the boat, 90 % ellipses")
            near.legend(loc="upper right")
            minutes, seconds = divmod(math.floor(mission.run.time[moment.step]), 60)
            near.set_title(f"{printable(title)}, {printable(mission.run.name)}, at {minutes}:{seconds:02d}")

        animation = FuncAnimation(figure, draw, frames=len(shown), cache_frame_data=False)
        part = path.with_suffix(".part.gif")
        try:
            animation.save(part, writer=PillowWriter(fps=RATE))
            write_atomically(path, part.read_bytes())
        finally:
            part.unlink(missing_ok=True)
    return path
