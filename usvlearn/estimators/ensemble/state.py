"""An ensemble: estimators side by side, combiners of their predictions, an interval for each, and monitors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import ANY, POSITIVE, POSITIVE_OR_INFINITE, Family, Parameters, leaf
from usvlearn.estimators.ensemble.conformal.state import ConformalState

if TYPE_CHECKING:
    from torch import Tensor


class EnsembleState(NamedTuple):
    """The members' states, the combiners' states, and what was predicted last."""

    members: dict[str, Any]
    combiners: dict[str, Any]
    conformal: ConformalState  # of the next predictions, in the order of `Ensemble.names`
    predictions: Tensor  # (*batch, columns + combiners) m/s, in the order of `Ensemble.names`
    halfwidths: Tensor  # (*batch, columns + combiners) of their intervals, m/s; infinite before ten measurements
    monitors: Any  # of the innovations of `Ensemble.names` and of the thrusters, or {}
    forecasts: Any  # a `ForecastState`, or {}
    accommodation: Any = {}  # an `AccommodationState`, or {} without filters that make trials  # noqa: RUF012


class Number(Parameters):
    """Limit."""

    SURGE_MAX = POSITIVE


NONE: Any = {}  # the leaves of its parts: each part declares its own
FAMILY = Family(
    ("ensemble",),
    lambda names: EnsembleState(
        members=NONE,
        combiners=NONE,
        conformal=NONE,
        predictions=leaf(names, legal=ANY),  # NaN where a member is inactive
        halfwidths=leaf(names, legal=POSITIVE_OR_INFINITE),
        monitors=NONE,
        forecasts=NONE,
        accommodation=NONE,
    ),
    Number,
)
AT = FAMILY.at
