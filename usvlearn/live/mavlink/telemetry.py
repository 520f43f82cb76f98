"""What the vehicle and its ground stations are told: NAMED_VALUE_FLOAT, STATUSTEXT, heart-beats, requests.

Frames wait in a bounded queue until the link takes them. Numbers and texts are left out while no vehicle is heard.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any

from usvlearn.live.status.publications import TABLE, Post, of_health, of_step

if TYPE_CHECKING:
    from usvlearn.live.health import Health
    from usvlearn.live.node import Step

COMPONENT = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
ROOM = 256  # frames in the queue; the oldest gives way
TEXT, PARTS = 50, 4  # characters of one STATUSTEXT, and how many may make one text
BURST, PACE, AGAIN = 5, 2.0, 60.0  # texts at once; s for one more; s before the same text
LARGEST = 3.4e38  # of a 32-bit float
WRAP = 1 << 32  # ms
SET_INTERVAL = 511  # MAV_CMD_SET_MESSAGE_INTERVAL
ONBOARD_CONTROLLER, INVALID, ACTIVE = 18, 8, 4  # type, autopilot and state in our heart-beat
SHORT = {each.name: each.short.encode() for each in TABLE if each.short}  # names of at most 10 characters
WARNING, INFO = 4, 6  # severities


class Telemetry:
    """Makes the frames that are sent.

    Args:
        dialect: of `usvlearn.live.mavlink.frames.load_dialect`.
        system: our system id until that of the vehicle is known.

    Attributes:
        queue: frames to be sent, the oldest first.
        old: whether the vehicle speaks MAVLink 1.
        left_out: texts that came too fast.
    """

    def __init__(self, dialect: ModuleType, system: int = 1):
        self._dialect = dialect
        self._link = dialect.MAVLink(None, srcSystem=system, srcComponent=COMPONENT)
        self.queue: deque[bytes] = deque(maxlen=ROOM)
        self.old = False
        self.left_out = 0
        self._tokens, self._filled = float(BURST), -math.inf
        self._said: dict[str, float] = {}  # text -> when it was said last
        self._text = 0  # number of the last text in parts

    @property
    def system(self) -> int:
        return self._link.srcSystem

    @system.setter
    def system(self, number: int) -> None:
        self._link.srcSystem = number

    def _send(self, message: Any) -> None:
        self.queue.append(bytes(message.pack(self._link, force_mavlink1=self.old)))
        self._link.seq = (self._link.seq + 1) % 256

    def heartbeat(self) -> None:
        """That this component is alive."""
        self._send(self._dialect.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, INVALID, 0, 0, ACTIVE, 3))

    def ask_interval(self, target: tuple[int, int], number: int, micros: float) -> None:
        """Ask a component for a message at an interval."""
        rest = (float(number), micros, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._send(self._dialect.MAVLink_command_long_message(*target, SET_INTERVAL, 0, *rest))

    def ask_parameter(self, target: tuple[int, int], name: str) -> None:
        """Ask a component for a parameter by its name."""
        self._send(self._dialect.MAVLink_param_request_read_message(*target, name.encode(), -1))

    def values(self, time: float, posts: Iterable[Post]) -> None:
        """Send the numbers among some posts, with a time of the vehicle, s; what no 32-bit float holds is left out."""
        millis = round(1000 * time) % WRAP if math.isfinite(time) else 0
        for name, value in posts:
            if (short := SHORT.get(name)) and not isinstance(value, str) and abs(value) < LARGEST:
                self._send(self._dialect.MAVLink_named_value_float_message(millis, short, value))

    def step(self, step: Step) -> None:
        """Send the numbers of a step."""
        self.values(step.time, of_step(step))

    def health(self, time: float, health: Health) -> None:
        """Send the numbers that change seldom, with a time of the vehicle, s."""
        self.values(time, of_health(health))

    def say(self, text: str, severity: int, now: float) -> bool:
        """Send a text, unless it or others were sent just before; returns whether it was sent."""
        elapsed = now - self._filled
        self._tokens = min(BURST, self._tokens + elapsed / PACE) if math.isfinite(elapsed) else BURST
        self._filled = now
        self._said = {said: when for said, when in self._said.items() if now - when < AGAIN}
        if self._tokens < 1 or text in self._said:
            self.left_out += 1
            return False
        self._tokens -= 1
        self._said[text] = now
        plain = text.encode("ascii", "replace")[: TEXT * (1 if self.old else PARTS)]
        pieces = [plain[k : k + TEXT] for k in range(0, len(plain), TEXT)]
        self._text = self._text % 0xFFFF + 1
        for k, piece in enumerate(pieces):
            number = self._text if len(pieces) > 1 else 0
            self._send(self._dialect.MAVLink_statustext_message(severity, piece, number, k if number else 0))
        if len(pieces) > 1 and len(pieces[-1]) == TEXT:  # a text in parts ends with a part that is not full
            self._send(self._dialect.MAVLink_statustext_message(severity, b"", self._text, len(pieces)))
        return True
