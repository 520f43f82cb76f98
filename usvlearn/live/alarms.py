"""Alarms of a node's thrusters, as people see and answer them.

A person answers with a file in the node's folder, on every middleware: `touch FOLDER/acknowledge_alarm` or
`touch FOLDER/reset_alarm`. The node removes it.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from usvlearn.live.health import seconds

if TYPE_CHECKING:
    from usvlearn.live.node import Node

ACKNOWLEDGE, RESET = "acknowledge_alarm", "reset_alarm"


class Alarms:
    """Takes the answers; an acknowledged alarm stays on, after a reset the evidence counts from then."""

    def __init__(self, folder: Path):
        self._folder, self._acknowledged = folder, False

    def obey(self, node: Node) -> None:
        """Do what the files in the folder ask for, and remove them."""
        for name in (ACKNOWLEDGE, RESET):
            if (path := self._folder / name).is_file():
                with suppress(OSError):  # the folder cannot be written: it is asked again in a second
                    path.unlink()
                self._acknowledged = name == ACKNOWLEDGE
                if name == RESET:
                    node.reset_alarm(everything=True)

    def sentence(self, node: Node) -> str:
        """What is known of a loss of thrust now, and since when; "" without one."""
        self._acknowledged &= node.loss is not None
        if node.loss is None:
            return ""
        known = ", acknowledged" if self._acknowledged else ""
        return f"{node.loss.sentence}, since {seconds(node.last - node.loss.time)}{known}"
