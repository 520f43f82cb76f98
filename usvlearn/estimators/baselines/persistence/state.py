"""Persistence: the next speed is the last one, v⁺ = v. The row that every table must have."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.family import Family, leaf

if TYPE_CHECKING:
    from torch import Tensor


class PersistenceState(NamedTuple):
    """What persistence remembers."""

    surge: Tensor  # (*batch,) last measured speed, m/s


FAMILY = Family(("persistence",), lambda _: PersistenceState(surge=leaf()))
AT = FAMILY.at
