"""What `usvlearn inspect` prints: what is in the logs, what was decided, and what is unsure."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from rich.text import Text

from usvlearn.display.terminal import Blocks
from usvlearn.errors import printable
from usvlearn.logs.channels.channel import COMMANDS, Recording
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision
from usvlearn.logs.inspection.inspected import Inspected
from usvlearn.logs.inspection.logfiles import bytes_of
from usvlearn.logs.inspection.written import MASS

STYLES = {CERTAIN: "green", PROBABLE: "", UNSURE: "bold yellow"}
NOTED = 6  # notes of readers


def parts(found: Inspected, listed: int) -> Iterator[Text | Blocks]:
    """The parts of the screen, in order.

    Args:
        found: by `inspect_logs`.
        listed: series that are listed at most.
    """
    yield Text(" ".join(_logs(found)))
    yield Text()
    yield _series(found.series, listed)
    yield _decisions(found)
    yield from _unsure(found)
    for each in found.findings:
        yield Text(f"Data check, {each.severity}: {printable(each.sentence())}")
    for note in found.notes[:NOTED]:
        yield Text(f"Note: {printable(note)}")
    if len(found.notes) > NOTED:
        yield Text(f"Note: and {len(found.notes) - NOTED} more.")
    yield Text()


def hours(recordings: Sequence[Recording]) -> float:
    """The length of recordings, all together, h."""
    spans = [np.ptp(one.channels["heading"].time) for one in recordings if len(one.channels["heading"].time)]
    return float(sum(spans)) / 3600


def _logs(found: Inspected) -> Iterator[str]:
    logs, count = found.logs, len(found.logs.files)
    size = sum(map(bytes_of, logs.files)) / 1e6
    spans = [max((float(np.nanmax(one.time, initial=0)) for one in each), default=0) for each in logs.surveyed]
    yield f"{count} log{'s' * (count > 1)} of {logs.format.name}, {size:.1f} MB, {sum(spans) / 3600:.2f} h."
    if logs.joined:
        yield logs.joined
    options = {field.name: getattr(logs.reader, field.name) for field in dataclasses.fields(logs.reader)}
    sentence = ", ".join(f"{key.replace('_', ' ')} {value!r}" for key, value in options.items() if value != "auto")
    if sentence:
        yield f"Reader: {printable(sentence)}."


def _series(series: Sequence[Candidate], listed: int) -> Blocks:
    shown = sorted(series, key=lambda each: not each.varies)[:listed]
    more = f" ({len(series) - listed} more are not shown)" if len(series) > listed else ""
    table = Blocks(
        f"What is in it: {len(series)} series of numbers{more}",
        ["series", "unit"],
        ["count", "1/s", "least", "greatest", "gaps", "repeats"],
        ["series"],
    )
    for each in shown:
        low, high = each.extent
        rate = 1 / each.interval if each.interval > 0 else math.nan
        table.add(
            printable(each.label),
            each.unit or "–",
            f"{len(each.value)}",
            _short(rate),
            _short(low, low, high),
            _short(high, low, high),
            f"{each.gaps}",
            f"{each.repeats:.0%}",
        )
    return table


def _decisions(found: Inspected) -> Blocks:
    table = Blocks("What it means", ["channel", "found", "how sure", "why"], [], ["channel", "found", "why"])
    reason = channel = ""
    for each in _merged(found.decisions):
        why = printable(each.reason) if each.reason != reason else "″"
        reason = each.reason
        below = f"  {each.what}" if each.channel in (channel, "both commands") else f"{each.channel} {each.what}"
        name, channel = each.channel if each.what == "series" else below, each.channel
        value = Text(each.certainty, STYLES[each.certainty])
        table.add(name, printable(each.value), value, why)
    return table


def _merged(decisions: Sequence[Decision]) -> list[Decision]:
    """Decisions that say the same of both sides as one, which stands below the series of both."""
    left = {each.what: each for each in decisions if each.channel == COMMANDS[0]}
    right = {each.what: each for each in decisions if each.channel == COMMANDS[1]}
    same = [what for what in left if what != "series" and what in right and left[what][2:4] == right[what][2:4]]
    both = [left[what]._replace(channel="both commands") for what in same]
    sides = [each for each in decisions if each.channel in COMMANDS and each.what not in same]
    rest = [each for each in decisions if each.channel not in COMMANDS]
    return [*sides, *(each._replace(what=f"{each.what} of both") for each in both), *rest]


def _unsure(found: Inspected) -> Iterator[Text]:
    unsure = _merged([each for each in found.decisions if each.certainty == UNSURE])
    mass = f"vehicle mass: {MASS:g} kg: not in the logs; the parameters scale with it"
    yield Text(f"Please check ({len(unsure) + 1}):", "bold")
    for each in unsure:
        others = f"; or {', '.join(each.alternatives)}" if each.alternatives else ""
        yield Text(printable(f"  {each.channel} {each.what.removesuffix(' of both')}: {each.value}{others}"))
    yield Text(f"  {mass}")
    yield Text()


def _short(value: float, low: float = 0.0, high: float = 0.0) -> str:
    """Four digits, or as many as tell two values apart.

    >>> _short(0.12345), _short(48.512345), _short(48.512345, 48.512, 48.513), _short(float("nan"))
    ('0.1235', '48.51', '48.5123', '–')
    """
    if not math.isfinite(value):
        return "–"
    digits = next((k for k in range(4, 10) if low == high or f"{low:.{k}g}" != f"{high:.{k}g}"), 4)
    digits += 1 if digits > 4 else 0
    return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.3e}"
