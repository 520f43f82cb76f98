"""A thruster that fails or fouls: from some minute of the season on, one side of every boat has less thrust.

tau_side ← share · tau_side, at the same command. The rest of the boat and its autopilot do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from usvlearn.errors import ConfigError, check_choice, check_not_negative
from usvlearn.simulate.vessel import Vessel, scale_thrust

SIDES = ("left", "right")


@dataclass(frozen=True)
class Fault:
    """Which thruster, how much of its thrust is left, and from when.

    Args:
        side: "left" or "right".
        share: of the thrust that is left, 0 ... 1.
        minute: of the season, all missions one after the other at their planned length.

    >>> Fault(side="right", share=0.0).minute
    10.0
    """

    side: str = "left"
    share: float = 0.4
    minute: float = 10.0

    def __post_init__(self):
        check_choice("side", self.side, SIDES)
        check_not_negative("minute", self.minute)
        if not (isinstance(self.share, int | float) and 0 <= self.share <= 1):
            raise ConfigError(f"share: found {self.share!r}, expected a number from 0 to 1")


def faulty_vessels(fault: Fault | None, vessel: Vessel, ticks: Sequence[int], hz: float) -> dict[int, Vessel]:
    """The vessel's new parameters, by the tick from which they hold; empty if there is no fault.

    Args:
        vessel: before the fault, leaves broadcast against `(missions, boats, ...)`.
        ticks: planned length of each mission, ticks of the autopilot.
        hz: ticks a second.

    >>> from usvlearn.simulate.plants import heron
    >>> later = faulty_vessels(Fault(share=0.5, minute=1.5), heron(), [240, 240], 4.0)
    >>> {tick: each.thrust_table[:, 0, 0, -1].tolist() for tick, each in later.items()}
    {120: [33.6, 16.8], 360: [16.8, 16.8]}
    """
    if fault is None:
        return {}
    left_over = torch.tensor([fault.share if side == fault.side else 1.0 for side in SIDES], dtype=torch.float64)
    struck = round(60 * fault.minute * hz)
    onsets = [max(0, struck - sum(ticks[:mission])) for mission in range(len(ticks))]
    later = {}
    for tick in sorted(set(onsets)):
        since = torch.tensor([onset <= tick for onset in onsets])[:, None, None]  # (missions, 1, 1)
        later[tick] = scale_thrust(vessel, torch.where(since, left_over, 1.0))
    return later
