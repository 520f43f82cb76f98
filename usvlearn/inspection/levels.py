"""The zero point and the full scale of a command, by its values: microseconds, percent, shares, newtons or others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.inspection.candidate import Candidate
from usvlearn.inspection.decision import CERTAIN, PROBABLE, UNSURE
from usvlearn.inspection.vocabulary import side, words

PWM = "PWM in us"
LEAST_PWM, MOST_PWM = 800.0, 2300.0  # us
NEUTRAL = (1450.0, 1550.0)  # us, between which a neutral pulse lies
DEAD_BAND = 12.0  # us, within which a neutral pulse may differ from 1500
COMMON = 0.02  # share of the values that the one at rest has, at least
NEUTRAL_WORDS = {"zero", "neutral", "trim", "mid", "center", "centre", "nullpunkt"}


class Level(NamedTuple):
    """Zero and span of a command."""

    zero: float
    span: float
    kind: str  # PWM, "percent", "share", "N", "raw numbers"
    zero_certainty: str
    zero_reason: str
    span_certainty: str
    span_reason: str
    alternatives: tuple[str, ...]  # spans


def find_level(candidate: Candidate, pool: Sequence[Candidate], convention: str = "") -> Level:
    """Zero and span of a command.

    Args:
        candidate: the command.
        pool: all series of the log, constant ones too: one of them may be its zero point.
        convention: name of the format.
    """
    low, high = candidate.extent
    if low >= LEAST_PWM and high <= MOST_PWM and high > low:
        return _pwm(candidate, pool)
    size, unit = candidate.size, candidate.unit
    near = CERTAIN if low < 0 or _rest(candidate) == 0 else PROBABLE
    zero = (
        0.0,
        near,
        "values of both signs" if low < 0 else "it rests at 0" if _rest(candidate) == 0 else "by convention",
    )
    if unit == "percent" or (size > 2 and abs(size - 100) < 1e-6) or (convention == "MOOS" and 1.5 < size <= 100):
        why = {"percent": "declared as percent"}.get(
            unit, "values reach 100" if size > 99.9 else "MOOS counts in percent"
        )
        sure = PROBABLE if size > 50 or unit == "percent" else UNSURE
        return Level(zero[0], 100.0, "percent", *zero[1:], sure, why, (f"{_round(size):g}",))
    if unit == "N" or {"n", "newton", "newtons", "force"} & set(words(candidate.label)):
        return Level(zero[0], _round(size), "N", *zero[1:], PROBABLE, "the greatest force seen", ())
    if size <= 1.0 + 1e-9:
        sure = CERTAIN if size > 0.999 else PROBABLE
        return Level(zero[0], 1.0, "share", *zero[1:], sure, f"values reach {size:.3g}", ())
    if 50 < size < 100:
        told = f"values reach {size:.3g}: percent, if 100 is full scale"
        return Level(zero[0], 100.0, "raw numbers", *zero[1:], UNSURE, told, (f"{_round(size):g}",))
    others = ("100",) if size < 100 else ()
    return Level(zero[0], _round(size), "raw numbers", *zero[1:], UNSURE, "the greatest value seen", others)


def _pwm(candidate: Candidate, pool: Sequence[Candidate]) -> Level:
    low, high = candidate.extent
    rest = _rest(candidate)
    declared = [
        each
        for each in pool
        if NEUTRAL_WORDS & set(words(each.label))
        and not each.varies
        and NEUTRAL[0] <= each.size <= NEUTRAL[1]
        and side(each.label) in ("", side(candidate.label))
    ]
    if declared:
        zero = float(declared[0].size), CERTAIN, f"{declared[0].label} says so"
    elif abs(rest - 1500) <= DEAD_BAND:
        zero = rest, PROBABLE, f"it rests at {rest:g}"
    elif NEUTRAL[0] <= rest <= NEUTRAL[1]:
        zero = rest, UNSURE, f"it rests at {rest:g}; 1500 by convention"
    elif low > NEUTRAL[0] and rest <= 1150 and rest - low < 50:
        zero = rest, UNSURE, f"it never leaves {low:.0f} … {high:.0f}, and rests at {rest:g}"
    elif low > 1450 or high < 1550 or rest < NEUTRAL[0]:
        zero = 1500.0, UNSURE, f"by convention; it rests at {rest:g}, and stays within {low:.0f} … {high:.0f}"
    else:
        zero = 1500.0, PROBABLE, "by convention; it never rests"
    reach = max(high - zero[0], zero[0] - low)
    if reach > 420:
        return Level(zero[0], 500.0, PWM, *zero[1:], PROBABLE, f"values reach {low:.0f} … {high:.0f}", ("400",))
    if reach > 380:
        told = f"values reach {low:.0f} … {high:.0f}, as of 1100 … 1900"
        return Level(zero[0], 400.0, PWM, *zero[1:], PROBABLE, told, ("500",))
    told = f"values stay within {low:.0f} … {high:.0f}; full scale is 400 or 500 by convention"
    return Level(zero[0], 400.0, PWM, *zero[1:], UNSURE, told, ("500",))


def _rest(candidate: Candidate) -> float:
    """The value that comes most often; NaN if none is common."""
    values, counts = np.unique(candidate.value, return_counts=True)
    if counts.max() < COMMON * len(candidate.value):
        return math.nan
    return float(values[counts.argmax()])


def _round(size: float) -> float:
    """Three digits, upwards.

    >>> _round(36.4999), _round(0.98123)
    (36.5, 0.982)
    """
    scale = 10.0 ** (math.floor(math.log10(size)) - 2) if size > 0 else 1.0
    return float(f"{math.ceil(size / scale - 1e-9) * scale:.3g}") or 1.0
