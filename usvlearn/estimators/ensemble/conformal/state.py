"""Adaptive prediction intervals with a given coverage.

Equation (1), its bound and sources: `docs/theory/ensemble.md#intervals`. Before ten innovations q is no quantile of
anything yet, and the published half-width is infinite. By choice the published half-width knows the manoeuvre
(`manoeuvre_intervals.state`); q goes on beside it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import AT_MOST_TEN, NOT_NEGATIVE, POSITIVE, UNIT, Family, Options, Parameters, Range, leaf
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import COMMAND, PATH, StepState, learned_leaves

if TYPE_CHECKING:
    from torch import Tensor

RATE, BOOST = 0.2, 1.0  # η, η₀
START = 0.05  # m/s, q before the first innovation
FEW = 10.0  # innovations, before which the published half-width is infinite
LEAST = 5e-3  # m/s; a boat at rest is predicted exactly for hours, and q must recover from it within some ten misses


NONE: Any = {}


class ConformalState(NamedTuple):
    """The intervals of the next predictions."""

    halfwidth: Tensor  # (*batch, k) q, m/s, which `published` makes infinite at first
    count: Tensor  # type: ignore[assignment]  # (*batch, k) innovations seen; checkpoints name it so, not tuple.count
    conditional: Any = NONE  # a `StepState`, or {}


class Number(Parameters):
    """Constants and the coverage."""

    COVERAGE = UNIT  # 1 − α
    RATE = AT_MOST_TEN, RATE  # η
    BOOST = AT_MOST_TEN, BOOST  # η₀
    LEAST = POSITIVE, LEAST  # m/s


class Choice(Options):
    """Whether the published half-widths depend on the manoeuvre, 0 or 1."""

    CONDITIONAL = Range(0, 1)


def _state(k: int, conditional: int = 0) -> ConformalState:
    widths = StepState(learned_leaves(k), leaf(PATH, legal=COMMAND)) if conditional else NONE
    return ConformalState(leaf(k, legal=POSITIVE), leaf(k, legal=NOT_NEGATIVE), widths)


FAMILY = Family(("conformal",), _state, Number, Choice, lengths=(Choice.CONDITIONAL,), work=lambda k: 2 * k)
AT = FAMILY.at
