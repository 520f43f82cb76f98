"""The zero point and the full scale of a command, by its values: microseconds, percent, shares, newtons or others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE
from usvlearn.logs.inspection.vocabulary import names_moment, side, words

PWM = "PWM in us"
LEAST_PWM, MOST_PWM = 800.0, 2300.0  # us
NEUTRAL = (1450.0, 1550.0)  # us, between which a neutral pulse lies
DEAD_BAND = 12.0  # us, within which a neutral pulse may differ from 1500
COMMON = 0.02  # share of the values that the one at rest has, at least
STILL = 0.08  # share of the greatest speed, below which a boat stands
FEWEST = 20  # speeds of a boat that stands
MIDDLE = 0.3, 0.75  # share of the greatest value, between which the zero of a command without a sign lies, unless at 0
FUZZ = 0.03  # share of the scale, within which two values are taken as equal
LIMIT = 0.999  # share of the greatest force, above which full scale is reached
STEADY = 0.3  # share of the values while the boat stands that lie at the zero
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
    zeros: tuple[str, ...] = ()  # that are possible, too


def find_level(candidate: Candidate, pool: Sequence[Candidate], convention: str = "",
               speed: tuple[np.ndarray, np.ndarray] | None = None) -> Level:  # fmt: skip
    """Zero and span of a command.

    Args:
        candidate: the command.
        pool: all series of the log, constant ones too: one of them may be its zero point.
        convention: name of the format.
        speed: times and values, m/s: where the boat stands, a command is at its zero.
    """
    low, high = candidate.extent
    if low >= LEAST_PWM and high <= MOST_PWM and high > low:
        return _pwm(candidate, pool)
    level = _by_size(candidate, convention)
    return _at_mid_scale(level, candidate, speed) if low >= 0 and high > low else level


def _by_size(candidate: Candidate, convention: str) -> Level:
    """With a zero of 0."""
    low, size, unit = candidate.extent[0], candidate.size, candidate.unit
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
    if names_moment(candidate.label):
        return Level(zero[0], _round(size), "N·m", *zero[1:], *_greatest(candidate, "moment"), ())
    if unit == "N" or {"n", "newton", "newtons", "force"} & set(words(candidate.label)):
        return Level(zero[0], _round(size), "N", *zero[1:], *_greatest(candidate, "force"), ())
    if size <= 1.0 + 1e-9:
        sure = CERTAIN if size > 0.999 else PROBABLE if size > 0 else UNSURE
        return Level(zero[0], 1.0, "share", *zero[1:], sure, f"values reach {size:.3g}", ())
    if 50 < size < 100:
        sentence = f"values reach {size:.3g}: percent, if 100 is full scale"
        return Level(zero[0], 100.0, "raw numbers", *zero[1:], UNSURE, sentence, (f"{_round(size):g}",))
    others = ("100",) if size < 100 else ()
    return Level(zero[0], _round(size), "raw numbers", *zero[1:], UNSURE, "the greatest value seen", others)


def _greatest(candidate: Candidate, what: str) -> tuple[str, str]:
    """How sure the greatest force or moment is that of full scale: a limit is reached again and again.

    >>> time, thrust = np.arange(0.0, 400.0), 30 * np.sin(np.arange(0.0, 400.0) / 20)
    >>> _greatest(Candidate("a", None, "N", "", time, np.clip(thrust, -20, 20)), "force")
    ('probable', 'the greatest force seen, several times')
    >>> _greatest(Candidate("a", None, "N", "", time, thrust * np.exp(-time / 200)), "force")
    ('unsure', 'the greatest force seen, once')
    """
    size = np.abs(candidate.value[np.argsort(candidate.time, kind="stable")])
    at = size >= LIMIT * size.max()
    times = int((at[1:] > at[:-1]).sum()) + bool(at[0])
    return (PROBABLE if times > 1 else UNSURE), f"the greatest {what} seen, {'several times' if times > 1 else 'once'}"


def _at_mid_scale(level: Level, candidate: Candidate, speed: tuple[np.ndarray, np.ndarray] | None) -> Level:
    """The zero of a command that is never negative: in the middle of its scale, if the numbers speak for it.

    >>> time = np.arange(0.0, 400.0)
    >>> thrust = np.clip(np.sin(time / 20), -0.5, 1) * (time % 100 < 60)
    >>> command, speed = Candidate("a", None, "percent", "", time, 50 + 50 * thrust), (time, 2 * thrust)
    >>> find_level(command, [], "", speed)[:2], find_level(command, [])[:2]
    ((50.0, 50.0), (0.0, 100.0))
    >>> find_level(command, []).zeros
    ('50',)
    """
    full, low = level.span, candidate.extent[0]
    value, share = _where_still(candidate, speed, FUZZ * full)
    if math.isnan(value):  # the boat never stands: the value that comes most often may be its zero
        value = next((each for each in (_rest(candidate), float(np.median(candidate.value))) if each > 0), 0.0)
        if low > 0.05 * full and abs(value - full / 2) < 0.1 * full and _both_sides(candidate, value, FUZZ * full):
            return _perhaps_at_half(level, f"{low:g} … {candidate.extent[1]:g}, mostly about {value:.4g}")
        return _perhaps_at_half(level, f"{low:g} … {candidate.extent[1]:g}") if low > MIDDLE[0] * full else level
    if not MIDDLE[0] < value / full < MIDDLE[1]:
        return level
    centred, crossed = abs(value - full / 2) < FUZZ * full, _both_sides(candidate, value, FUZZ * full)
    if not crossed and not (centred and share > STEADY):
        return level
    zero = full / 2 if centred and level.kind != "raw numbers" else value
    sentence = f"the boat stands at {value:.4g}, and it " + (
        "is reached from both sides" if crossed else "is mid-scale"
    )
    kept = level._replace(zero=float(f"{zero:.4g}"), zero_reason=sentence, span=_round(full - zero))
    if centred and crossed and share > STEADY:
        return kept._replace(zero_certainty=PROBABLE, alternatives=())
    return kept._replace(zero_certainty=UNSURE, zeros=("0",), span_certainty=UNSURE, alternatives=(f"{full:g}",))


def _perhaps_at_half(level: Level, extent: str) -> Level:
    """A command that never comes near 0 may as well stop the boat at half its scale."""
    half = f"{level.span / 2:g}"
    return level._replace(
        zero_certainty=UNSURE, zero_reason=f"by convention, but it stays within {extent}", zeros=(half,),
        span_certainty=UNSURE, alternatives=(half, *level.alternatives),
    )  # fmt: skip


def _where_still(candidate: Candidate, speed: tuple[np.ndarray, np.ndarray] | None, near: float) -> tuple[float, float]:
    """The median of a command while the boat stands, and the share of these values that lie near it; or NaN."""
    if speed is None or not len(speed[0]):
        return math.nan, 0.0
    size = np.abs(speed[1])
    still = speed[0][size < STILL * np.quantile(size, 0.95)]
    if len(still) < max(FEWEST, COMMON * len(size) / 2):
        return math.nan, 0.0
    order = np.argsort(candidate.time, kind="stable")
    place = np.searchsorted(candidate.time[order], still, side="right") - 1
    held = candidate.value[order][np.clip(place, 0, None)]
    value = float(np.median(held))
    return value, float((np.abs(held - value) <= near).mean())


def _both_sides(candidate: Candidate, value: float, near: float) -> bool:
    return min((candidate.value < value - near).mean(), (candidate.value > value + near).mean()) > COMMON


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
        rests = "never rests" if math.isnan(rest) else f"rests at {rest:g}"
        zero = 1500.0, UNSURE, f"by convention; it {rests}, and stays within {low:.0f} … {high:.0f}"
    else:
        zero = 1500.0, PROBABLE, "by convention; it never rests"
    reach = max(high - zero[0], zero[0] - low)
    if reach > 420:
        return Level(zero[0], 500.0, PWM, *zero[1:], PROBABLE, f"values reach {low:.0f} … {high:.0f}", ("400",))
    if reach > 380:
        sentence = f"values reach {low:.0f} … {high:.0f}, as of 1100 … 1900"
        return Level(zero[0], 400.0, PWM, *zero[1:], PROBABLE, sentence, ("500",))
    sentence = f"values stay within {low:.0f} … {high:.0f}; full scale is 400 or 500 by convention"
    return Level(zero[0], 400.0, PWM, *zero[1:], UNSURE, sentence, ("500",))


def sharing(force: Candidate, moment: Candidate, levels: tuple[Level, Level]) -> tuple[Level, Level]:
    """Spans of the force ahead and of the moment, with which the sum of both, as shares, reaches 1 and not more."""
    (time, push), (stamps, turn) = force.evidence, moment.evidence
    order = np.argsort(stamps, kind="stable")
    place = np.clip(np.searchsorted(stamps[order], time, side="right") - 1, 0, None)
    both = np.abs(push) / max(force.size, 1e-9) + np.abs(turn[order][place]) / max(moment.size, 1e-9)
    most, sentence = float(np.quantile(both, 0.999)), "the greatest sum of both is full scale"
    one, other = (
        level._replace(span=_round(most * each.size), span_reason=sentence, span_certainty=PROBABLE, kind=kind)
        for level, each, kind in zip(levels, (force, moment), ("N", "N·m"), strict=True)
    )
    return one, other


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
