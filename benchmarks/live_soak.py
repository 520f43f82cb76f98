"""Tests the node on MOOS: its latency, the load that it bears, and a day of sailing while the database is killed.

python benchmarks/live_soak.py [HOURS [RESTARTS]]       writes docs/benchmarks/live_soak.md

This program plays the boat and the database; the node is a process of its own, on loopback. A step is made by the
message that completes it. Which one that is, a second node says that is given the same messages.

The day is sailed as fast as the node takes it. Before each kill the node is given time to read what is on the way, so
nothing may be lost: what it publishes is compared with a node that is given the same messages without a network.
(Messages in flight at a kill are lost; the tests kill without warning.)
"""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
import tempfile
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
from pages import machine, publish, table

from usvlearn.live.moos import wire
from usvlearn.live.moos.block import MIDDLEWARE
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session
from usvlearn.live.start import Options
from usvlearn.logs.channels.channel import Recording
from usvlearn.simulate.fleet import fleet

RATES, SECONDS = (1, 10, 100), 120.0  # Hz, of each variable; s of each
BURST, BURST_PACKET = 40_000, 50  # messages that come at once, and in a packet
WINDOW = 1.5  # s, so that 1 Hz is enough
CHANNELS = {name: {"window": WINDOW} for name in MIDDLEWARE.channels}
NAMES = {name: str(each["name"]) for name, each in MIDDLEWARE.channels.items()}
HOURS, RESTARTS = 24.0, 100
SCALE = {"command_left": 100.0, "command_right": 100.0, "heading": 180 / math.pi, "surge": 1.0}
IDLE = 0.5  # s without a post, after which the node has read all
SAMPLES = 24  # of the memory
SAVE = 15.0  # s between two saves
OPENING = """\
# The node on MOOS: latency, and a day of sailing

Measured by `python benchmarks/live_soak.py`, which plays the database. {}.

## Latency

The node is the default ensemble from the prior, a process of its own, four variables. A message makes a step
of 0.4 s of the boat complete, 0.1 s after its end (`patience`); the table has the time from there."""
START = math.ceil(time.time()) + 3600.0  # so that no message is as old as a last value of the database
Row = tuple[float, str, float]  # s since the beginning, channel, raw value


class Database:
    """What the node needs of a MOOSDB: a welcome, answers to timing messages, and the boat's messages."""

    def __init__(self, take: Callable[[Message], None]):
        self.port, self._take, self.connections = 0, take, 0
        self._writer: asyncio.StreamWriter | None = None
        self._server: asyncio.Server | None = None

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def restart(self) -> None:
        """End, begin anew, and wait until the node is back."""
        assert self._server and self._writer
        self._server.close()
        self._writer.transport.abort()
        self._writer = None
        await self.start()
        while self._writer is None:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.1)  # it subscribes

    def post(self, rows: list[tuple[str, float, float]]) -> None:
        assert self._writer
        self._writer.write(
            wire.encode(Message(wire.NOTIFY, NAMES[name], value=value, time=stamp) for name, stamp, value in rows)
        )

    async def drain(self) -> None:
        assert self._writer
        await self._writer.drain()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readexactly(len(wire.PROTOCOL))
        await wire.read(reader)
        writer.write(wire.encode([Message(wire.WELCOME, data=wire.NUMBER, text="asynchronous", community="usv")]))
        self._writer = writer
        self.connections += 1
        with suppress(OSError, asyncio.IncompleteReadError):
            while True:
                for message in await wire.read(reader):
                    if message.kind == wire.TIMING:
                        writer.write(wire.encode([message._replace(value=time.time())]))
                    elif message.kind == wire.NOTIFY:
                        self._take(message)


def boat(rate: float, seconds: float) -> list[Row]:
    """What a boat says: four variables at a rate, one after the other."""

    def rows() -> Iterator[Row]:
        for k in range(round(rate * seconds)):
            t = k / rate
            values = (
                50 + 30 * math.sin(0.1 * t),
                50 + 30 * math.sin(0.13 * t),
                (3 * t) % 360,
                1.5 + math.sin(0.05 * t),
            )
            for n, (name, value) in enumerate(zip(NAMES, values, strict=True)):
                yield t + n / (4 * rate), name, value

    return list(rows())


def options(folder: Path) -> Options:
    return Options(folder, mass=36.0, surge_max=3.0, channels=CHANNELS)


def completing(rows: list[Row], start: float) -> list[int]:
    """The message that completes each step with a prediction of the next one."""
    with tempfile.TemporaryDirectory() as folder, Session(options(Path(folder)), MIDDLEWARE) as session:
        session.start()
        session.wait()
        return [
            k
            for k, (t, name, value) in enumerate(rows)
            for step in session.push(name, start + t, value)
            if math.isfinite(step.next)
        ]


class Voyage:
    """A node, and what it publishes."""

    def __init__(self, folder: Path, *block: str):
        self.folder, self.block, self.state, self.process = folder, block, "", 0  # number of the process
        self.arrived, self.values, self.stamps = array("d"), array("d"), array("d")  # of each SPEED_NEXT
        self.gaps, self.heard = array("d"), time.perf_counter()
        self.link = Database(self.take)

    def take(self, message: Message) -> None:
        now = time.perf_counter()
        self.heard = now if message.key.startswith("USV_SPEED") else self.heard
        if message.key == "USV_SPEED_NEXT":
            self.arrived.append(now)
            self.values.append(message.value)
            self.stamps.append(message.time)
        elif message.key == "PUSVLEARN_ITER_GAP":
            self.gaps.append(message.value)
        elif message.key == "USV_HEALTH":
            self.state = message.text.partition(",")[0]

    async def rest(self) -> None:
        """Wait until the node has read all."""
        await self.link.drain()
        self.heard = time.perf_counter()
        while time.perf_counter() - self.heard < IDLE:
            await asyncio.sleep(IDLE / 10)

    async def run(self, work: Callable[[Voyage], object]) -> None:
        """Do the work while the node runs."""
        await self.link.start()
        mission = self.folder / "a.moos"
        channels = [f"{name} = {variable}\n{name}.window = {WINDOW}" for name, variable in NAMES.items()]
        block = [f"folder = {self.folder / 'node'}", "mass = 36", "surge_max = 3", *channels, *self.block]
        lines = [f"ServerPort = {self.link.port}", "ServerHost = 127.0.0.1", "ProcessConfig = pUSVLearn", "{"]
        mission.write_text("\n".join([*lines, *block, "}"]))
        command = [sys.executable, "-m", "usvlearn", "live", "moos", str(mission)]
        node = await asyncio.create_subprocess_exec(*command, stdout=subprocess.DEVNULL)
        self.process = node.pid
        try:
            while self.state in ("", "state=compiling"):
                await asyncio.sleep(0.1)
            await asyncio.sleep(1.0)
            await work(self)
        finally:
            node.terminate()
            await node.wait()


def latency(rate: float, seconds: float) -> list[str]:
    """A row of the table: median, p99 and largest time from the message to the publication, ms."""
    rows, sent = boat(rate, seconds), []
    start = 0.0

    async def work(voyage: Voyage) -> None:
        nonlocal start
        start = math.ceil(time.time()) + 0.05
        offset = start - time.time() + time.perf_counter()
        for t, name, value in rows:
            if (wait := offset + t - time.perf_counter()) > 0:
                await asyncio.sleep(wait)
            sent.append(time.perf_counter())
            voyage.link.post([(name, start + t, value)])
        await asyncio.sleep(0.5)

    with tempfile.TemporaryDirectory() as folder:
        voyage = Voyage(Path(folder))
        asyncio.run(voyage.run(work))
        places = completing(rows, start)
    if len(places) != len(voyage.arrived):
        return [f"{rate:g}", f"{len(voyage.arrived)} of {len(places)}", "-", "-", "-"]
    took = 1e3 * (np.array(voyage.arrived) - np.array(sent)[places])
    figures = (np.median(took), np.percentile(took, 99), took.max())
    return [f"{rate:g}", f"{len(took)}", *(f"{each:.2f}" for each in figures)]


def burst() -> list[str]:
    """Messages a second that the node bears, if they come at once; and steps a second."""
    rows = boat(100, BURST / 400)
    took = 0.0

    async def work(voyage: Voyage) -> None:
        nonlocal took
        start, begin = float(math.ceil(time.time())), time.perf_counter()
        for k in range(0, len(rows), BURST_PACKET):
            voyage.link.post([(name, start + t, value) for t, name, value in rows[k : k + BURST_PACKET]])
            await voyage.link.drain()
        await voyage.rest()
        took = voyage.arrived[-1] - begin

    with tempfile.TemporaryDirectory() as folder:
        voyage = Voyage(Path(folder))
        asyncio.run(voyage.run(work))
    return [f"{len(rows)}", f"{len(voyage.arrived)}", f"{took:.2f}", f"{len(rows) / took:.0f}"]


@cache
def simulated(hours: float) -> list[Recording]:
    return fleet(n=1, hours=hours, seed=0)


def rows(hours: float, start: float) -> Iterator[tuple[str, float, float]]:
    """What a simulated boat says: channel, stamp and raw value, in the order of its messages."""
    for recording in simulated(hours):  # runs, an hour apart
        names = [name for name in recording.channels if name in SCALE]
        channels = [recording.channels[name] for name in names]
        which = np.repeat(np.arange(len(names)), [len(each.order) for each in channels])
        when = start + np.concatenate([each.time for each in channels])
        value = np.concatenate([SCALE[name] * each.value for name, each in zip(names, channels, strict=True)])
        for place in np.argsort(np.concatenate([each.order for each in channels]), kind="stable"):
            yield names[which[place]], float(when[place]), float(value[place])
        start = when.max() + 3600.0


def memory(process: int) -> float:
    """What a process has in memory, MB."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * 4096 / 1e6


def sail(hours: float, restarts: int) -> tuple[Voyage, list[float], float]:
    """The node's posts, its memory as the day went by, MB, and the day's length, s."""
    resident: list[float] = []
    took = 0.0
    packets = math.ceil(sum(1 for _ in rows(hours, START)) / BURST_PACKET)  # now: a database that is busy seems frozen

    async def work(day: Voyage) -> None:
        nonlocal took
        begin, boat = time.monotonic(), rows(hours, START)
        kill, sample = max(packets // (restarts + 1), 1), max(packets // SAMPLES, 1)
        for k in range(packets):
            day.link.post(list(islice(boat, BURST_PACKET)))
            await day.link.drain()
            if k % sample == sample - 1:
                resident.append(memory(day.process))
            if k % kill == kill - 1 and k // kill < restarts:
                await day.rest()
                await day.link.restart()
        await day.rest()
        took = time.monotonic() - begin

    with tempfile.TemporaryDirectory() as folder:
        day = Voyage(Path(folder), f"save_period = {SAVE}")
        asyncio.run(day.run(work))
    return day, resident, took


def alone(hours: float) -> list[float]:
    """The same messages, to a node without a network."""
    with tempfile.TemporaryDirectory() as folder, Session(options(Path(folder)), MIDDLEWARE) as session:
        session.start()
        session.wait()
        steps = (step for row in rows(hours, START) for step in session.push(*row))
        return [step.next for step in steps if math.isfinite(step.next)]


def main() -> None:
    given = [float(each) for each in sys.argv[1:]]
    hours = given[0] if given else HOURS
    restarts = int(given[1]) if len(given) > 1 else RESTARTS
    latencies, bursts = [latency(rate, SECONDS) for rate in RATES], burst()
    day, resident, took = sail(hours, restarts)
    expected = alone(hours)
    same = min(len(expected), len(day.values))
    equal = int((np.array(expected[:same]) == np.array(day.values[:same])).sum())
    gaps = np.array(day.gaps)
    facts = [
        ["messages", f"{sum(1 for _ in rows(hours, START))}"],
        ["steps published", f"{len(day.values)} of {len(expected)}"],
        ["equal to the last bit", f"{equal}"],
        ["posts out of order", f"{int((np.diff(day.stamps) < 0).sum())}"],
        ["kills, and connections after them", f"{restarts}, {day.link.connections - 1}"],
        [f"memory after 1/{SAMPLES}, 1/4, 1/2, 3/4 and all of the time, MB",
         ", ".join(f"{resident[k * len(resident) // 4 - (k > 0)]:.0f}" for k in range(5))],
        ["time, s", f"{took:.0f}"],
        ["time between two iterations, times AppTick: median, 99 %, largest",
         f"{np.median(gaps):.3f}, {np.percentile(gaps, 99):.2f}, {gaps.max():.2f}"],
    ]  # fmt: skip
    text = [
        OPENING.format(machine()),
        "",
        *table(["Hz of each variable", "steps", "median, ms", "p99, ms", "largest, ms"], latencies),
        "",
        f"Messages that come at once, {BURST_PACKET} in a packet:",
        "",
        *table(["messages", "steps published", "s", "messages/s"], [bursts]),
        "",
        "## A day of sailing",
        "",
        f"{hours:g} h of a simulated boat, {restarts} kills of the database, a save every {SAVE:g} s.",
        "",
        *table(["", "found"], facts),
        "",
    ]
    publish(__file__, text)


if __name__ == "__main__":
    main()
