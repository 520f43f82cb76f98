"""A fault: from a given minute, thrust, drag or mass of every boat changes.

tau_side ← share · tau_side at the same command, drag ← drag · `drag`, m ← m · `mass`. A thruster that fails or fouls
has a share below 1, one that comes back or sheds its weed one above. The rest of the boat and its autopilot do not
change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from usvlearn.errors import ConfigError, check_choice, check_not_negative, check_positive
from usvlearn.simulate.vessel import Vessel, scale_thrust

SIDES = ("left", "right")
PIECES = 20  # steps of a change that takes its time


@dataclass(frozen=True)
class Fault:
    """Which thruster, how much of its thrust is left, and from when; or another change of the boat.

    Args:
        side: "left", "right" or "both".
        share: share of the thrust that is left, 0 ... 2.
        minute: min of the season, all missions one after the other at their planned length.
        over: min that the change takes; 0: it comes at once.
        drag: factor of the drag, no unit: 1.5 tows something.
        mass: factor of the mass, no unit: 1.3 has taken on a load.

    Raises:
        ConfigError: another side, or a number outside its range.

    >>> Fault(side="right", share=0.0).minute
    10.0
    """

    side: str = "left"
    share: float = 0.4
    minute: float = 10.0
    over: float = 0.0
    drag: float = 1.0
    mass: float = 1.0

    def __post_init__(self):
        check_choice("side", self.side, (*SIDES, "both"))
        check_not_negative("minute", self.minute)
        check_not_negative("over", self.over)
        check_positive("drag", self.drag)
        check_positive("mass", self.mass)
        if not (isinstance(self.share, int | float) and 0 <= self.share <= 2):
            raise ConfigError(f"share: found {self.share!r}, expected a number from 0 to 2")


def faulty_vessels(fault: Fault | None, vessel: Vessel, ticks: Sequence[int], hz: float) -> dict[int, Vessel]:
    """The vessel's new parameters, by the tick from which they hold; empty if there is no fault.

    The vessel's leaves broadcast against `(missions, boats, ...)`; `ticks` are the planned lengths of the missions, at
    so many ticks a second.
    """
    if fault is None:
        return {}
    left_over = torch.tensor([fault.share if fault.side in (side, "both") else 1.0 for side in SIDES]).double()
    struck, piece = round(60 * fault.minute * hz), 60 * fault.over * hz / PIECES
    onsets = torch.tensor([struck - sum(ticks[:mission]) for mission in range(len(ticks))])
    pieces = PIECES if piece > 0 else 1
    later = {}
    for tick in sorted({max(0, round(int(onset) + k * piece)) for onset in onsets for k in range(pieces)}):
        begun = ((tick - onsets + 0.5) / piece).floor().add(1) if piece > 0 else onsets <= tick
        gone = (begun / pieces).clamp(0, 1).double()[:, None]  # share of the change, (missions, 1)
        changed = scale_thrust(vessel, 1 - gone[..., None] + gone[..., None] * left_over)
        drags = {name: _scaled(leaf, fault.drag, gone) for name, leaf in vessel._asdict().items() if "drag" in name}
        later[tick] = changed._replace(mass=_scaled(vessel.mass, fault.mass, gone), **drags)
    return later


def _scaled(leaf: torch.Tensor, factor: float, gone: torch.Tensor) -> torch.Tensor:
    """A parameter that is on its way to `factor` times itself, `(missions, boats)`."""
    return leaf if factor == 1 else leaf * (1 - gone + gone * factor)
