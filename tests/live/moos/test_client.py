"""The client against a database: what it delivers, and that it comes back after every fault.

All tests of this file but those of nonsense run against the stand-in and against a real MOOSDB, where one is.
"""

import asyncio
import contextlib
import functools
import socket
import time
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from tests.support.loopback import Loopback
from tests.support.moos_app import until
from usvlearn.live.moos import client as module
from usvlearn.live.moos import wire
from usvlearn.live.moos.client import OUTBOX, UNSENT, Client
from usvlearn.live.moos.wire import Message, WireError


class Listener(Client):
    """A client that keeps what it receives."""

    def __init__(self, port: int, name: str = "pUSVLearn", **options):
        self.received: list[Message] = []
        super().__init__(name, "127.0.0.1", port, self.received.append, **options)

    def values(self, key: str) -> list[float]:
        return [message.value for message in self.received if message.key == key]


@contextlib.asynccontextmanager
async def running(*clients: Client):
    tasks = [asyncio.create_task(client.run()) for client in clients]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def sailed(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """A test that is a coroutine, run in a loop of its own beside a database that is started."""

    @functools.wraps(test)
    def run(database, **others):
        async def work():
            await database.start()
            try:
                await test(database=database, **others)
            finally:
                database.thaw()
                database.kill()
                await asyncio.sleep(0.05)

        asyncio.run(work())

    return run


@sailed
async def test_posts_arrive_in_order_and_the_last_value_comes_at_registration(database):
    listener, boat = Listener(database.port), Client("boat", "127.0.0.1", database.port, print)
    begin = time.time()
    async with running(boat):
        await until(lambda: boat.connected)
        boat.notify("OLD", 3.0)
        boat.notify("WORDS", "a b")
        await boat.drain()
        await asyncio.sleep(1.2)
        for name in ("OLD", "WORDS", "NAV_SPEED"):
            listener.register(name)
        async with running(listener):
            await until(lambda: len(listener.received) == 2)
            assert listener.community == "usv" and listener.trouble == ""
            assert listener._writer is not None
            assert listener._writer.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            last = next(each for each in listener.received if each.key == "OLD")
            assert last.value == 3.0 and last.source == "boat" and begin <= last.time < time.time() - 1.0
            for k in range(500):
                boat.notify("NAV_SPEED", k)
                if k % 7 == 0:
                    await asyncio.sleep(0.001)
            await until(lambda: len(listener.values("NAV_SPEED")) == 500)
            assert listener.values("NAV_SPEED") == list(range(500))
            words = next(each for each in listener.received if each.key == "WORDS")
            assert (words.data, words.text) == (wire.TEXT, "a b")
            await until(lambda: listener.round_trip < 1.0)
            assert abs(listener.now() - time.time()) < 0.1


@pytest.mark.parametrize(
    "times", [pytest.param(10, marks=pytest.mark.thorough), pytest.param(200, marks=pytest.mark.slow)]
)
@sailed
async def test_a_database_that_is_killed_again_and_again(database, times, monkeypatch):
    if times == 10:
        monkeypatch.setattr(module, "FIRST", 0.05)
    listener, boat = Listener(database.port), Client("boat", "127.0.0.1", database.port, print)
    listener.register("K")
    sent = 0

    async def sail():
        nonlocal sent
        while True:
            boat.notify("K", sent)
            sent += 1
            await asyncio.sleep(0.01)

    async with running(listener, boat):
        sailing = asyncio.create_task(sail())
        for kill in range(times):
            count = len(listener.received)
            await until(lambda count=count: len(listener.received) > count + 3)
            database.kill()
            await asyncio.sleep(0.02 * (kill % 3))
            await database.start()
        count = len(listener.received)
        await until(lambda: len(listener.received) > count + 3)
        sailing.cancel()
    heard = listener.values("K")
    assert heard == sorted(set(heard))  # none twice, none out of order
    assert listener.counts["connected"] == times + 1 and listener.counts["lost"] >= times
    assert not listener.counts["garbage"] and not boat.counts["outbox"]
    assert sent - len(heard) <= 60 * times  # what was in flight, or came before the new registration


@pytest.mark.thorough
@sailed
async def test_a_database_that_is_frozen(database, monkeypatch):
    monkeypatch.setattr(module, "SILENCE", 2.0)
    listener = Listener(database.port)
    listener.register("A")
    boat = Client("boat", "127.0.0.1", database.port, print)
    async with running(listener):
        await until(lambda: listener.connected)
        database.freeze()
        for k in range(20_000):  # 40 MB
            listener.notify("APPCAST", "x" * 2000)
            if k % 100 == 0:
                await asyncio.sleep(0)
        writer = listener._writer
        assert writer is not None
        assert writer.transport.get_write_buffer_size() < 2 * UNSENT
        assert len(listener._outbox) <= OUTBOX and listener.counts["outbox"] > 1000
        await until(lambda: listener.counts["silent"])
        assert not listener.connected and "was silent" in listener.trouble
        database.thaw()
        await until(lambda: listener.connected)
        async with running(boat):
            boat.notify("A", 1.0)
            await until(lambda: listener.received)


@sailed
async def test_a_name_that_is_taken_is_asked_for_again(database):
    first, second = Listener(database.port), Listener(database.port)
    async with running(second):
        async with running(first):
            await until(lambda: first.connected != second.connected)
            one, other = (first, second) if first.connected else (second, first)
            await until(lambda: other.counts["name_taken"] > 1)
            assert one.connected and not other.connected and "already exists" in other.trouble
            if one is second:  # the one that ends must be the one that is connected
                return
        await until(lambda: second.connected)


@sailed
async def test_the_outbox_drops_the_oldest(database):
    client, listener = Client("a", "127.0.0.1", database.port, print), Listener(database.port, "b")
    for k in range(OUTBOX + 10):
        client.notify("K", k)
    assert client.counts["outbox"] == 10
    listener.register("K")
    async with running(listener):
        await until(lambda: listener.connected)
        await asyncio.sleep(0.2)
        async with running(client):
            await until(lambda: len(listener.received) == OUTBOX)
    assert listener.values("K") == list(range(10, OUTBOX + 10))


@sailed
async def test_many_posts_in_one_turn_of_the_loop_are_all_sent(database):
    client, listener = Client("a", "127.0.0.1", database.port, print), Listener(database.port, "b")
    listener.register("K")
    async with running(client, listener):
        await until(lambda: client.connected and listener.connected)
        await asyncio.sleep(0.2)
        for k in range(5 * OUTBOX):
            client.notify("K", k)
        await until(lambda: len(listener.received) == 5 * OUTBOX)
    assert listener.values("K") == list(range(5 * OUTBOX)) and not client.counts["outbox"]


@pytest.mark.thorough
@sailed
async def test_a_clock_that_jumps_by_an_hour_follows_that_of_the_database(database):
    shift = [0.0]
    client = Listener(database.port, clock=lambda: time.time() + shift[0])
    async with running(client):
        await until(lambda: client.connected)
        for shift[0] in (0.0, 3600.0, -3600.0):
            await until(lambda: abs(client.now() - time.time()) < 0.1)
        assert client.counts == {"connected": 1}


@sailed
async def test_a_database_that_starts_later(database):
    client = Client("a", "127.0.0.1", database.port, print)
    database.kill()
    async with running(client):
        await until(lambda: client.counts["unreachable"] > 1)
        assert "no MOOSDB at 127.0.0.1" in client.trouble
        await database.start()
        await until(lambda: client.connected)


# what only a server of our own can send

STAND_IN = pytest.mark.parametrize("database", ["stand_in"], indirect=True)


@pytest.mark.parametrize("raw", [b"\xff" * 64, b"\x08\0\0\0", wire.encode([Message("N")])[:8] + b"\1" + b"\0" * 54])
@STAND_IN
@sailed
async def test_garbage_ends_the_connection_and_a_new_one_begins(database, raw):
    client = Listener(database.port)
    client.register("A")
    async with running(client):
        await until(lambda: client.connected)
        database.inject(raw)
        await until(lambda: client.counts["garbage"] == 1)
        await until(lambda: "pUSVLearn" in database.links and client.connected)
        database.post("A", 1.0)
        await until(lambda: client.received)


@pytest.mark.thorough
def test_a_stream_that_is_cut_at_every_byte(monkeypatch):
    """Its end comes there, or a pause: whatever is complete is delivered, and nothing else."""
    monkeypatch.setattr(module, "FIRST", 0.001)
    monkeypatch.setattr(module, "LONGEST", 0.001)
    welcome = wire.encode([Message(wire.WELCOME, data=wire.NUMBER, text="asynchronous")])
    first, second = (wire.encode([Message("N", "A", value=value)]) for value in (1.0, 2.0))
    stream = welcome + first + second
    ends = range(len(stream) + 1)
    links: list[list[float]] = []  # the values that each connection delivered

    async def serve(reader, writer):
        links.append([])
        end, paused = (len(links) - 1) % len(ends), len(links) > len(ends)
        try:
            writer.write(stream[:end])
            await asyncio.sleep(0.002)
            if paused:
                writer.write(stream[end:])
            writer.write_eof()
            await reader.read()  # until the client has left
        except OSError:
            pass

    async def work():
        client = Client("a", "127.0.0.1", 0, lambda message: links[-1].append(message.value))
        server = Loopback(serve)
        client.port = server.start()
        async with running(client):
            await until(lambda: len(links) > 2 * len(ends), 60)
        server.close()
        assert not client.counts["garbage"]
        await asyncio.sleep(0.02)

    asyncio.run(work())
    expected = [[1.0, 2.0][: (end >= len(welcome + first)) + (end >= len(stream))] for end in ends]
    assert links[: len(ends)] == expected
    assert links[len(ends) : 2 * len(ends)] == [[1.0, 2.0]] * len(ends)


@STAND_IN
@sailed
async def test_a_client_that_is_cancelled_as_its_connection_ends_ends(database):
    client = Listener(database.port)
    client.register("A")

    def fail(message):
        task.cancel()
        raise WireError("nonsense")

    client._deliver = fail
    task = asyncio.create_task(client.run())
    await until(lambda: client.connected)
    database.post("A", 1.0)
    await asyncio.wait([task], timeout=60.0)
    assert task.cancelled()
