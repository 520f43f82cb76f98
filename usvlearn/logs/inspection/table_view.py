"""What `usvlearn inspect` prints: what was found, what to check, and what the data check and the readers say.

By default it takes at most `LINES` lines, with what the command adds: if decisions with their reasons need more,
there is one row for each channel, and what has no room then is counted. With `whole`, the series of logs come first.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import Console
from rich.text import Text

from usvlearn.core.unconfirmed import SECTION, confirmation
from usvlearn.display.terminal import Blocks
from usvlearn.errors import printable
from usvlearn.logs.channels.channel import COMMANDS, Recording
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.decision import PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.inspected import Inspected
from usvlearn.logs.inspection.logfiles import bytes_of

LINES, END = 45, 11  # on the screen; of them after these parts
PLAIN = ("series", "unit", "sign", "messages")  # what is told without its name


def show(inspected: Inspected, output: str, console: Console, whole: bool = False) -> None:
    """Print what was found, and the file that is written; if `whole`, everything, however long."""
    log, asked = Text(" ".join(_logs(inspected))), list(_asked(inspected, output))
    said = [Text(f"Data check, {each.severity}: {printable(each.sentence())}") for each in inspected.findings]
    said += [Text(f"Note: {printable(note)}") for note in inspected.notes]
    parts: list[Text | Blocks] = [log, Text(), _decisions(inspected, whole), *asked, *said]
    if whole:
        parts.insert(2, _series(inspected.series))
    elif _height(parts, console) > (room := LINES - END - bool(said)):
        for reasons in range(len(asked), -2, -1):
            parts = [log, Text(), _channels(inspected), *_asked(inspected, output, reasons)]
            if (left := room - _height(parts, console)) >= bool(said):
                break
        for number, each in enumerate(said):
            left -= _height([each], console)
            if left < (number < len(said) - 1):  # a line must be left to count the rest
                parts.append(Text(f"{len(said) - number} more of the data check and the readers: add --all"))
                break
            parts.append(each)
    for part in [*parts, *[Text()] * bool(said)]:
        console.print(part)


def _height(parts: Sequence[Text | Blocks], console: Console) -> int:
    return sum(len(console.render_lines(each)) for each in parts)


def hours(recordings: Sequence[Recording]) -> float:
    """The length of recordings, all together, h."""
    spans = [np.ptp(one.channels["heading"].time) for one in recordings if len(one.channels["heading"].time)]
    return float(sum(spans)) / 3600


def _logs(inspected: Inspected) -> Iterator[str]:
    logs, count = inspected.logs, len(inspected.logs.files)
    size = sum(map(bytes_of, logs.files)) / 1e6
    spans = [max((float(np.nanmax(one.time, initial=0)) for one in each), default=0) for each in logs.surveyed]
    yield f"{count} log{'s' * (count > 1)} of {logs.format.name}, {size:.1f} MB, {sum(spans) / 3600:.2f} h."
    if logs.joined:
        yield logs.joined
    options = {field.name: getattr(logs.reader, field.name) for field in dataclasses.fields(logs.reader)}
    sentence = ", ".join(f"{key.replace('_', ' ')} {value!r}" for key, value in options.items() if value != "auto")
    if sentence:
        yield f"Reader: {printable(sentence)}."


def _series(series: Sequence[Candidate]) -> Blocks:
    numbers = ["count", "1/s", "least", "greatest", "gaps", "repeats"]
    table = Blocks(f"What is in it: {len(series)} series of numbers", ["series", "unit"], numbers, ["series"])
    for each in sorted(series, key=lambda each: not each.varies):
        low, high = each.extent
        rate = 1 / each.interval if each.interval > 0 else math.nan
        table.add(
            printable(each.label), each.unit or "–", f"{len(each.value)}", _short(rate), _short(low, low, high),
            _short(high, low, high), f"{each.gaps}", f"{each.repeats:.0%}",
        )  # fmt: skip
    return table


def _decisions(result: Inspected, whole: bool) -> Blocks:
    title = "What it means" if whole else f"What was found in {len(result.series)} series of numbers; --all lists them"
    table = Blocks(title, ["channel", "found", "how sure", "why"], [], ["channel", "found", "why"])
    reason = channel = ""
    for each in _merged(result.decisions):
        why = printable(each.reason) if each.reason != reason else "″"
        reason = each.reason
        below = f"  {each.what}" if each.channel in (channel, "both commands") else f"{each.channel} {each.what}"
        name, channel = each.channel if each.what == "series" else below, each.channel
        table.add(name, printable(each.value), _sure(each.certainty), why)
    return table


def _channels(inspected: Inspected) -> Blocks:
    """One row for each channel: its series, then what else was decided, and the least of what is how sure."""
    series = f"{len(inspected.series)} series of numbers; --all lists them, and says why"
    table = Blocks(f"What was found in {series}", ["channel", "found", "how sure"], [], ["found"])
    rows: dict[str, list[Decision]] = {}
    for each in _merged(inspected.decisions):
        rows.setdefault(each.channel, []).append(each)
    for channel, decisions in rows.items():
        words = ((each.what.removesuffix(" of both"), each.value) for each in decisions)
        text = ", ".join(value if what in PLAIN else f"{what} {value}" for what, value in words)
        table.add(channel, printable(text), _sure(least(*(each.certainty for each in decisions))))
    return table


def _sure(certainty: str) -> Text:
    return Text(certainty, "bold yellow" if certainty == UNSURE else "")


def _merged(decisions: Sequence[Decision]) -> list[Decision]:
    """Decisions that say the same of both sides as one, which stands below the series of both."""
    left = {each.what: each for each in decisions if each.channel == COMMANDS[0]}
    right = {each.what: each for each in decisions if each.channel == COMMANDS[1]}
    same = [what for what in left if what != "series" and what in right and left[what][2:4] == right[what][2:4]]
    both = [left[what]._replace(channel="both commands") for what in same]
    sides = [each for each in decisions if each.channel in COMMANDS and each.what not in same]
    rest = [each for each in decisions if each.channel not in COMMANDS]
    return [*sides, *(each._replace(what=f"{each.what} of both") for each in both), *rest]


def _asked(inspected: Inspected, output: str, reasons: int = 1000) -> Iterator[Text]:
    """The open questions, unsure ones with what they may be, so many with why; below 0, not even in a line each."""
    if asked := inspected.settings.get(SECTION):
        yield Text(f"Please check ({len(asked)}). If wrong, correct {output}; if right: {confirmation(output)}", "bold")
        by_certainty: dict[str, list[str]] = {UNSURE: [], PROBABLE: []}
        for number, (key, each) in enumerate(asked.items()):
            if each["certainty"] == UNSURE and reasons >= 0:
                yield Text(f"  {key}: {each['found']}" + (f" ({each['why']})" if number < reasons else ""))
            else:
                by_certainty[each["certainty"]].append(f"{key} {each['found']}")
        yield from (Text(f"  {sure}: {'; '.join(words)}") for sure, words in by_certainty.items() if words)
        yield Text()


def _short(value: float, low: float = 0.0, high: float = 0.0) -> str:
    """Four digits, or as many as tell two values apart."""
    if not math.isfinite(value):
        return "–"
    digits = next((k for k in range(4, 10) if low == high or f"{low:.{k}g}" != f"{high:.{k}g}"), 4)
    digits += 1 if digits > 4 else 0
    return f"{value:.{digits}g}" if abs(value) < 1e5 else f"{value:.3e}"
