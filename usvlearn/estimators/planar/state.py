"""Tracks: where the boat will be, from the ensembles of surge, sway and yaw rate, with ellipses that learn.

Equations (1) to (4): `docs/theory/ensemble.md#tracks`. In the code the sway through the water is v and the surge over
ground u.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import ANY, NOT_NEGATIVE, POSITIVE, UNIT, Family, Parameters, ParameterVectors, leaf
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import HELD, PATH, LearnedState, learned_leaves

if TYPE_CHECKING:
    from torch import Tensor

AXES = ("surge", "sway", "yaw")
SURGE, SWAY, YAW = range(3)
HORIZONS, OVERLAP = (2.0, 5.2, 10.0, 30.0), 2.0  # s, of which each is a whole number of steps of 0.4 s
MOST_OVERLAP = 20.0
USED = 20.0  # measurements of the sway, before which it counts as 0
FILTERS = {"surge": "joint", "sway": "sway", "yaw": "yaw"}  # kind of the member whose mean is a component's estimate
LIMIT = 20.0  # m/s, rad/s: a sway or yaw rate at or beyond it counts as missing
SLOW, CLIP, ROUND = 1 / 100, 6.0, 5.0  # of (3)
QUICK_TIME, SLOW_TIME, USUAL, LARGEST, MOST_SURPRISE = 3.0, 300.0, 2.0, 25.0, 4.0  # of (4): s, s
AWAY = 10.0  # m
FLOOR = 1e-4  # m², added to both variances of C
DELAY = 9.0
POSE = 5  # what is measured at the end of a step, beside the speed:
HEADING, TURN, MEASURED_SWAY, NORTH, EAST = range(POSE)  # rad, rad/s, m/s over ground, m, m
# A slot: the track of one origin.
(
    ELAPSED, REACH, NORTH_0, EAST_0, COS_0, SIN_0, C_NORTH, C_EAST, U, V, R, W, PSI, AT_NORTH, AT_EAST, RUN,
    U_0, R_0, PSI_0, HELD_NORTH, HELD_EAST, COS, SIN, HELD_COS, HELD_SIN, WIDER, COMMANDS,
) = range(27)  # fmt: skip  # COMMANDS: the path of `manoeuvre_intervals`
HORIZON = COMMANDS + PATH  # then, for each horizon: what (1) to (3) of `manoeuvre_intervals` need, w, and C
OF_HORIZON = HELD + 4
# What is known of a track when it has become due.
DUE = 8
ERROR, HEADING_ERROR, CONSTANT, HELD_RATE, RHO, RADIUS, GROUP, DISTANCE = range(DUE)
# The table of places, a row for each axis and one for the track.
PROGRAM, STATE, NUMBER, MEAN, UPDATES, BLOCK, WEIGHTS, PREDICTED, DEVIATION = range(9)
(
    SLOTS, SINCE, BEFORE, SURPRISE, COVARIANCE, MEAN_ERROR, QUANTILE, ERRORS, DUES, LEARNED,
) = range(10)  # fmt: skip  # LEARNED: six places
COUNT, HORIZON_COUNT, LENGTH, Q = range(LEARNED + 6, LEARNED + 10)
PLACES = Q + 1
TRACK = len(AXES)  # row of the track


class TrackState(NamedTuple):
    """Tracks under way, and what was learned of earlier ones; H horizons."""

    slots: Tensor  # (*batch, slots, length) see the places above
    since: Tensor  # (*batch, H) s since the last origin that goes on to the horizon
    before: Tensor  # (*batch, 6) w, m/s, v, m/s, r, rad/s at the end of the last step, its commands, and ψ, rad
    surprise: Tensor  # (*batch, 4) ν and ν̄ of (4), of surge and of yaw rate
    covariance: Tensor  # (*batch, H, 3) C of (3), m²: forward, mixed, to starboard
    error: Tensor  # (*batch, H) running mean of ρ, m
    quantile: Tensor  # (*batch, H) its multiple that holds 90 %
    errors: Tensor  # (*batch, H) count
    learned: LearnedState
    due: Tensor  # (*batch, H, 8) of the tracks that became due in the last step; NaN where none did


class Number(Parameters):
    """Constants."""

    COVERAGE = UNIT
    OVERLAP = POSITIVE


class Vector(ParameterVectors):
    """Horizons, s, `(H,)`. A size is (slots, H, length)."""

    HORIZONS = POSITIVE, lambda size: size[1]


def _state(size: Any) -> TrackState:
    slots, H, length = size if isinstance(size, tuple) else (1, 1, 1)
    return TrackState(
        slots=leaf(slots, length, legal=ANY),
        since=leaf(H, legal=NOT_NEGATIVE),
        before=leaf(6),
        surprise=leaf(4, legal=NOT_NEGATIVE),
        covariance=leaf(H, 3),
        error=leaf(H, legal=NOT_NEGATIVE),
        quantile=leaf(H, legal=POSITIVE),
        errors=leaf(H, legal=NOT_NEGATIVE),
        learned=learned_leaves(H),
        due=leaf(H, DUE, legal=ANY),
    )


FAMILY = Family(("track",), _state, Number, vectors=Vector)
AT = FAMILY.at


def slot_length(horizons: int, blocks: Iterable[int]) -> int:
    """The length of a slot of so many horizons, from the numbers of each axis: frozen members, and their weights."""
    return HORIZON + horizons * OF_HORIZON + sum(blocks)


def filter_of(axis: str, description: Mapping[str, Any]) -> str | None:
    """The name of the member of an axis whose mean is the estimate of the component; None without."""
    return next((name for name, each in description["members"].items() if each["kind"] == FILTERS[axis]), None)


def slots_of(horizons: tuple[float, ...], overlap: float) -> int:
    """How many tracks are under way at the same time."""
    begins = (0.0, *horizons[:-1])
    return sum(int(overlap * (1 - a / b) + 1e-9) + 1 for a, b in zip(begins, horizons, strict=True))
