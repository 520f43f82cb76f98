"""Forecasts over several horizons, with weights and intervals for each.

At an origin the members are frozen: their leaves that an open-loop simulation needs are copied. From then on each copy
takes one step with every step of the boat, with the commands that come, and learns nothing. After h s it is member m's
forecast x_m of the speed over the horizon h, made at the origin and given only the commands between. Every step with a
measured speed is an origin of the shortest horizon; it goes on to the horizon h if the last one that did was h/n s ago,
n being `overlap`. The ensemble's forecast has the weights w of that horizon as they were at the origin:

    ŷ = Σ w_m x_m,     ŷ ± q s                                                                          (1)

Where the speed y is then measured, the weights of the horizon learn by BOA (`combiners.state`) from x and y, and its
interval by conformal inference: s is the running mean of |y − ŷ|, and q its multiple that covers the share 1 − α,

    s ← s + max(1/k, 1/200) (|y − ŷ| − s)                                                               (2)
    log q ← log q + (miss − α)/(9 + n),    q in 0.3 … 12,    miss = 1 where |y − ŷ| > q s, else 0        (3)

with k the number of errors so far. Errors come late: n further forecasts are under way before the first error is known,
and (3) learns the more slowly. The interval is infinite until k = 10, and ± 5 mm/s at least. BOA forgets over
`memory` + `growth` h.

Losses of a long horizon are larger. The predictions and y are divided by √(h/0.4 s) before BOA, so that its least range
of the losses grows like those of a random walk.

By choice the half-width knows the manoeuvre, too (`conditional.state`); (2) and (3) go on beside it.

*A horizon with fewer than ten errors* has the weights of the next shorter one that has as many, or of the shortest.

*Between horizons* weights and half-widths are interpolated linearly in time; before the first horizon they are the
first's; beyond the last one the weights are the last's, and the interval is infinite. Time counts from the last
measured speed.

*After steps without measured speed* the ensemble's own prediction has the weights of the time since the last measured
speed, because it is a forecast over that time. So has an open-loop simulation.

The derivation is in `docs/theory/ensemble.md#forecasts`.
"""

from __future__ import annotations

from math import inf
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
from usvlearn.estimators.ensemble.combiners.state import BOAState

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


NONE: Any = {}


class ForecastState(NamedTuple):
    """Forecasts under way, what was learned from earlier ones, and those that became due in the last step.

    A slot holds the forecasts of one origin; H horizons, M members.
    """

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
    TINY = POSITIVE
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
