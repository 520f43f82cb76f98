"""The node's health, published once a second."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from usvlearn.display.json_values import finite

ONE_COMMAND = (
    "one command drives both sides: nothing tells left from right, so that neither the thrust of a side nor "
    "thrust_ratio can be identified, nor a failed thruster be noticed; what a rudder does is not learned"
)


class Refit(NamedTuple):
    """What the last batch fit of a node's missions says."""

    use: bool = False  # whether its values are to be used, and not those learned online
    missions: int = 0
    quantities: Mapping[str, tuple[float, float, float, str]] = {}  # value, low, high, unit
    sentence: str = "use those learned online: no mission has been fitted yet"


class Health(NamedTuple):
    """The health of a node."""

    state: str  # "compiling", "waiting" (a channel never came), "stale", "sparse" (many steps are lost), "ok"
    sentence: str  # for a person
    counts: dict[str, dict[str, int]]  # channel -> cause -> messages that were not used
    ages: dict[str, float]  # part -> s since its last message, infinite if none came
    steps: int
    learned: int
    alarms: int
    alarm: str | None  # the side whose thruster seems to have failed, while the alarm is on
    uptime: float  # s
    saved: float  # s since the last save; infinite: none yet
    contraction: dict[str, dict[str, Any]]  # network -> see `usvlearn.live.diagnostics.networks`
    identified: dict[str, tuple[float, float, float, str]]  # quantity -> value, low, high, unit
    warnings: tuple[str, ...]  # sentences
    notes: tuple[str, ...] = ()  # sentences about what cannot be known
    loss: str = ""  # what is known of the failed thruster now
    refit: Refit | None = None  # None: missions are not fitted

    def json(self) -> dict[str, Any]:
        """As JSON values: a number that is not finite becomes null."""
        found: dict[str, Any] = finite({**self._asdict(), "refit": self.refit and self.refit._asdict()})
        return found


def quantity(value: float, low: float, high: float, unit: str) -> str:
    """An identified quantity with its 90 % interval, in words.

    >>> quantity(1.5, 1.25, 1.75, "m/s"), quantity(math.nan, math.nan, math.nan, "m/s")
    ('1.5 (1.25 ... 1.75) m/s', 'not known yet')
    """
    return f"{value:.3g} ({low:.3g} ... {high:.3g}) {unit}" if math.isfinite(value) else "not known yet"


COMPILING = Health(
    "compiling", "preparing compiled code, for minutes at the first start", {}, {}, 0, 0, 0, None, 0.0, math.inf, {},
    {}, (),
)  # fmt: skip


def seconds(value: float) -> str:
    """A duration for a person.

    >>> seconds(3.2), seconds(7260.0), seconds(math.inf)
    ('3 s', '2.0 h', 'never')
    """
    if not math.isfinite(value):
        return "never"
    if value < 120:
        return f"{value:.0f} s"
    return f"{value / 60:.0f} min" if value < 7200 else f"{value / 3600:.1f} h"
