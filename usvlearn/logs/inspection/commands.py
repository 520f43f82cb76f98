"""The channels of the commands that were found: scale, sign, and whether they are posted on change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from usvlearn.logs.channels.channel import AUTO
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.command_sides import Commands, Side
from usvlearn.logs.inspection.config_writer import scalar
from usvlearn.logs.inspection.decision import PROBABLE, UNSURE, Decision

SIDES = ("command_left", "command_right")
UNEVEN, ON_CHANGE = 1.5, 3.0  # ratio of long to usual intervals, from which a command may be, and is posted on change
NO_REPEATS = 0.02  # share of values that repeat the one before, below which none does


def _on_change(candidate: Candidate) -> tuple[bool, str]:
    """Whether values are posted only when they differ from the one before, and how certain that is."""
    ratio = candidate.slow / candidate.interval if candidate.interval > 0 else 1.0
    if candidate.repeats >= NO_REPEATS or not ratio > UNEVEN:
        return False, PROBABLE
    return True, PROBABLE if ratio > ON_CHANGE else UNSURE


def tell_commands(commands: Sequence[Commands], channels: dict, series: dict) -> list[Decision]:
    """The best commands as the channels: series, zero, span and sign of each side, and how it is posted."""
    if not commands:
        return []
    best, decisions = commands[0], []
    for channel, one in zip(SIDES, (best.left, best.right), strict=True):
        channels[channel] = _command_source(one)
        if len(one.parts) == 1:
            series[channel] = one.parts[0]
        others = tuple(_listed(getattr(each, channel.removeprefix("command_"))) for each in commands[1:4])
        other = _listed(best.right if one is best.left else best.left)
        if best.certainty == UNSURE and other != _listed(one):
            others = (other, *others)
        if best.middle:
            others = (scalar([each.name for each in (*one.parts, best.middle)]), *others)
        label, level = _listed(one), one.levels[0]
        ahead = "reversed" if min((one.sign, *one.weights[:1])) < 0 else "positive ahead"
        held = channels[channel].get("held", False)
        how = "on change: held until the next one" if held else "periodic: window auto"
        rate = f"{one.parts[0].repeats:.0%} repeat the one before; every {one.parts[0].interval:.2g} s"
        span, span_reason = f"{one.sign * level.span:g}", f"{level.kind}: {level.span_reason}"
        decisions += [
            Decision(channel, "series", label, best.certainty, best.reason, others),
            Decision(channel, "zero", f"{level.zero:g}", level.zero_certainty, level.zero_reason, level.zeros),
            Decision(channel, "span", span, level.span_certainty, span_reason, level.alternatives),
            Decision(channel, "sign", ahead, best.sign_certainty, best.sign_reason, best.alternatives),
            Decision(channel, "posting", how, _on_change(one.parts[0])[1], rate),
        ]
    return decisions


def _listed(one: Side) -> str:
    return " + ".join(each.label for each in one.parts)


def _command_source(one: Side) -> dict[str, Any]:
    held = any(_on_change(each)[0] for each in one.parts)
    keys = {"held": held, "window": AUTO, "delay": 0.0}
    zeros, spans = [each.zero for each in one.levels], [one.sign * each.span for each in one.levels]
    if len(one.parts) == 1:
        return one.parts[0].source(unit="1", zero=zeros[0], span=spans[0], **keys)
    source: dict[str, Any] = {"name": [each.name for each in one.parts]}
    if any(each.field not in (None, "data") for each in one.parts):
        source["field"] = [each.field or "data" for each in one.parts]
    kinds = [each.kind for each in one.levels]
    source |= {
        "unit": kinds if "N·m" in kinds else "1",
        "zero": zeros[0] if len(set(zeros)) == 1 else zeros,
        "span": spans[0] if len(set(spans)) == 1 else spans,
    }
    if one.weights:
        source["weight"] = list(one.weights)
    return source | keys
