"""Persistence: the next speed is the last one, v⁺ = v. Skill is measured against it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import Family, leaf

if TYPE_CHECKING:
    from torch import Tensor


class PersistenceState(NamedTuple):
    """The state of persistence."""

    surge: Tensor  # (*batch,) last measured speed, m/s


FAMILY = Family(("persistence",), lambda _: PersistenceState(surge=leaf()), frozen=("surge",))
AT = FAMILY.at
