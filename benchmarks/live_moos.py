"""How long the node on MOOS takes from a message to the publication of its step, and how many messages it bears.

python benchmarks/live_moos.py [PORT [SECONDS]]       writes docs/benchmarks/live_moos.md, or live_moosdb.md with a port

Without a port this program plays the database; the node is a process of its own, on loopback. With the port of a MOOSDB
on this computer, a boat and a viewer are clients of it, and each message makes two hops more. A MOOSDB listens on every
interface: start it in a network namespace of its own.

A step is made by the message that completes it. Which one that is, a second node says that is given the same messages.
"""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from pages import publish
from timing import machine, table

from usvlearn.live.moos import wire
from usvlearn.live.moos.block import MIDDLEWARE
from usvlearn.live.moos.client import Client
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session
from usvlearn.live.start import Options

RATES = (1, 10, 100)  # Hz, of each variable
SECONDS = 120.0
BURST, BURST_PACKET = 40_000, 50  # messages that come at once, and in a packet
WINDOW = 1.5  # s, so that 1 Hz is enough
CHANNELS = {name: {"window": WINDOW} for name in MIDDLEWARE.channels}
NAMES = {name: str(each["name"]) for name, each in MIDDLEWARE.channels.items()}
WATCHED = ("USV_SPEED_NEXT", "USV_HEALTH")
Row = tuple[float, str, float]  # s since the beginning, channel, raw value


class Database:
    """What the node needs of a MOOSDB: a welcome, answers to timing messages, and the boat's messages."""

    def __init__(self, take: Callable[[Message], None], suffix: str):
        self.port, self._take, self.connections, self._suffix = 0, take, 0, suffix
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
            wire.encode(
                Message(wire.NOTIFY, NAMES[name] + self._suffix, value=value, time=stamp) for name, stamp, value in rows
            )
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


class Clients:
    """A boat and a viewer at a MOOSDB."""

    def __init__(self, port: int, take: Callable[[Message], None], suffix: str):
        self.port, self._suffix = port, suffix
        self._boat = Client("boat", "127.0.0.1", port, print)
        self._viewer = Client("viewer", "127.0.0.1", port, take)
        for name in WATCHED:
            self._viewer.register(name)

    async def start(self) -> None:
        self._tasks = [asyncio.create_task(each.run()) for each in (self._boat, self._viewer)]

    def post(self, rows: list[tuple[str, float, float]]) -> None:
        for name, stamp, value in rows:
            self._boat.notify(NAMES[name] + self._suffix, value, stamp)

    async def drain(self) -> None:
        await self._boat.drain()


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
    """A node, and what it publishes.

    Args:
        port: of a MOOSDB; None: this program plays it.
        folder: of the node.
        block: more lines of its mission.
        suffix: of the variables, so that a database has no last values of them.
    """

    def __init__(self, port: int | None, folder: Path, block: Sequence[str] = (), suffix: str = ""):
        self._block = [*block, *(f"{name} = {variable}{suffix}" for name, variable in NAMES.items())]
        self.folder, self.state, self.process = folder, "", 0  # number of the process
        self._began = time.time()
        self.arrived: list[float] = []  # when, of each SPEED_NEXT
        self.link = Database(self.take, suffix) if port is None else Clients(port, self.take, suffix)

    def take(self, message: Message) -> None:
        if message.time < self._began:  # a last value that a database had
            return
        if message.key == "USV_SPEED_NEXT":
            self.arrived.append(time.perf_counter())
        elif message.key == "USV_HEALTH":
            self.state = message.text.partition(",")[0]

    async def run(self, work: Callable[[Voyage], object]) -> None:
        """Do the work while the node runs."""
        await self.link.start()
        mission = self.folder / "a.moos"
        own = [f"{name}.window = {WINDOW}" for name in CHANNELS]
        block = [f"folder = {self.folder / 'node'}", "mass = 36", "surge_max = 3", *own, *self._block]
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


def latency(port: int | None, rate: float, seconds: float) -> list[str]:
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
        voyage = Voyage(port, Path(folder), suffix=f"_{rate:g}")
        asyncio.run(voyage.run(work))
        places = completing(rows, start)
    if len(places) != len(voyage.arrived):
        return [f"{rate:g}", f"{len(voyage.arrived)} of {len(places)}", "-", "-", "-"]
    took = 1e3 * (np.array(voyage.arrived) - np.array(sent)[places])
    figures = (np.median(took), np.percentile(took, 99), took.max())
    return [f"{rate:g}", f"{len(took)}", *(f"{each:.2f}" for each in figures)]


def burst(port: int | None) -> list[str]:
    """Messages a second that the node bears, if they come at once; and steps a second."""
    rows = boat(100, BURST / 400)
    took = 0.0

    async def work(voyage: Voyage) -> None:
        nonlocal took
        start, begin = float(math.ceil(time.time())), time.perf_counter()
        for k in range(0, len(rows), BURST_PACKET):
            voyage.link.post([(name, start + t, value) for t, name, value in rows[k : k + BURST_PACKET]])
            await voyage.link.drain()
        count = -1
        while count < len(voyage.arrived):
            count = len(voyage.arrived)
            await asyncio.sleep(1.0)
        took = voyage.arrived[-1] - begin

    with tempfile.TemporaryDirectory() as folder:
        voyage = Voyage(port, Path(folder), suffix="_BURST")
        asyncio.run(voyage.run(work))
    return [f"{len(rows)}", f"{len(voyage.arrived)}", f"{took:.2f}", f"{len(rows) / took:.0f}"]


def coding() -> str:
    """Time to code and decode a message, with 50 in a packet, µs."""
    packet = [Message(wire.NOTIFY, "NAV_SPEED", value=1.0, time=time.time(), source="pNav")] * 50
    begin = time.perf_counter()
    for _ in range(2000):
        wire.decode(wire.encode(packet))
    return f"{1e6 * (time.perf_counter() - begin) / 2000 / 50:.1f}"


def main() -> None:
    arguments = [float(each) for each in sys.argv[1:]]
    port = int(arguments[0]) if arguments else None
    seconds = arguments[1] if len(arguments) > 1 else SECONDS
    rows = [latency(port, rate, seconds) for rate in RATES]
    via = "this program plays the database" if port is None else "through a real MOOSDB, with a boat and a viewer"
    text = [
        "# Latency of the MOOS node" + ("" if port is None else " through a MOOSDB"),
        "",
        f"Measured by `python benchmarks/live_moos.py`; {via}. {machine()}.",
        "The node is the default ensemble from the prior, a process of its own, four variables. A message makes a step",
        "of 0.4 s of the boat complete, 0.1 s after its end (`patience`); the table has the time from there.",
        "",
        *table(["Hz of each variable", "steps", "median, ms", "p99, ms", "largest, ms"], rows),
        "",
        "Messages that come at once, 50 in a packet:",
        "",
        *table(["messages", "steps published", "s", "messages/s"], [burst(port)]),
        "",
        f"Coding and decoding a message takes {coding()} µs, with 50 in a packet.",
        "",
    ]
    publish(__file__, text, "live_moos" if port is None else "live_moosdb")


if __name__ == "__main__":
    main()
