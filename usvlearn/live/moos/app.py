"""The app on a MOOSDB: it subscribes to the boat's variables, and publishes predictions and what every app does.

Messages are handled as they come, and what a step gives is published at once. AppTick paces only the rest: health,
status and AppCasts, which a MOOS viewer asks for and shows. Nothing here waits: compiling and saving have threads of
their own, and while there is no database, posts wait in a bounded outbox.
"""

from __future__ import annotations

import asyncio
import math
import signal
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from usvlearn.errors import ConfigError
from usvlearn.live.health import COMPILING, Health
from usvlearn.live.moos import wire
from usvlearn.live.moos.block import ANSWER, EXAMPLE, MIDDLEWARE, Settings, interface, parser, settings_of
from usvlearn.live.moos.client import Client
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session
from usvlearn.live.status import PLANNED, TABLE, Post, StatusLine, alike, of_health, of_step, page
from usvlearn.live.status import SELDOM as SELDOM_WHEN
from usvlearn.logs.channels.channel import COMMANDS

FIELD, ITEM = "!@#", "!@"  # what separates fields, and items of a field
PERIOD = 0.4  # s between two AppCasts, at least
LONGEST = 30.0  # s, for which one request counts, at most
KEYS = 100  # viewers and warnings that are remembered
EVENTS = 8  # that are shown


class AppCasts:
    """Who has asked for AppCasts, and what they are told."""

    def __init__(self, app: str):
        self.app = app
        self.warnings: Counter[str] = Counter()  # run warning -> how often it came
        self.config_warnings: list[str] = []
        self._asked: dict[str, tuple[float, bool]] = {}  # key -> until when, and whether only warnings are wanted
        self._events: deque[str] = deque(maxlen=EVENTS)
        self._total = 0
        self._cast = float("-inf")
        self._told_warnings = 0  # run warnings at the last AppCast

    def ask(self, text: str, clock: float, node: str) -> None:
        """Take an `APPCAST_REQ`; anything else is ignored."""
        given: dict[str, str] = {}
        for part in text.split(","):
            name, _, value = part.strip().partition("=")
            given[name] = value
        try:
            duration = float(given.get("duration", "0"))
        except ValueError:
            return
        if given.get("node") not in (node, "all") or given.get("app") not in (self.app, "all") or not duration > 0:
            return
        key = given.get("key", "")[:100]
        self._asked.pop(key, None)  # so that the newest is the last
        self._asked[key] = clock + min(duration, LONGEST), given.get("thresh") == "run_warning"
        while len(self._asked) > KEYS:
            del self._asked[next(iter(self._asked))]

    def due(self, clock: float) -> bool:
        """Whether an AppCast is due now, which it then is not for a while."""
        self._asked = {key: each for key, each in self._asked.items() if each[0] >= clock}
        new_warnings = self.warnings.total() > self._told_warnings
        if clock - self._cast < PERIOD or not any(new_warnings or not only for _, only in self._asked.values()):
            return False
        self._cast, self._told_warnings = clock, self.warnings.total()
        return True

    def warn(self, text: str) -> None:
        """Add a run warning, or count it once more."""
        self.warnings[text] += 1
        while len(self.warnings) > KEYS:
            del self.warnings[next(iter(self.warnings))]

    def event(self, text: str, uptime: float) -> None:
        """Add an event, which is shown with the time since the start, s."""
        self._total += 1
        self._events.append(f"[{uptime:.2f}]: {text}")

    def compose(self, iteration: int, node: str, lines: Iterable[str]) -> str:
        """The text of an AppCast."""
        fields = {
            "proc": self.app, "iter": f"{iteration}", "node": node,
            "messages": "".join(f"{line}{ITEM}" for line in _plain(lines)),
            "config_warnings": ITEM.join(_plain(self.config_warnings)),
            "events_total": f"{self._total}", "events": ITEM.join(_plain(self._events)),
            "run_warning_total": f"{self.warnings.total()}",
            "run_warnings": ITEM.join(_plain(f"{count}:{text}" for text, count in self.warnings.most_common(EVENTS))),
        }  # fmt: skip
        return FIELD.join(f"{key}={text}" if text else "" for key, text in fields.items())


def _plain(lines: Iterable[str]) -> Iterator[str]:
    """Lines without what would separate them."""
    for line in lines:
        yield line.replace(ITEM, "! @").replace("\n", " ")


REQUEST = "APPCAST_REQ"
PLAIN = "DESIRED_THRUST"  # of pMarinePID, which posts no command of a side
ADVICE = (
    "DESIRED_THRUST is posted, and no DESIRED_THRUST_L and _R: add `throttle = DESIRED_THRUST` to the block of this "
    "app; and `steering = DESIRED_RUDDER`, if a mixer steers by two thrusters"
)
SECOND, STATUS, SELDOM = 1.0, 2.0, 5.0  # s between two reports of health, of status, and of what changes seldom
OLD = 1.0  # s: what is older than the subscription by more than this is no news
SELDOM_POSTS = {each.name for each in TABLE if each.when == SELDOM_WHEN}


class App:
    """The app."""

    def __init__(self, session: Session, settings: Settings):
        self.session, self.settings = session, settings
        self.client = Client(settings.name, settings.host, settings.port, self.take, settings.warp)
        self.casts = AppCasts(settings.name)
        self.casts.config_warnings = list(session.warnings)
        self._feeds: dict[str, list[tuple[str, str]]] = {}  # variable -> parts, and the app whose posts count or ""
        for part, source in session.sources.items():
            variable, _, app = source.name.partition("@")
            if any(each in variable for each in "*?"):
                raise ConfigError(
                    f"{part}: found {source.name!r}, expected the name of one variable: {part} = VARIABLE"
                )
            self._feeds.setdefault(variable, []).append((part, app))
        sides = {name for name in COMMANDS if session.sources.get(name)}
        expected = {session.sources[name].name for name in sides}
        self._plain = expected == {MIDDLEWARE.channels[name]["name"] for name in COMMANDS}  # whether to look for PLAIN
        for variable in (*self._feeds, REQUEST, ANSWER, settings.plan, *([PLAIN] if self._plain else [])):
            self.client.register(variable)
        self._connection = 0  # number of the connection
        self._subscribed = 0.0  # MOOS time of its beginning
        self._heard_plain = False  # whether PLAIN is posted
        self._heard: set[str] = set()  # variables that came since then
        self._stamps: dict[str, float] = {}  # variable -> its latest stamp
        self._published = {f"{settings.name.upper()}_{each}" for each in ("STATUS", "ITER_GAP", "ITER_LEN")}
        self._health: Health = COMPILING
        self._line = StatusLine(settings.name)
        self._trouble = self.client.trouble  # that is known to the events
        self._warned: set[str] = set()
        self._introduced = False  # by an AppCast that nobody has asked for
        self._iteration, self._busy = 0, 0.0  # s, of messages since the last iteration
        self._began = time.monotonic()
        self._stop = asyncio.Event()

    @property
    def _node(self) -> str:
        return self.settings.community or self.client.community

    # what comes in

    def take(self, message: Message) -> None:
        """Take one message of the database."""
        began = time.perf_counter()
        if message.key == REQUEST:
            self.casts.ask(message.text, time.monotonic(), self._node)
        elif message.key in (self.settings.plan, ANSWER):
            self._answer(message)
        elif message.key == PLAIN and self._plain:
            self._heard_plain = True
        elif message.key in self._feeds:
            last = self._is_last_value(message)
            for part, app in self._feeds[message.key]:
                if not app or app == message.source:
                    self._feed(part, message, last)
        self._busy += time.perf_counter() - began

    def _is_last_value(self, message: Message) -> bool:
        """Whether it is what the database already had at the subscription."""
        if self._connection != self.client.counts["connected"]:
            self._connection = self.client.counts["connected"]
            self._expect_last_values()
        key, stamp = message.key, message.time
        old = stamp < self._subscribed - OLD * self.settings.warp or stamp == self._stamps.get(key)
        is_last = old and key not in self._heard
        self._heard.add(key)
        self._stamps[key] = stamp
        return is_last

    def _expect_last_values(self) -> None:
        self._subscribed = self.client.now()
        self._heard.clear()

    def _feed(self, part: str, message: Message, last: bool) -> None:
        """Hand a value to the node.

        The last value that the database has is old: it would be the beginning of another segment. But a command that
        is held is in force now.
        """
        if message.data == wire.NUMBER:
            value = message.value
        elif message.data == wire.TEXT:
            try:
                value = float(message.text)
            except ValueError:
                return self.session.drop(part, "wrong_type" if message.text.strip() else "empty")
        else:
            return self.session.drop(part, "wrong_type")
        if last and not self.session.sources[part].held:
            return self.session.drop(part, "last_value")
        for step in self.session.push(part, self._subscribed if last else message.time, value):
            self._publish(of_step(step, self.settings.members))
            for event in step.events:
                self.casts.event(event.sentence, self._uptime())
                self._line.say(event.sentence)
        return None

    def _answer(self, message: Message) -> None:
        """Answer a plan, or take the answer to an alarm; the last value that the database has is old."""
        text = message.text if message.data == wire.TEXT else f"{message.value:g}"
        if self._is_last_value(message):
            return
        if message.key == ANSWER:
            self.session.answer_alarm(text)
        else:
            self._publish([Post(PLANNED, self.session.answer(text))])

    # what goes out

    def _publish(self, posts: Iterable[Post]) -> None:
        for post in posts:
            self._published.add(self.settings.prefix + post.name)
            self.client.notify(self.settings.prefix + post.name, post.value)

    def _uptime(self) -> float:
        return time.monotonic() - self._began

    def _report(self, clock: float, seldom: bool) -> None:
        """The health, once a second."""
        compiling = self._health.state == COMPILING.state
        self._health = health = self.session.tick(clock)
        if compiling and health.state != COMPILING.state:  # what came until now was dropped: ask for it again
            self._expect_last_values()
            for variable in self._feeds:
                self.client.register(variable)
        sides = [health.ages.get(name, 0.0) for name in COMMANDS]
        self.session.advise("plain", ADVICE if self._heard_plain and all(map(math.isinf, sides)) else "")
        for warning in set(health.warnings) - set(self.casts.config_warnings):
            if alike(warning) not in self._warned:
                self.casts.warn(warning)
        self._warned = set(map(alike, health.warnings))
        if self.client.trouble != self._trouble:
            self._trouble = self.client.trouble
            where = f"{self.settings.host}:{self.settings.port}"
            self.casts.event(self._trouble or f"connected to the MOOSDB at {where}", self._uptime())
        self._line.show(health, self.session.last, self._trouble)
        if self.client.connected:  # old news is none
            self._publish(post for post in of_health(health) if seldom or post.name not in SELDOM_POSTS)

    def _status(self, cpu: float) -> str:
        """The posts that every app makes about itself."""
        now, most = _memory()
        facts = {
            "AppErrorFlag": "false", "Uptime": f"{self._uptime() * self.settings.warp:.2f}", "cpuload": f"{cpu:.2f}",
            "memory_kb": now, "memory_max_kb": most, "MOOSName": self.settings.name,
            "Publishing": f'"{"".join(f"{name}," for name in sorted(self._published))}"',
            "Subscribing": f'"{"".join(f"{name}," for name in sorted(self.client.registered))}"',
        }  # fmt: skip
        return ",".join(f"{key}={text}" for key, text in facts.items())

    def _cast(self, clock: float) -> None:
        if self.client.connected and (self.casts.due(clock) or not self._introduced):
            self._introduced = True
            counts = {cause: count for cause, count in self.client.counts.items() if cause != "connected" and count}
            link = ", ".join(f"{cause} {count}" for cause, count in counts.items())
            lines = [*page(self._health, self.session.last), f"Database    {link or 'no losses'}"]
            self.client.notify("APPCAST", self.casts.compose(self._iteration, self._node, lines))

    async def _iterate(self, client: asyncio.Task[None]) -> None:
        """Iterate until the app is asked to stop."""
        period = 1.0 / (self.settings.tick * self.settings.warp)
        app = self.settings.name.upper()
        due = second = status = seldom = before = time.monotonic()
        cpu, wall = time.process_time(), time.perf_counter()
        while not self._stop.is_set():
            if client.done():
                client.result()  # a bug: it never ends by itself
            clock = time.monotonic()
            self._iteration += 1
            if clock >= second:
                self._report(clock, clock >= seldom)
                second, seldom = clock + SECOND, seldom if clock < seldom else clock + SELDOM
            self._cast(clock)
            if self.client.connected:
                if clock >= status:
                    used, passed = time.process_time() - cpu, time.perf_counter() - wall
                    cpu, wall, status = cpu + used, wall + passed, clock + STATUS
                    self.client.notify(f"{app}_STATUS", self._status(100 * used / max(passed, 1e-3)))
                if self._iteration > 1:
                    self.client.notify(f"{app}_ITER_GAP", (clock - before) / period)
                self.client.notify(f"{app}_ITER_LEN", (self._busy + time.monotonic() - clock) / period)
            self._busy, before = 0.0, clock
            due = max(due + period, time.monotonic())
            with suppress(TimeoutError):
                async with asyncio.timeout(max(due - time.monotonic(), 0.001)):
                    await self._stop.wait()

    def stop(self) -> None:
        """Ask the app to end."""
        self._stop.set()

    async def main(self) -> int:
        """Run until SIGTERM, SIGINT or `stop`; returns the exit code."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            with suppress(ValueError, RuntimeError, NotImplementedError):  # not in the main thread
                loop.add_signal_handler(number, self.stop)
        self._line.say(self.session.sentence)
        self.session.start()
        client = asyncio.create_task(self.client.run())
        try:
            await self._iterate(client)
        finally:
            self._line.close()
            self._line.say(self.session.close())
        self.client.notify("EXITED_NORMALLY", self.settings.name)
        await self.client.drain()
        client.cancel()
        with suppress(asyncio.CancelledError):
            await client
        return 0


def _memory() -> tuple[str, str]:
    """What this process has in memory now and had at most, kB; 0 where the system does not say."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return "0", "0"
    sizes = {key: value.split() for key, _, value in (line.partition(":") for line in lines)}
    now, most = (sizes.get(key, ["0"])[0] for key in ("VmRSS", "VmHWM"))
    return now, most


def run(session: Session, settings: Settings) -> int:
    """Run the app with a session, which it closes; returns the exit code."""

    async def work() -> int:
        try:
            app = App(session, settings)
        except ConfigError:
            session.close()
            raise
        return await app.main()

    return asyncio.run(work())


def main(arguments: Sequence[str]) -> int:
    """The command `usvlearn live moos`; returns the exit code."""
    given = parser().parse_args(arguments)
    if given.example or given.interface:
        print(EXAMPLE if given.example else interface())
        return 0
    settings = settings_of(arguments, given)
    return run(Session(settings.options, MIDDLEWARE), settings)
