"""Memory of the step before: the last acceleration and the last commands, for a model that uses them.

A thruster takes time to spin up, and some water moves with the hull, so the next increment depends on the last one.
`SurgeDynamics(memory=True)` has terms for this, and the wrapper supplies their inputs.

The derivation is in `docs/theory/estimators.md#memory-and-banks`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import NOT_NEGATIVE, POSITIVE, UNIT, Family, Parameters, leaf

if TYPE_CHECKING:
    from torch import Tensor


class MemoryState(NamedTuple):
    """The estimator's state, and the step before."""

    inner: Any
    surge_dot: Tensor  # (*batch,) m/s², between the last two measured speeds; of the last step where it coasts
    surge: Tensor  # (*batch,) last measured speed, m/s
    since: Tensor  # (*batch,) s since then
    estimate: Tensor  # (*batch,) speed from which the next step departs, m/s
    command_left: Tensor  # (*batch,) of the last step
    command_right: Tensor  # (*batch,)
    known: Tensor  # (*batch,) bool: the segment has had a step


class Number(Parameters):
    """Limit."""

    SURGE_DOT_MAX = POSITIVE


FAMILY = Family(
    ("memory",),
    lambda _: MemoryState(
        inner={},
        surge_dot=leaf(),
        surge=leaf(),
        since=leaf(legal=NOT_NEGATIVE),
        estimate=leaf(),
        command_left=leaf(),
        command_right=leaf(),
        known=leaf(legal=UNIT, flag=True),
    ),
    Number,
    frozen=("surge_dot", "surge", "since", "estimate", "command_left", "command_right", "known"),
)
AT = FAMILY.at
