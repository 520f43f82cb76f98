"""The zero point and the full scale of a command, by its values: microseconds, percent, shares, newtons or others."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.logs.inspection.candidate import Candidate, held_at
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE
from usvlearn.logs.inspection.vocabulary import SIDES, SPEED_SETS, names_moment, side, words

PWM = "PWM in us"
LEAST_PWM, MOST_PWM = 800.0, 2300.0  # us
NEUTRAL = (1450.0, 1550.0)  # us, between which a neutral pulse lies
DEAD_BAND = 12.0  # us, within which a neutral pulse may differ from 1500
COMMON = 0.02  # share of the values that the one at rest has, at least
STILL = 0.08  # share of the greatest speed, below which a boat stands
FEWEST = 20  # speeds of a boat that stands
MIDDLE = 0.3  # share of the greatest value, above which the zero of a command without a sign lies, unless at 0
AWAY = 0.15  # share of the greatest value, above which a command never comes near 0
IDLE = 0.04  # of the range of a command, within which a boat that stands is at its least value
FUZZ = 0.03  # share of the scale, within which two values are taken as equal
LIMIT = 0.999  # share of the greatest force, above which full scale is reached
STEADY = 0.3  # share of the values while the boat stands that lie at the zero
OFTEN = 0.7  # likewise, closely, of a zero that differs from 1500 us
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
    """Zero and span of a command; of all series of the log, constant ones too, one may be its zero point.

    Where the boat stands by its speed, times and values, m/s, a command is at its zero.
    """
    low, high = candidate.extent
    if low >= LEAST_PWM and high <= MOST_PWM and high > low:
        return _pwm(candidate, pool, speed)
    level = _by_size(candidate, convention)
    if low < 0 or high <= low or SPEED_SETS & set(words(candidate.label)):
        return level
    centred = _at_mid_scale(level, candidate, speed)
    if centred.zero or centred.zero_certainty == UNSURE or centred.kind != "raw numbers" or low <= IDLE * high:
        return centred
    why = f"by convention, but it never falls below {low:g}, as a motor that idles"
    return centred._replace(zero_certainty=UNSURE, zero_reason=why, zeros=(f"{low:g}",))


def _by_size(candidate: Candidate, convention: str) -> Level:
    """With a zero of 0."""
    low, size, unit = candidate.extent[0], candidate.size, candidate.unit
    near = CERTAIN if low < 0 or _rest(candidate) == 0 else PROBABLE
    why = "values of both signs" if low < 0 else "it rests at 0" if _rest(candidate) == 0 else "by convention"
    zero = 0.0, near, why
    if candidate.by_parameters:
        why, full = "by the parameters of the autopilot", 1.0 if size <= 1 + 1e-9 else _round(size)
        lacking = f"the log lacks limits of this servo, or changes them; values reach {size:.3g}"
        sure, reason = (CERTAIN, why) if unit == "1" and full == 1 else (UNSURE, lacking)
        return Level(0.0, full, "share", CERTAIN if unit == "1" else PROBABLE, why, sure, reason, ())
    if unit == "percent" or (size > 2 and abs(size - 100) < 1e-6) or (convention == "MOOS" and 1.5 < size <= 100):
        why = "values reach 100" if size > 99.9 else "MOOS counts in percent"
        why = "declared as percent" if unit == "percent" else why
        sure = PROBABLE if size > 50 or unit == "percent" else UNSURE
        return Level(zero[0], 100.0, "percent", *zero[1:], sure, why, (f"{_round(size):g}",))
    if names_moment(candidate.label):
        return Level(zero[0], _round(size), "N·m", *zero[1:], *_greatest(candidate, "moment"), ())
    spoken = {word for word in words(candidate.label) if not word.isdigit()} - SIDES
    if unit == "N" or {"newton", "newtons", "force"} & spoken or ("n" in spoken and len(spoken) > 1):
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
    """How sure the greatest force or moment is that of full scale: a limit is reached again and again."""
    size = np.abs(candidate.value[np.argsort(candidate.time, kind="stable")])
    at = size >= LIMIT * size.max()
    times = int((at[1:] > at[:-1]).sum()) + bool(at[0])
    return (PROBABLE if times > 1 else UNSURE), f"the greatest {what} seen, {'several times' if times > 1 else 'once'}"


def _at_mid_scale(level: Level, candidate: Candidate, speed: tuple[np.ndarray, np.ndarray] | None) -> Level:
    """The zero of a command that is never negative: in the middle of its scale, if the numbers speak for it."""
    low, high = candidate.extent
    away = low > AWAY * high
    full = high if away and level.kind == "share" else level.span
    value, share, stands = _where_still(candidate, speed, FUZZ * full)
    if math.isnan(value):  # the boat never stands: the value that comes most often may be its zero
        value = next((each for each in (_rest(candidate), float(np.median(candidate.value))) if each > 0), 0.0)
        if low > 0.05 * full and abs(value - full / 2) < 0.1 * full and _both_sides(candidate, value, FUZZ * full):
            return _perhaps_at_half(level, f"{low:g} … {candidate.extent[1]:g}, mostly about {value:.4g}")
        return _perhaps_at_half(level, f"{low:g} … {candidate.extent[1]:g}") if low > MIDDLE * full else level
    if (low > IDLE * full or candidate.unit == "us") and share > STEADY and value - low < IDLE * (high - low):
        return _forward_only(level, candidate, value)
    if not value / full > MIDDLE:
        return level
    centred, crossed = abs(value - full / 2) < FUZZ * full, _both_sides(candidate, value, FUZZ * full)
    if not crossed and not (centred and share > STEADY):
        return level
    zero = full / 2 if centred and level.kind != "raw numbers" else value
    sentence = f"the boat stands at {stands}, and it is {'reached from both sides' if crossed else 'mid-scale'}"
    zero = float(f"{zero:.4g}")
    reach = max(high - zero, zero - low) if zero > 0.6 * full or level.kind == "raw numbers" else full - zero
    middle = level._replace(zero=zero, zero_reason=sentence, span=_round(reach))
    if crossed and share > STEADY and (centred or away):
        sure = level.span_certainty if centred else UNSURE
        return middle._replace(zero_certainty=PROBABLE, span_certainty=sure, alternatives=())
    return middle._replace(zero_certainty=UNSURE, zeros=("0",), span_certainty=UNSURE, alternatives=(f"{full:g}",))


def _forward_only(level: Level, candidate: Candidate, value: float) -> Level:
    """A command whose least value, above 0, is that of a boat that stands: it never pushes astern."""
    (low, high), pulses = candidate.extent, level.kind == PWM
    whole = next((each for each in (1900.0, 2000.0) if pulses and abs(high - each) <= 20), 0.0)
    top, zero = whole or high, float(f"{low:.4g}")
    sentence = f"the boat stands at {value:.4g}, its least value: it never pushes astern"
    reached = f"from there to {top:.4g}, " + ("its full scale" if whole else "the greatest value seen")
    others = (f"{2000 - zero:g}",) if pulses and not whole else ()
    span = _round(top - zero), level.kind, PROBABLE, sentence, PROBABLE if whole else UNSURE, reached, others
    return Level(zero, *span)


def _perhaps_at_half(level: Level, extent: str) -> Level:
    """A command that never comes near 0 may as well stop the boat at half its scale."""
    half = f"{level.span / 2:g}"
    return level._replace(
        zero_certainty=UNSURE, zero_reason=f"by convention, but it stays within {extent}", zeros=(half,),
        span_certainty=UNSURE, alternatives=(half, *level.alternatives),
    )  # fmt: skip


def _where_still(candidate: Candidate, speed: tuple[np.ndarray, np.ndarray] | None,
                 near: float) -> tuple[float, float, str]:  # fmt: skip
    """The median of a command while the boat stands, the share of these values near it, and both in words; or NaN."""
    if speed is None or not len(speed[0]):
        return math.nan, 0.0, ""
    size = np.abs(speed[1])
    still = speed[0][size < STILL * np.quantile(size, 0.95)]
    if len(still) < max(FEWEST, COMMON * len(size) / 2):
        return math.nan, 0.0, ""
    held = held_at((candidate.time, candidate.value), still)
    value = float(np.median(held))
    beside = held[np.abs(held - value) <= near]
    low, high = np.quantile(np.append(beside, value), [0.05, 0.95])
    band = f", and anywhere in {low:.4g} … {high:.4g}: a dead zone, or turns" if high - low > near / 2 else ""
    return value, len(beside) / len(held), f"{value:.4g}{band}"


def _both_sides(candidate: Candidate, value: float, near: float) -> bool:
    return min((candidate.value < value - near).mean(), (candidate.value > value + near).mean()) > COMMON


def _pwm(candidate: Candidate, pool: Sequence[Candidate], speed: tuple[np.ndarray, np.ndarray] | None) -> Level:
    low, high = candidate.extent
    rest = _rest(candidate)
    at_rest = NEUTRAL[0] <= rest <= NEUTRAL[1]
    value, share, stands = _where_still(candidate, speed, 0.05 * (high - low))
    if low < NEUTRAL[0] - 100 and share > STEADY and value - low < IDLE * (high - low):
        return _forward_only(Level(value, 400.0, PWM, UNSURE, "", UNSURE, "", ()), candidate, value)
    still = [each for each in pool if not each.varies and NEUTRAL[0] <= each.size <= NEUTRAL[1]]
    near = [each for each in still if side(each.label) in ("", side(candidate.label))]
    declared = [each for each in near if NEUTRAL_WORDS & set(words(each.label))]
    others: tuple[str, ...] = ()
    if declared:
        zero = float(declared[0].size), CERTAIN, f"{declared[0].label} says so"
    elif abs(rest - 1500) <= DEAD_BAND:
        zero = rest, PROBABLE, f"it rests at {rest:g}"
    elif share > STEADY and NEUTRAL[0] <= value <= NEUTRAL[1] and (rest == round(value) or not at_rest):
        odd, often = abs(value - 1500) > DEAD_BAND, _where_still(candidate, speed, DEAD_BAND / 2)[1]
        if odd and rest != round(value) and often < OFTEN:  # it may turn on the spot
            zero, others = (1500.0, UNSURE, f"by convention; the boat stands at {stands}"), (f"{value:.0f}",)
        else:
            zero = float(round(value)) if odd else 1500.0, PROBABLE, f"the boat stands at {stands}"
    elif at_rest:
        zero, others = (rest, UNSURE, f"it rests at {rest:g}; 1500 by convention"), ("1500",)
    elif low > 1450 or high < 1550 or rest < NEUTRAL[0]:
        rests = "never rests" if math.isnan(rest) else f"rests at {rest:g}"
        zero = 1500.0, UNSURE, f"by convention; it {rests}, and stays within {low:.0f} … {high:.0f}"
    else:
        zero = 1500.0, PROBABLE, "by convention; it never rests"
    reach = max(high - zero[0], zero[0] - low)
    span, other = (500.0, "400") if reach > 420 else (400.0, "500")
    sentence = f"values reach {low:.0f} … {high:.0f}" + (", as of 1100 … 1900" if span == 400 else "")
    if reach <= 380:
        sentence = f"values stay within {low:.0f} … {high:.0f}; full scale is 400 or 500 by convention"
    return Level(zero[0], span, PWM, *zero[1:], PROBABLE if reach > 380 else UNSURE, sentence, (other,), others)


def sharing(force: Candidate, moment: Candidate, levels: tuple[Level, Level]) -> tuple[Level, Level]:
    """Spans of the force ahead and of the moment, with which the sum of both, as shares, reaches 1 and not more."""
    time, push = force.evidence
    both = np.abs(push) / max(force.size, 1e-9) + np.abs(held_at(moment.evidence, time)) / max(moment.size, 1e-9)
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
    """Three digits, upwards."""
    scale = 10.0 ** (math.floor(math.log10(size)) - 2) if size > 0 else 1.0
    return float(f"{math.ceil(size / scale - 1e-9) * scale:.3g}") or 1.0
