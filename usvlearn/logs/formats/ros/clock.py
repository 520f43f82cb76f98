"""The time of a bag: that of the recorder, or a simulated one, which runs at another rate.

The recorder stamps each message at its receipt. Headers or /clock with another rate hold the time of a simulation. Then
all receipts are mapped to it, so that messages with and without a header are in one time.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable
from typing import Any

import numpy as np

from usvlearn.logs.formats.ros.message_fields import CLOCK_LIMIT

CLOCK = "rosgraph_msgs/msg/Clock"
LIMIT = CLOCK_LIMIT * 1e9  # ns
RATES = 0.01, 100.0  # of a simulation; a stamp beyond them is a counter, or stands still
SAME = 0.02  # a rate so near 1, without /clock, is that of a clock that was never set
FEWEST, FORWARD = 10, 0.95  # stamps of a clock, and the share of them that are not before the last one
FAR = 1e6  # s before the first and after the last stamp, in which a clock goes on at its mean rate


def has_stamp(bag: Any, msgtype: str) -> bool:
    """Whether messages of a type begin with a header, or are of /clock."""
    fields = bag.typestore.fielddefs.get(msgtype, ("", ()))[1]
    return msgtype == CLOCK or any(name == "header" for name, _ in fields[:1])


class Heard:
    """When the messages of a topic of a bag were received and stamped."""

    def __init__(self, bag: Any, topic: str, msgtype: str):
        self.topic, self.is_clock, self._is2 = topic, msgtype == CLOCK, bag.is2
        place = 0 if self.is_clock and not bag.is2 else 4  # after the encoding, or the number, of a header
        self._place = place if has_stamp(bag, msgtype) else None
        self.order, self._received, self._stamps = array("q"), array("q"), array("q")

    def add(self, order: int, received: int, data: bytes) -> None:
        """Take a message: its number in the bag, the time of its receipt in ns, and its bytes."""
        stamp = 0  # none
        if self._place is not None and len(data) >= self._place + 8:
            seconds, rest = struct.unpack_from("<II" if data[1] & 1 or not self._is2 else ">II", data, self._place)
            stamp = seconds * 10**9 + rest
        self.order.append(order)
        self._received.append(received)
        self._stamps.append(stamp)

    def times(self) -> tuple[np.ndarray, np.ndarray]:
        """Receipts and stamps of all messages, ns; 0 for no stamp."""
        return np.array(self._received, np.int64), np.array(self._stamps, np.int64)

    def seconds(self, start: int, clock: Clock | None, receive: bool) -> np.ndarray:
        """The times of all messages, s since the start of the bag in ns, by the rules of `Rosbag.clock`."""
        received, stamps = self.times()
        if clock is None:
            by_header = (stamps > 0) & (np.abs(stamps - received) <= LIMIT) & (not receive)
            return (np.where(by_header, stamps, received) - start) * 1e-9
        own, mapped = (stamps - clock.zero) * 1e-9, clock.at(received)
        return np.where((stamps > 0) & (np.abs(own - mapped) <= clock.limit), own, mapped) - clock.at(start)


class Clock:
    """The clock of a topic's stamps, as a function of the time of receipt."""

    def __init__(self, heard: Heard, received: np.ndarray, stamps: np.ndarray):
        self.heard, self.count, self.zero, self._start = heard, len(stamps), stamps[0], received[0]
        apart = max(1, self.count // 10)
        steps, spans = stamps[apart:] - stamps[:-apart], received[apart:] - received[:-apart]
        self.rate = float(np.median(steps / np.maximum(spans, 1))) if self.count >= FEWEST else 0.0
        self.limit = CLOCK_LIMIT * max(1.0, self.rate)  # s that a stamp may be from the clock
        self.goes = RATES[0] < self.rate < RATES[1] and (np.diff(stamps) >= 0).mean() >= FORWARD
        if not heard.is_clock:  # whole seconds may be a counter
            self.goes = self.goes and abs(self.rate - 1) > SAME and (stamps % 10**9).any()
        x, y = (received - self._start) * 1e-9, (stamps - self.zero) * 1e-9
        self._receipts = np.concatenate([[x[0] - FAR], x, [x[-1] + FAR]])
        self._stamps = np.concatenate([[y[0] - FAR * self.rate], y, [y[-1] + FAR * self.rate]])

    def at(self, received: Any) -> np.ndarray:
        """Its time at receipts in ns, s since `zero`."""
        return np.interp((received - self._start) * 1e-9, self._receipts, self._stamps)


def find_clock(heard: Iterable[Heard]) -> tuple[Clock | None, str]:
    """The simulated clock of a bag, or None, and a sentence about stamps of another rate, or "".

    /clock tells that the time is simulated, or most topics with a stamp do.
    """
    times = [(each, *each.times()) for each in heard]
    known = [(each, received[stamps > 0], stamps[stamps > 0]) for each, received, stamps in times if stamps.any()]
    far = [each for each in known if np.median(np.abs(each[2] - each[1])) > LIMIT]
    votes = {}
    for clock in (Clock(*each) for each in far):
        off = [np.median(np.abs((stamps - clock.zero) * 1e-9 - clock.at(received))) for _, received, stamps in far]
        votes[clock] = clock.heard.is_clock, sum(each <= clock.limit for each in off), clock.count
    best = max((clock for clock in votes if clock.goes), key=lambda clock: votes[clock], default=None)
    if best is None:
        return None, ""
    told = f"the stamps of {best.heard.topic} advance by {best.rate:.3g} s in each second of receipt"
    if not best.heard.is_clock and votes[best][1] <= len(known) - len(far):
        return None, f"{told}, but those of most topics by 1 s: its messages have the time of receipt"
    told += ", as simulated time does: all times and rates are in simulated time. If this is no simulation, set "
    return best, f"{told}data.reader.clock=receive"
