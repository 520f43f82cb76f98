"""Forecasts over several horizons, with weights and intervals for each.

At an origin the members are frozen: their leaves that an open-loop simulation needs are copied to a slot. From then on
each copy takes one step with every step of the boat, with the commands that come, and learns nothing. Equations (1) to
(3): `docs/theory/ensemble.md#forecasts`. By choice the half-width knows the manoeuvre, too
(`manoeuvre_intervals.state`); (2) and (3) go on beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, log
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import (
    ANY,
    FACTOR,
    NOT_NEGATIVE,
    POSITIVE,
    UNIT,
    WEIGHT,
    Family,
    Options,
    Parameters,
    ParameterVectors,
    Range,
    leaf,
)
from usvlearn.estimators.ensemble.combiners.state import TINY, BOAState

if TYPE_CHECKING:
    from torch import Tensor

HORIZONS = (0.4, 1.2, 2.0, 5.2, 10.0, 30.0)  # s
STEP = 0.4  # s, over which the losses have their unit
DELAY, LEAST, MOST, FIRST = 9.0, 0.3, 12.0, 2.06  # of (3): 1.645 deviations of a normal error are 2.06 mean errors
SHARE = 1 / 200  # of (2). With fewer than FEW errors an interval is infinite, and the weights are another horizon's
NARROWEST = 5e-3  # m/s, least half-width: after hours at rest all errors are 0
BEYOND = 1 + 1e-4  # times the longest horizon, with room for rounding: there is no interval
MOST_SLOTS, MOST_HORIZONS = 512, 32
WIDE = Range(0.0, inf)
EMPTY = -1.0  # s, elapsed of a slot without a forecast
PERSISTENCE, ENSEMBLE = "persistence", "ensemble"  # the last two columns of what is published
FIT, FIT_WEIGHT = "fit", 0.1  # a member that a batch fit adds, and its prior weight
# Places in the table of a fit: the last speed of drag, m/s; drag of turning, 1/rad; s by which thrust is late; the last
# command of thrust; of each side the thrust that depends on the speed, 1/s; points of thrust of each side and of drag,
# m/s², evenly spread from minus the last command, or speed, to it
SPEED, CROSS, LATE, COMMAND, MORE, THRUST = 0, 1, 2, 3, 4, 8
COMMANDS, SPEEDS, DRAG, TABLE = 41, 61, 90, 151
LATEST = 1.5  # steps by which thrust is late, at most


def with_fit(prior: Sequence[float]) -> dict[str, list[float]]:
    """BOA's prior and costs of the members and of a fit, from the prior of the members."""
    every = [*((1 - FIT_WEIGHT) * x for x in prior), FIT_WEIGHT]
    return {"prior": every, "costs": [-log(x) for x in every]}


NONE: Any = {}


class ForecastState(NamedTuple):
    """Forecasts under way, what was learned, and what became due last; H horizons, M members, a slot for an origin."""

    frozen: dict[str, dict[str, Tensor]]  # member -> leaf -> (*batch, slots, …)
    elapsed: Tensor  # (*batch, slots) s since the origin, EMPTY of an empty slot
    reach: Tensor  # (*batch, slots) index of the longest horizon to which it goes on
    origin: Tensor  # (*batch, slots) m/s, measured at the origin: persistence's forecast
    weights: Tensor  # (*batch, slots, H, M) at the origin
    widths: Tensor  # (*batch, slots, H) m/s, half-widths at the origin
    since: Tensor  # (*batch, H) s since the last origin that goes on to the horizon
    coasted: Tensor  # (*batch,) s since the last measured speed
    rule: BOAState  # (*batch, H, M) each
    error: Tensor  # (*batch, H) s of (2), m/s
    quantile: Tensor  # (*batch, H) q of (3)
    errors: Tensor  # (*batch, H) k
    predictions: Tensor  # (*batch, H, M + 2) m/s: members, persistence, ensemble; NaN where none was due
    halfwidths: Tensor  # (*batch, H) m/s, of the ensemble's; NaN likewise
    conditional: Any = NONE  # a `HorizonState`, or {}


class Number(Parameters):
    """Constants and hyperparameters."""

    OVERLAP = POSITIVE  # n
    COVERAGE = UNIT
    TINY = POSITIVE, TINY
    SCALE = POSITIVE  # m/s
    SHARE = UNIT


class Vector(ParameterVectors):
    """Horizons, and memories of their weights, s, `(H,)`; BOA's priors and costs, `(M,)`. A size is (slots, H, M)."""

    HORIZONS = POSITIVE, lambda size: size[1]
    MEMORY = POSITIVE, lambda size: size[1]
    PRIOR = FACTOR, lambda size: size[2]
    COSTS = POSITIVE, lambda size: size[2]


class Choice(Options):
    """Sizes; the row's own size is that of a slot."""

    SLOTS = (Range(1, MOST_SLOTS),)
    HORIZONS = (Range(1, MOST_HORIZONS),)
    MEMBERS = (Range(1, 1000),)
    FIT = (Range(-1, 10**9),)  # the place of a fit's table among the numbers; −1 without


def _state(size: Any) -> ForecastState:
    slots, H, M = size if isinstance(size, tuple) else (1, 1, 1)
    return ForecastState(
        frozen={},  # the members' own leaves
        elapsed=leaf(slots, legal=Range(EMPTY, 1e30)),
        reach=leaf(slots, legal=Range(0.0, H - 1.0)),
        origin=leaf(slots),
        weights=leaf(slots, H, M, legal=WEIGHT),
        widths=leaf(slots, H, legal=WIDE),
        since=leaf(H, legal=NOT_NEGATIVE),
        coasted=leaf(legal=NOT_NEGATIVE),
        rule=BOAState(
            weights=leaf(H, M, legal=WEIGHT),
            losses=leaf(H, M),
            squares=leaf(H, M, legal=NOT_NEGATIVE),
            ranges=leaf(H, M, legal=POSITIVE),
        ),
        error=leaf(H, legal=NOT_NEGATIVE),
        quantile=leaf(H, legal=POSITIVE),
        errors=leaf(H, legal=NOT_NEGATIVE),
        predictions=leaf(H, M + 2, legal=ANY),
        halfwidths=leaf(H, legal=ANY),
    )


FAMILY = Family(("forecasts",), _state, Number, Choice, Vector)
AT = FAMILY.at
