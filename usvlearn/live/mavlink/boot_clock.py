"""The vehicle's clock, which counts from its boot, as its messages tell it.

Stamps in `time_boot_ms` are taken as they are. A stamp that is implausible, because it is before the last one or ahead
of it by more than the time since, is held back until the next one agrees with it: then the vehicle has booted anew, or
its 32 bits began anew (after 49.7 days), or its clock was set. A single wrong stamp so changes nothing.

A message without a stamp has the time of its receipt, less the least delay of recent stamped messages. A stamp of
32 bits in us begins anew every 71.6 minutes; the turn that is meant is the one nearest to the receipt. These rules are
those of `usvlearn.logs.formats.ardupilot.tlog`, as far as they can be followed without knowing what comes later.
"""

from __future__ import annotations

import math

from usvlearn.logs.formats.ardupilot.tlog import CLOCK_LIMIT, WRAP

RECENT = 60.0  # s over which the least delay is taken: clocks drift apart


class BootClock:
    """Stamps of messages, s since the vehicle's boot. Receipts are in s of any steady clock.

    Attributes:
        last: the newest stamp, s; NaN before the first.
        boots: how often the clock went back.

    >>> clock = BootClock()
    >>> clock.stamp(60.0, 1000.0), clock.stamp(60.1, 1000.1), clock.of_receipt(1000.5)
    (60.0, 60.1, 60.5)
    >>> clock.stamp(3.0, 1000.2), clock.stamp(60.3, 1000.3), clock.boots  # one wrong stamp
    (None, 60.3, 0)
    >>> clock.stamp(3.0, 1030.0), clock.stamp(3.1, 1030.1), clock.boots  # a reboot
    (None, 3.1, 1)
    """

    def __init__(self) -> None:
        self.last, self.boots = math.nan, 0
        self._received = math.nan  # when the newest stamp was received
        self._doubted = math.nan  # a stamp that was held back
        self._least, self._before = math.inf, math.inf  # least delay of this period, and of the one before
        self._begun = -math.inf  # of this period

    def stamp(self, stamp: float, received: float) -> float | None:
        """A stamp in `time_boot_ms`, in s, if it can be used; None if it is held back."""
        if math.isnan(self.last):
            self.last = stamp
        ahead = max(self.last, self.last + received - self._received)
        if not self.last - CLOCK_LIMIT <= stamp <= ahead + CLOCK_LIMIT:
            agrees = abs(stamp - self._doubted) <= CLOCK_LIMIT
            self._doubted = stamp
            if not agrees:
                return None
            self.boots += stamp < self.last
            self.last, self._least, self._before = stamp, math.inf, math.inf
        self._doubted = math.nan
        if stamp >= self.last:
            self.last, self._received = stamp, received
        self._learn_delay(received - stamp, received)
        return stamp

    def _learn_delay(self, delay: float, received: float) -> None:
        if abs(delay - self._offset()) > CLOCK_LIMIT:
            self._least = self._before = math.inf
        if received - self._begun > RECENT:
            self._least, self._before, self._begun = math.inf, self._least, received
        self._least = min(self._least, delay)

    def _offset(self) -> float:
        return min(self._least, self._before)

    def of_receipt(self, received: float) -> float:
        """The vehicle's time of a receipt, s; NaN before the first stamp."""
        return received - self._offset() if math.isfinite(self._offset()) else math.nan

    def of_micros(self, micros: int, bits: int, received: float) -> float:
        """The vehicle's time of a stamp in us of 32 or 64 bits, or that of the receipt if they do not fit, s."""
        expected = self.of_receipt(received)
        stamp = 1e-6 * micros
        if bits == 32 and math.isfinite(expected):
            stamp += WRAP * round((expected - stamp) / WRAP)
        return stamp if abs(stamp - expected) <= CLOCK_LIMIT else expected

    def now(self, clock: float) -> float:
        """The vehicle's time now, by the newest stamp, s; NaN before the first."""
        return self.last + clock - self._received
