"""What the messages of an autopilot mean by their format: the best of them first, by stamp, sign and resolution.

Their names alone would not tell a filter from its backup, nor a heading in whole degrees from a fine one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from usvlearn.logs.inspection.candidate import Candidate

PLACE = re.compile(r"\[\d+\]|@\S*")  # of a name: its instance and its sender
KNOWN: dict[str, dict[str, tuple[str, ...]]] = {  # format -> role -> messages and fields, the best first
    "ArduPilot DataFlash": {"heading": ("ATT Yaw", "XKF1 Yaw", "NKF1 Yaw"), "velocity": ("XKF1 VN", "NKF1 VN"),
                            "position": ("POS Lat", "GPS Lat")},
    "MAVLink telemetry": {"heading": ("ATTITUDE yaw", "GLOBAL_POSITION_INT hdg"),
                          "velocity": ("LOCAL_POSITION_NED vx", "GLOBAL_POSITION_INT vx"),
                          "position": ("LOCAL_POSITION_NED x", "GLOBAL_POSITION_INT lat")},
    "PX4 ULog": {"heading": ("vehicle_attitude q", "vehicle_local_position heading"),
                 "velocity": ("vehicle_local_position vx",),
                 "position": ("vehicle_global_position lat", "vehicle_local_position x")},
}  # fmt: skip
EAST = {"VN": "VE", "vx": "vy"}
UNKNOWN = 9  # the rank of what is not known


def rank(candidate: Candidate, role: str, convention: str) -> int:
    """The place among the known messages of a role, 0 for the best; `UNKNOWN` if it is none."""
    known, label = KNOWN.get(convention, {}).get(role, ()), PLACE.sub("", candidate.label)
    return known.index(label) if label in known else UNKNOWN


def known_velocity(pool: Sequence[Candidate], convention: str) -> tuple[Candidate, Candidate] | None:
    """The velocities to the north and to the east that a format defines, the finest of them; None if there are none."""
    for north in sorted(pool, key=lambda each: rank(each, "velocity", convention)):
        if rank(north, "velocity", convention) < UNKNOWN:
            for east in pool:
                twin = (east.name, east.field) == (north.name, EAST.get(north.field or ""))
                if twin and len(east.value) == len(north.value):
                    return north, east
    return None
