"""Asks the vehicle for the messages that are needed, by MAV_CMD_SET_MESSAGE_INTERVAL, until they come often enough.

A request may be lost, a reboot forgets it, and a ground station may change the rate. What counts is what arrives: a
message that comes at less than half of the rate is asked for again, at first after 3 s, then ever less often.
"""

from __future__ import annotations

from dataclasses import dataclass

LEAST, MOST = 3.0, 60.0  # s between two requests for a message


@dataclass
class _Wish:
    """One message."""

    count: int = 0  # that have arrived since the last request
    asked: float = float("nan")  # when it was asked for
    wait: float = LEAST  # until the next look


class Intervals:
    """The rates of the messages of the autopilot.

    Args:
        hz: wanted rate of each message.

    >>> intervals = Intervals(10.0)
    >>> intervals.wish(30), intervals.due(0.0), intervals.due(1.0)
    (None, [30], [])
    >>> intervals.due(3.5), intervals.due(7.0), intervals.due(9.6)  # none has arrived
    ([30], [], [30])
    """

    def __init__(self, hz: float):
        self.hz = hz
        self._wishes: dict[int, _Wish] = {}

    @property
    def micros(self) -> float:
        """The interval, us."""
        return 1e6 / self.hz

    def wish(self, number: int) -> None:
        """From now on, ask for this message."""
        self._wishes.setdefault(number, _Wish())

    def arrived(self, number: int) -> None:
        """A message has come."""
        if (wish := self._wishes.get(number)) is not None:
            wish.count += 1

    def again(self) -> None:
        """The vehicle has booted: ask for all of them at once."""
        self._wishes = {number: _Wish() for number in self._wishes}

    def due(self, now: float) -> list[int]:
        """The messages to ask for now; `now` in s of a steady clock."""
        found = []
        for number, wish in self._wishes.items():
            age = now - wish.asked
            if age < wish.wait:
                continue
            if wish.count >= 0.5 * self.hz * age:
                wish.count, wish.asked, wish.wait = 0, now, LEAST  # it comes: look again later
                continue
            wish.wait = LEAST if age != age else min(2 * wish.wait, MOST)
            wish.count, wish.asked = 0, now
            found.append(number)
        return found
