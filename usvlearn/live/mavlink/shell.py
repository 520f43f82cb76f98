"""The node on a vehicle that speaks MAVLink, such as one with ArduPilot: `usvlearn live mavlink udpin:HOST:PORT`."""

from __future__ import annotations

import threading
import time
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence

from usvlearn.errors import ConfigError
from usvlearn.live.mavlink.links import Link, Place, parse_peer, parse_place
from usvlearn.live.mavlink.messages import CHANNELS, load_dialect
from usvlearn.live.mavlink.vehicle import Vehicle
from usvlearn.live.session import Session
from usvlearn.live.start import Middleware, options_of, until_signal
from usvlearn.live.start import add_arguments as add_common_arguments
from usvlearn.live.status import StatusLine

MIDDLEWARE = Middleware("mavlink", "usvlearn.logs.formats.ardupilot.tlog.Tlog", CHANNELS)
TICK = 1.0  # s
BATCH = 64  # datagrams that are handled before anything else is done
PER_STEP = 4  # messages of each kind that are asked for in a step


def add_arguments(parser: ArgumentParser) -> None:
    """The options of `usvlearn live mavlink` that other middlewares do not have."""
    parser.add_argument("connection", help="udpin:HOST:PORT, udpout:HOST:PORT, or a serial port as DEVICE,BAUD")
    parser.add_argument("--system", type=int, help="system id of the vehicle (default: the first that is heard)")
    parser.add_argument("--peer", metavar="HOST[:PORT]", help="by UDP: take only what this sender sends")
    parser.add_argument("--rate", type=float, help=f"messages of each kind a second (default: {PER_STEP} in a step)")


def main(arguments: Sequence[str]) -> int:
    """The command `usvlearn live mavlink`; returns the exit code."""
    parser = ArgumentParser("usvlearn live mavlink", description="A node beside an autopilot that speaks MAVLink.")
    add_arguments(parser)
    add_common_arguments(parser)
    given = parser.parse_args(arguments)
    place = check_arguments(given)
    line = StatusLine("usvlearn")
    with until_signal() as stopped, Session(options_of(given), MIDDLEWARE) as session:
        line.say(session.sentence)
        session.start()
        try:
            run(session, given, place, stopped, line)
        finally:
            line.close()
            line.say(session.close())
    return 0


def check_arguments(given: Namespace) -> Place:
    """The place of the connection."""
    load_dialect()
    if given.system is not None and not 1 <= given.system <= 255:
        raise ConfigError(f"--system: found {given.system}, expected an id of 1 to 255")
    if given.rate is not None and not 0.5 <= given.rate <= 200:
        raise ConfigError(f"--rate: found {given.rate:g}, expected 0.5 to 200 messages a second")
    place = parse_place(given.connection)
    if given.peer is not None:
        parse_peer(given.peer, place)
    return place


def run(
    session: Session,
    given: Namespace,
    place: Place,
    stopped: threading.Event,
    line: StatusLine,
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Listen to a vehicle until `stopped` is set; the session has been started."""
    rate = given.rate or PER_STEP / float(session.setup.align["dt"])
    vehicle = Vehicle(session, load_dialect(), rate, given.system, say=line.say)
    peer = None if given.peer is None else parse_peer(given.peer, place)
    link, due = Link(place, line.say, peer), clock()
    try:
        while not stopped.is_set():
            now = clock()
            if link.open(now):
                vehicle.frames.clear()
            link.wait(due - now)
            _listen(link, vehicle, clock)
            if (now := clock()) >= due:
                line.show(vehicle.tick(now), session.last, vehicle.condition(now), warn=False)
                due = max(due + TICK, now)
            link.write(vehicle.telemetry.queue, now)
    finally:
        link.close()


def _listen(link: Link, vehicle: Vehicle, clock: Callable[[], float]) -> None:
    """Handle and answer what has arrived."""
    for _ in range(BATCH):
        now = clock()
        if not (data := link.read(now)):
            return
        if vehicle.receive(data, now, link.whole, link.sender):
            link.answer()
        link.write(vehicle.telemetry.queue, now)
