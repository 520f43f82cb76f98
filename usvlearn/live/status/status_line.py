"""The line in the terminal that tells how a node is doing; where the output is a file, only changes are written."""

from __future__ import annotations

import math
import re
import shutil
import sys
from typing import TextIO

from usvlearn.errors import printable
from usvlearn.live.health import Health, seconds
from usvlearn.live.node import Step

DURATION = re.compile(r" for \d[\d.]* \w+")
NAMES = re.compile(r" \([^()]*\)")  # of channels, in the middleware


class StatusLine:
    """Writes sentences, and below them one line that is replaced each second.

    Args:
        name: of the node, which begins each sentence.
        stream: standard output by default.

    >>> from usvlearn.live.health import COMPILING
    >>> line = StatusLine("pUSVLearn", sys.stdout)
    >>> line.say("starting")
    pUSVLearn: starting
    >>> line.show(COMPILING)
    pUSVLearn: preparing compiled code, for minutes at the first start
    >>> line.show(COMPILING)
    """

    def __init__(self, name: str, stream: TextIO | None = None):
        self._name, self._stream = name, sys.stdout if stream is None else stream
        self._terminal = self._stream.isatty()
        self._shown, self._told = 0, ""  # columns of the line; the last state
        self._warned: set[str] = set()

    def say(self, sentence: str) -> None:
        """Write a sentence that stays."""
        self._write(f"{self._erased()}{self._name}: {printable(sentence)}\n")
        self._shown = 0

    def show(self, health: Health, step: Step | None = None, link: str = "", warn: bool = True) -> None:
        """Replace the line; without a terminal, write a sentence if the state has changed. Say warnings and notes once.

        Args:
            health: of the node.
            step: the last one.
            link: what is wrong with the connection; empty if nothing is.
            warn: whether to say the warnings.
        """
        for warning in health.warnings if warn else ():
            if warning not in self._warned:
                self.say(f"warning: {warning}")
        for note in health.notes:
            if note not in self._warned:
                self.say(f"note: {note}")
        self._warned = {*health.warnings, *health.notes}
        if self._terminal:
            columns = shutil.get_terminal_size().columns - 1
            text = printable(line(health, step, link))[:columns]
            self._write(f"{self._erased()}{text}")
            self._shown = len(text)
            return
        missing = DURATION.sub("", health.sentence.partition(";")[0])  # durations change
        told = f"{missing}{'; ' if link else ''}{link}"
        if told != self._told:
            self._told = told
            self.say(told)

    def close(self) -> None:
        """End the line."""
        if self._shown:
            self._write("\n")
            self._shown = 0

    def _erased(self) -> str:
        return f"\r{' ' * self._shown}\r" if self._shown else ""

    def _write(self, text: str) -> None:
        try:
            self._stream.write(text)
            self._stream.flush()
        except (OSError, ValueError):  # nobody reads it any more; the node goes on
            pass


def line(health: Health, step: Step | None = None, link: str = "") -> str:
    """The line.

    >>> from usvlearn.live.health import COMPILING
    >>> line(COMPILING, link="no MOOSDB at localhost:9000")
    'no MOOSDB at localhost:9000 | preparing compiled code, for minutes at the first start | not saved yet'
    """
    state = NAMES.sub("", health.sentence.partition(";")[0]) if health.state != "ok" else f"ok, {health.steps} steps"
    parts = [link, state] if link else [state]
    if step is not None and health.state == "ok":
        parts.append(_speeds(step))
    if health.alarm:
        parts.append(f"ALARM {health.alarm} thruster")
    rejected = sum(count for causes in health.counts.values() for count in causes.values())
    if rejected:
        parts.append(f"{rejected} not used")
    if health.warnings:
        parts.append(f"{len(health.warnings)} warning{'s' * (len(health.warnings) > 1)}")
    parts.append(f"saved {seconds(health.saved)} ago" if math.isfinite(health.saved) else "not saved yet")
    return " | ".join(parts)


def _speeds(step: Step) -> str:
    measured = f"{step.measured:.2f}" if math.isfinite(step.measured) else "unknown"
    width = f" +- {step.high - step.speed:.2f}" if math.isfinite(step.high) else ""
    predicted = f"{step.speed:.2f}{width}" if math.isfinite(step.speed) else "none"
    after = f", next {step.next:.2f}" if math.isfinite(step.next) else ""
    return f"speed {measured}, predicted {predicted}{after} m/s"
