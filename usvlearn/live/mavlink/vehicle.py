"""Handles each message and each second, without I/O and clock: finds the vehicle, asks, pushes, answers.

The vehicle is the first autopilot that is heard, or the one of a given system id. Its servo outputs count only while
it is armed, as in a telemetry log that `usvlearn.logs.formats.ardupilot.tlog` reads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from fnmatch import fnmatchcase
from itertools import pairwise
from types import ModuleType
from typing import TYPE_CHECKING, Any

from usvlearn.core.events import LOSS
from usvlearn.live.mavlink.messages import (
    ANSWERS,
    ATTITUDE,
    COMMAND,
    COMPONENT,
    GLOBAL,
    HUD,
    INFO,
    NED,
    USER,
    V1,
    VELOCITIES,
    WARNING,
    Frames,
    Route,
    Telemetry,
    find_routes,
    instance_of,
    number_of,
    value_of,
    velocity_of,
)
from usvlearn.live.mavlink.requests import BootClock, Intervals, ServoParameters
from usvlearn.live.status import Post, alike, of_health, of_step
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES
from usvlearn.logs.formats.ardupilot.tlog import ARMED, GROUND_STATION, HEARTBEAT, NO_AUTOPILOT, PARAM_VALUE

if TYPE_CHECKING:
    from usvlearn.live.health import Health
    from usvlearn.live.node import Step
    from usvlearn.live.session import Session

SILENT = 5.0  # s without a heart-beat, after which no vehicle is there
SELDOM = 5  # ticks between two reports of what changes seldom
MOST_OTHERS = 100  # senders that are remembered
REPLACED = 10.0  # s without a message, after which another one gives its numbers
RANKS = (NED, GLOBAL, HUD)  # where the velocity comes from, the best first


class Vehicle:
    """Stands between a link and a session."""

    def __init__(
        self, session: Session, dialect: ModuleType, hz: float, system: int | None, say: Callable[[str], None]
    ):
        self._session, self._wanted, self._say = session, system, say
        self.frames, self.telemetry = Frames(dialect), Telemetry(dialect, system or 1)
        self._routes: dict[int, list[Route]] = {}
        routes = find_routes(session.sources)
        for route in routes:
            self._routes.setdefault(route.number, []).append(route)
        self._replaceable = [route for route in routes if route.replaceable]
        self._servos = ServoParameters([route.function for route in routes if route.function is not None])
        self._intervals = Intervals(hz)
        for number in self._routes:
            self._intervals.wish(number)
        self.address: tuple[int, int] | None = None  # of the vehicle: system and component
        self._sender, self._sent = "", -math.inf  # where its messages come from, and when the last one came
        self._heard_first: dict[str, float] = {}  # another place that sends as this vehicle -> when it did first
        self._others: set[int | str] = set()  # other vehicles, and others that send as this one
        self._clock, self._armed = BootClock(), False
        self._beat = -math.inf  # when the last heart-beat of the vehicle was received
        self._came = dict.fromkeys(RANKS, math.inf)  # when a velocity was received or first wished; inf: not wished
        self._source = NED  # from which message the velocity comes now
        self._instances: dict[int, int] = {}  # message -> the least number of equal senders
        self._heading = math.nan  # rad
        self._state, self._ticks = "", 0  # of the session's health; how many seconds have been reported
        self._sent_step = math.nan  # s, of the last step whose forecasts were sent
        self._told: set[str] = set()  # problems and warnings that last

    def is_connected(self, now: float) -> bool:
        """Whether the vehicle is heard; `now` in s of a steady clock."""
        return now - self._beat < SILENT

    def condition(self, now: float) -> str:
        """Why nothing is learned, as far as the vehicle is concerned; empty if it is heard and armed."""
        if self.address is None:
            return "no vehicle is heard" if self._wanted is None else f"system {self._wanted} is not heard"
        if not self.is_connected(now):
            return f"system {self.address[0]} is silent"
        return "" if self._armed else "disarmed"

    # ------------------------------------------------------------ receiving

    def receive(self, data: bytes, now: float, whole: bool = False, place: str = "") -> bool:
        """Take what a link has received, now in s of a steady clock; returns whether a frame of the vehicle was in it.

        `whole`: the data are a datagram; `place`: where they came from, if several can send.
        """
        heard = False
        for message in self.frames.take(data, whole):
            sender = message.get_srcSystem(), message.get_srcComponent()
            number = message.get_msgId()
            if sender == self.address and not self._is_from(place, now):
                self._session.drop("vehicle", "second_sender")
                continue
            if number == HEARTBEAT:
                self._hear_heartbeat(message, sender, now, place)
            if self.address is None:
                continue
            if sender == self.address:
                heard, self._sender, self._sent = True, place, now
            if number == COMMAND:
                self._obey(message)
            elif number == PARAM_VALUE and sender == self.address:
                self._servos.learn(message.param_id, message.param_value)
            elif number in MESSAGES and number != HEARTBEAT:
                self._take(message, number, sender, now)
        return heard

    def _obey(self, message: Any) -> None:
        """Take the answer to an alarm, from any sender, if the command is to this component."""
        if (message.target_system, message.target_component) == (self.telemetry.link.srcSystem, COMPONENT):
            known = message.command == USER and self._session.answer_alarm(ANSWERS.get(message.param1, ""))
            self.telemetry.acknowledge(message, known)

    def _is_from(self, place: str, now: float) -> bool:
        """Whether the vehicle itself sends from a place: two boats of one id must not be learned as one."""
        if place == self._sender:
            return True
        system, other = self.address or (0, 0), now - self._sent < SILENT
        waited = self._heard_first.setdefault(place, now) if len(self._heard_first) < MOST_OTHERS else now
        if other and self._sent <= waited:  # it may have booted, and send from another port now
            return False
        if other and place not in self._others and len(self._others) < MOST_OTHERS:
            self._others.add(place)
            self._announce(
                f"a second sender, {place}, sends as system {system[0]}, too: it is left out, and {self._sender} is "
                f"listened to; give the boats different ids, or choose by --peer {place}", WARNING, now
            )  # fmt: skip
        elif not other:
            self._others.discard(place)
            self._heard_first.clear()
            self._announce(f"system {system[0]} is heard from {place} now, no longer {self._sender}", WARNING, now)
            self._sender = place
        return not other

    def _hear_heartbeat(self, message: Any, sender: tuple[int, int], now: float, place: str) -> None:
        if message.autopilot == NO_AUTOPILOT or message.type == GROUND_STATION:
            return
        system = sender[0]
        if self.address is None and system == (self._wanted or system):
            self.address, self._came[NED], self._beat = sender, now, now
            self.telemetry.link.srcSystem = system
            where = f", from {place}" if place else ""
            self._announce(f"listening to system {system}, component {sender[1]}{where}", INFO, now)
        if sender == self.address:
            if not self.is_connected(now):
                self._ask_again()  # it may have booted
            self._beat, self._armed = now, bool(message.base_mode & ARMED)
            self.telemetry.old = message.get_msgbuf()[0] == V1
        elif self.address is not None and system != self.address[0] and system not in self._others:
            self._others.add(system)
            choice = f"listening to system {self.address[0]} only; --system {system} would choose the other"
            self._announce(f"a second vehicle, system {system}, is heard: {choice}", WARNING, now)

    def _take(self, message: Any, number: int, sender: tuple[int, int], now: float) -> None:
        """One message with numbers, of any sender."""
        of_vehicle = sender == self.address
        stamp = self._stamp(message, number, of_vehicle, now)
        if of_vehicle:
            self._intervals.arrived(number)
            if number == ATTITUDE:
                self._heading = message.yaw
            if number in RANKS and self._replaceable:
                self._take_velocity(message, number, stamp, now)
        for route in self._routes.get(number, ()):
            if (of_vehicle if route.sender is None else fnmatchcase(f"{sender[0]}.{sender[1]}", route.sender)) and (
                self._is_instance(message, number, route.instance) and not (of_vehicle and route.replaceable)
            ):
                self._push_route(route, message, stamp, now)

    def _stamp(self, message: Any, number: int, of_vehicle: bool, now: float) -> float | None:
        """The vehicle's time of a message, s; None if it is doubted, or while the time is unknown."""
        name = MESSAGES[number].stamp
        if not of_vehicle or name is None:
            stamp = self._clock.of_receipt(now)
        elif name == "time_boot_ms":
            boots = self._clock.boots
            seconds = self._clock.stamp(1e-3 * message.time_boot_ms, now)
            if self._clock.boots > boots:
                self._reboot(now)
            return seconds
        else:
            bits = 64 if MESSAGES[number].fields[name].dtype == "<u8" else 32
            stamp = self._clock.of_micros(message.time_usec, bits, now)
        return stamp if math.isfinite(stamp) else None

    def _reboot(self, now: float) -> None:
        self._tell(self._session.restart(), now)
        self._ask_again()
        self._announce("the vehicle's clock began anew: a new segment", INFO, now)

    def _ask_again(self) -> None:
        self._servos.ask_again()
        self._intervals.again()

    def _is_instance(self, message: Any, number: int, wanted: int | None) -> bool:
        """Whether a message comes from the wanted one of equal senders: by default from that of the least number."""
        instance = instance_of(message)
        if instance is None or instance == wanted:
            return wanted is None or instance == wanted
        least = self._instances[number] = min(instance, self._instances.get(number, instance))
        return wanted is None and instance == least

    def _push_route(self, route: Route, message: Any, stamp: float | None, now: float) -> None:
        if route.is_output and not self._armed:
            self._session.drop(route.part, "disarmed")
        elif stamp is None:
            self._session.drop(route.part, "no_time")
        elif route.function is None:
            self._push(route.part, stamp, value_of(message, route.fields), now)
        elif (share := self._servos.share(route.function, message)) is None:
            self._session.drop(route.part, "no_parameters")
        else:
            self._push(route.part, stamp, share, now)

    def _take_velocity(self, message: Any, number: int, stamp: float | None, now: float) -> None:
        """Push the velocity from the best message that comes."""
        self._came[number] = now
        if not all(self._is_missing(better, now) for better in RANKS[: RANKS.index(number)]):
            return
        if number != self._source:
            self._source = number
            self._announce(f"the speed comes from {MESSAGES[number].name} now", WARNING, now)
        velocity = velocity_of(message, self._heading)
        for route in self._replaceable:
            if stamp is None:
                self._session.drop(route.part, "no_time")
            elif number == NED:
                self._push(route.part, stamp, number_of(message, route.fields[0]), now)
            elif velocity is not None:
                self._push(route.part, stamp, route.raw(velocity[VELOCITIES[route.fields[0]]]), now)

    def _push(self, part: str, stamp: float, raw: float, now: float) -> None:
        self._tell(self._session.push(part, stamp, raw), now)

    def _tell(self, steps: list[Step], now: float) -> None:
        for step in steps:
            if self.is_connected(now):
                self.telemetry.values(step.time, of_step(step))
            for event in step.events:
                self._announce(event.sentence, WARNING if event.kind == LOSS else INFO, now)

    # ------------------------------------------------------------ each second

    def tick(self, now: float) -> Health:
        """Do what is due each second, and return the session's health; `now` in s of a steady clock."""
        if self._servos.one_command:
            self._session.one_command = True
        health = self._session.tick()
        self.telemetry.heartbeat()
        if self.is_connected(now) and self.address is not None:
            self._wish_replacement(now)
            for number in self._intervals.due(now):
                self.telemetry.ask_interval(self.address, number, 1e6 / self._intervals.hz)
            for name in self._servos.to_ask():
                self.telemetry.ask_parameter(self.address, name)
        self._report(health, now)
        return health

    def _report(self, health: Health, now: float) -> None:
        """Tell what has changed since the last second, and the numbers that change seldom."""
        self._ticks += 1
        if self._ticks % SELDOM == 0 and self.is_connected(now):
            known = (Post(name, each[0]) for name, each in health.known.items())
            self.telemetry.values(self._clock.now(now), [*of_health(health), *known])
        if (step := self._session.last) is not None and step.time != self._sent_step and self.is_connected(now):
            self._sent_step = step.time
            speeds = [(h, *each, *step.if_held[h][1:]) for h, each in step.forecasts.items()]
            self.telemetry.array("USV_FORE", step.time, speeds)
            for name, places in (("USV_TRACK", step.places), ("USV_TRACKH", step.places_if_held)):
                self.telemetry.array(name, step.time, [(horizon, *each) for horizon, each in places.items()])
        problems = [self._servos.problem] if self._servos.problem else self._servos.remarks
        for sentence in dict.fromkeys((*problems, *health.warnings)):
            if alike(sentence) not in self._told:
                self._announce(sentence, WARNING, now)
        self._told = {alike(each) for each in (*problems, *health.warnings)}
        if health.state != self._state and (self._armed or self.address is None):  # disarmed, no command comes
            self._state = health.state
            self._text(health.sentence, WARNING if health.state in ("stale", "sparse") else INFO, now)

    def _wish_replacement(self, now: float) -> None:
        """Ask for the next source of the velocity while the better ones are silent."""
        for number, after in pairwise(RANKS):
            if not self._replaceable or not self._is_missing(number, now):
                return
            self._intervals.wish(after)
            self._came[after] = min(self._came[after], now)

    def _is_missing(self, number: int, now: float) -> bool:
        """Whether a message with the velocity was asked for and does not come."""
        return now - self._came[number] > REPLACED

    def _announce(self, sentence: str, severity: int, now: float) -> None:
        """Tell the operator here and ashore."""
        self._say(sentence)
        self._text(sentence, severity, now)

    def _text(self, sentence: str, severity: int, now: float) -> None:
        """Tell the operator ashore, if the vehicle is heard."""
        if self.is_connected(now):
            self.telemetry.say(f"usvlearn: {sentence}", severity, now)
