"""Which two series are the velocity over ground, to the north and to the east."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.channel import AUTO
from usvlearn.logs.channels.position_rates import speed_on_positions
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision
from usvlearn.logs.inspection.directions import agreement
from usvlearn.logs.inspection.known import known_velocity
from usvlearn.logs.inspection.position_channels import Pair, Places
from usvlearn.logs.inspection.speeds import Speed, read_speed, vectors
from usvlearn.logs.inspection.vocabulary import fit

Both = tuple[Candidate, Candidate]  # to the north and to the east
ALONG = 0.8  # mean cosine of heading and direction of a velocity over ground
TURNS = 0.3  # variance of that direction on the circle, from which it is no chance


class Velocities(NamedTuple):
    """The velocity over ground in two components, and their size as a speed."""

    north: Candidate
    east: Candidate
    size: Speed
    guessed: bool = False  # whether only their direction tells it, and hardly changes


def named_velocities(pool: Sequence[Candidate], convention: str) -> Both | None:
    """The velocities to the north and to the east by format or name, if there are."""
    if known := known_velocity(pool, convention):
        return known
    for north in pool:
        for east in pool if fit("velocity_north", north.label) >= 2 else ():
            if fit("velocity_east", east.label) >= 2 and (east.name == north.name or north.field in (None, "data")):
                return north, east
    return None


def find_velocities(
    pool: Sequence[Candidate], places: Sequence[Places], heading: Pair | None, convention: str, known: Both | None
) -> Velocities | None:
    """Two series that are the velocity to the north and to the east, known or by their direction, if there are."""
    if known:
        return _velocities(*known, places, heading, convention)
    for x, y in vectors(pool):
        if heading is None or len(x.value) != len(y.value):
            continue
        time, fast = x.time, np.hypot(x.value, y.value) > 0.3 * math.hypot(x.size, y.size)
        for north, east in ((y, x), (x, y)):
            direction = np.arctan2(east.value, north.value)[fast]
            ahead = float(np.cos(np.arctan2(y.value, x.value)[fast]).mean())  # 1 of a vector along the hull
            if max(ALONG, ahead) <= agreement(heading, (time[fast], direction)):
                turns = 1 - abs(np.exp(1j * direction).mean())  # 0 if it is constant, as along a hull
                found = _velocities(north, east, places, heading, convention)
                return found._replace(guessed=bool(turns < TURNS))
    return None


def _velocities(
    north: Candidate, east: Candidate, places: Sequence[Places], heading: Pair | None, convention: str
) -> Velocities:
    same = len(north.value) == len(east.value)
    size = north.named(value=np.hypot(north.value, east.value) if same else np.abs(north.value))
    relation = speed_on_positions(*places[0][-2:], size.evidence, heading) if places and same else None
    return Velocities(north, east, read_speed(size, relation, convention, 3.0, places[0].length if places else ""))


def tell_velocities(
    found: Velocities, speeds: Sequence[Speed], channels: dict, series: dict, doubt: str
) -> list[Decision]:
    """Both components, from which the surge is computed with the heading; and why they may be interchanged, or ""."""
    size, decisions = found.size, []
    others = tuple(each.candidate.label for each in speeds[:3])
    for name, candidate in (("velocity_north", found.north), ("velocity_east", found.east)):
        channels[name] = candidate.source(unit=size.unit, window=AUTO)
        series[name] = candidate
        sure = UNSURE if found.guessed or doubt else CERTAIN if size.confirmed else PROBABLE
        why = doubt or ("by its direction" if found.guessed else "by name")
        why += "; their size follows the rate of position" if size.confirmed else ""
        decisions.append(Decision(name, "series", candidate.label, sure, why))
        decisions.append(Decision(name, "unit", size.unit, size.certainty, size.reason, size.alternatives))
    why = "velocities and heading give a signed surge" + (f"; before {', '.join(others)}" if others else "")
    sure = UNSURE if found.guessed else PROBABLE
    return [*decisions, Decision("surge", "series", "from the velocities", sure, why, others)]
