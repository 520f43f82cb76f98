"""Alarms of a node's thrusters, as people see and answer them.

A person answers with a file in the node's folder, on every middleware: `touch FOLDER/acknowledge_alarm` or
`touch FOLDER/reset_alarm`. The node removes it. A middleware has a way of its own, too, by which `ask` is called.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from usvlearn.live.health import seconds

if TYPE_CHECKING:
    from usvlearn.live.node import Node

ACKNOWLEDGE, RESET = "acknowledge", "reset"
FILE = "{}_alarm"  # in the folder, for either


class Alarms:
    """Takes the answers; an acknowledged alarm stays on, after a reset the evidence counts from then."""

    def __init__(self, folder: Path):
        self._folder, self._acknowledged = folder, False
        self._asked: set[str] = set()  # since the last second

    def ask(self, answer: str) -> bool:
        """Take an answer; returns whether it is one."""
        known = {answer.strip().lower()} & {ACKNOWLEDGE, RESET}
        self._asked |= known
        return bool(known)

    def obey(self, node: Node) -> None:
        """Do what was asked for, here or by files in the folder, and remove them."""
        for answer in (ACKNOWLEDGE, RESET):
            path = self._folder / FILE.format(answer)
            if not path.is_file() and answer not in self._asked:
                continue
            with suppress(OSError):  # the folder cannot be written: it is asked again in a second
                path.unlink(missing_ok=True)
            self._acknowledged = answer == ACKNOWLEDGE
            if answer == RESET:
                node.reset_alarm()
        self._asked.clear()

    def sentence(self, node: Node) -> str:
        """What is known of a loss of thrust now, since when, and whether the filters know; "" without one."""
        self._acknowledged &= node.loss is not None
        if node.loss is None:
            return ""
        since = f", since {seconds(node.last - node.loss.time)}"
        untold = "" if node.loss.filters else "; no filter has got this yet"
        return f"{node.loss.sentence}{untold}{since}{', acknowledged' if self._acknowledged else ''}"
