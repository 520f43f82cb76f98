"""The node on a vehicle that speaks MAVLink, such as one with ArduPilot: `usvlearn live mavlink udpin:HOST:PORT`."""

from __future__ import annotations

import signal
import threading
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from usvlearn.errors import ConfigError
from usvlearn.live.mavlink.frames import load_dialect
from usvlearn.live.mavlink.links import Link, Place, parse_place
from usvlearn.live.mavlink.vehicle import Vehicle

if TYPE_CHECKING:
    from usvlearn.live.session import Session

TICK = 1.0  # s
BATCH = 64  # datagrams that are handled before anything else is done
PER_STEP = 4  # messages of each kind that are asked for in a step


def add_arguments(parser: ArgumentParser) -> None:
    """The options of `usvlearn live mavlink`."""
    parser.add_argument("connection", help="udpin:HOST:PORT, udpout:HOST:PORT, or a serial port as DEVICE,BAUD")
    parser.add_argument("--system", type=int, help="system id of the vehicle (default: the first that is heard)")
    parser.add_argument("--rate", type=float, help=f"messages of each kind a second (default: {PER_STEP} in a step)")


def check_arguments(given: Namespace) -> Place:
    """The place of the connection.

    Raises:
        ConfigError: an option outside its range.
        MissingExtraError: pymavlink is not installed.
    """
    load_dialect()
    if given.system is not None and not 1 <= given.system <= 255:
        raise ConfigError(f"--system: found {given.system}, expected an id of 1 to 255")
    if given.rate is not None and not 0.5 <= given.rate <= 200:
        raise ConfigError(f"--rate: found {given.rate:g}, expected 0.5 to 200 messages a second")
    return parse_place(given.connection)


def run(
    session: Session, given: Namespace, show: Callable | None = None, clock: Callable[[], float] = time.monotonic
) -> int:
    """Listen to a vehicle until SIGTERM or SIGINT, then save; returns the exit code.

    Args:
        session: what learns; it is started and closed here.
        given: of `add_arguments`.
        show: takes the session's health each second.
        clock: a steady clock, s.
    """
    place = check_arguments(given)
    vehicle = Vehicle(
        session,
        load_dialect(),
        given.rate or PER_STEP / float(session.setup.align.get("dt", 0.4)),
        given.system,
        say=_say,
    )
    link = Link(place, say=_say)
    session.start()
    try:
        with _until_signal() as stopped:
            due = clock()
            while not stopped.is_set():
                now = clock()
                if link.open(now):
                    vehicle.new_link()
                link.wait(due - now)
                _read(link, vehicle, clock)
                if (now := clock()) >= due:
                    health = vehicle.tick(now)
                    due = max(due + TICK, now)
                    if show is not None:
                        show(health)
                link.write(vehicle.telemetry.queue, now)
    finally:
        link.close()
        session.close()
    return 0


def _read(link: Link, vehicle: Vehicle, clock: Callable[[], float]) -> None:
    for _ in range(BATCH):
        now = clock()
        if not (data := link.read(now)):
            return
        if vehicle.receive(data, now, link.whole):
            link.answer()


def _say(sentence: str) -> None:
    print(sentence, flush=True)


@contextmanager
def _until_signal() -> Iterator[threading.Event]:
    """An event that SIGTERM and SIGINT set; the handlers before are put back."""
    stopped = threading.Event()
    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, lambda *_: stopped.set())
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
