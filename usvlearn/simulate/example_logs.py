"""Logs to try usvlearn on: a simulated Heron whose logs look like those of a MOOS boat.

As in real logs, commands are in percent, the heading is in degrees, and some messages are lost.
"""

from __future__ import annotations

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.logs.channels.channel import Recording
from usvlearn.simulate.fleet import fleet

KINDS = ("patrol", "lawn_mower", "convoy")  # of missions, each sailed once
SHORTEST, LONGEST = 0.5, 1440.0  # min of a mission
BEGIN = 10.0  # s after the start of the logger
FIRST, DAY = 1735725600, 86400  # when the first logger starts, s since 1970; s from one to the next
VARIABLES = {  # channel -> MOOS variable, its app, its unit in SI units
    "command_left": ("DESIRED_THRUST_L", "pMarinePID", 0.01),
    "command_right": ("DESIRED_THRUST_R", "pMarinePID", 0.01),
    "heading": ("NAV_HEADING", "iGPS", np.pi / 180),
    "surge": ("NAV_SPEED", "iGPS", 1.0),
}


def example_logs(minutes: float = 10.0, seed: int = 7) -> dict[str, str]:
    """The texts of MOOS logs by the names of their files, one for each kind of mission.

    Args:
        minutes: length of each mission, min.
        seed: seed of the boat, the missions and the sensors; equal seeds give equal texts.

    Returns:
        Name of the file -> its text.

    Raises:
        ConfigError: the minutes are less than half of one, or more than a day.

    >>> list(example_logs(minutes=0.5))
    ['heron_1.alog', 'heron_2.alog', 'heron_3.alog']
    """
    if not SHORTEST <= minutes <= LONGEST:
        raise ConfigError(f"minutes: found {minutes!r}, expected {SHORTEST:g} to {LONGEST:g} (a day)")
    recordings = fleet(
        n=1,
        hours=minutes * len(KINDS) / 60,
        mission_minutes=minutes,
        missions=KINDS,
        seed=seed,
        aborted_share=0.0,
        paused_share=0.0,
    )
    return {f"heron_{k + 1}.alog": as_alog(each, FIRST + k * DAY) for k, each in enumerate(recordings)}


def as_alog(recording: Recording, start: int) -> str:
    """The text of a MOOS `.alog` file, whose logger starts then: stamp, s, variable, app and value of each message."""
    lines = []
    for name, (variable, app, unit) in VARIABLES.items():
        channel = recording.channels[name]
        for stamp, value in zip(channel.time + BEGIN, channel.value / unit, strict=True):
            shown = value % 360 if name == "heading" else value
            lines.append((stamp, f"{stamp:<12.3f} {variable:<20} {app:<12} {shown:.6g}"))
    head = ["%" * 80, f"%% LOG FILE: {recording.run}, simulated", f"%% LOGSTART {start}", "%" * 80]
    return "\n".join([*head, *(line for _, line in sorted(lines))]) + "\n"
