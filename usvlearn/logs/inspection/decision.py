"""What was decided about a log, how certain that is, and why."""

from __future__ import annotations

from typing import NamedTuple

from usvlearn.core import unconfirmed

CERTAIN, PROBABLE, UNSURE = "certain", unconfirmed.PROBABLE, unconfirmed.UNSURE
ORDER = (CERTAIN, PROBABLE, UNSURE)


class Decision(NamedTuple):
    """One line of what `usvlearn inspect` tells.

    `certain` means that numbers prove it by a physical relation, `probable` that names or conventions say it and
    nothing speaks against it, `unsure` that evidence is missing or contradicts.
    """

    channel: str  # such as "surge"
    what: str  # "series", "unit", "zero", "span", "sign", "messages", "period", "delay"
    value: str
    certainty: str  # CERTAIN, PROBABLE or UNSURE
    reason: str
    alternatives: tuple[str, ...] = ()


def least(*certainties: str) -> str:
    """The least of several certainties."""
    return ORDER[max(map(ORDER.index, certainties))]
