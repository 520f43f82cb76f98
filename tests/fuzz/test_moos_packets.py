"""Mutated packets of MOOS: no error but the protocol's own, and no more memory than a packet may take."""

import asyncio
import contextlib
import struct
import tracemalloc

import numpy as np
import pytest

from tests.support.loopback import Loopback
from usvlearn.live.moos import client as module
from usvlearn.live.moos import wire
from usvlearn.live.moos.client import Client
from usvlearn.live.moos.wire import Message, WireError

TELLING = (-(2**31), -1, 0, 1, 8, 9, 53, 54, 63, 255, 2**16, wire.LARGEST, 2**31 - 1)  # as lengths and counts


def packet_of(rng: np.random.Generator) -> bytearray:
    def text() -> str:
        return bytes(rng.integers(0, 256, rng.integers(0, 12), np.uint8)).decode("utf-8", "surrogateescape")

    messages = [
        Message(rng.choice(list("NRUTiWK*")), text(), rng.choice(list("DSB")), rng.normal(), text(), source=text())
        for _ in range(rng.integers(0, 5))
    ]
    return bytearray(wire.encode(messages))


def mutate(rng: np.random.Generator, packet: bytearray) -> None:
    for _ in range(rng.integers(1, 4)):
        at, how = int(rng.integers(0, max(len(packet), 1))), rng.integers(5)
        if how == 0 and packet:
            packet[at % len(packet)] = rng.integers(256)
        elif how == 1 and len(packet) >= 4:
            struct.pack_into("<i", packet, at % (len(packet) - 3), int(rng.choice(TELLING)))
        elif how == 2:
            del packet[at:]
        elif how == 3:
            packet[at:at] = rng.integers(0, 256, rng.integers(1, 20), np.uint8).tobytes()
        else:
            packet += packet[at:]
    if rng.random() < 0.7 and len(packet) >= 4:
        struct.pack_into("<i", packet, 0, len(packet))  # so that the rest is looked at, too


@pytest.mark.thorough
@pytest.mark.fuzz(cases=3_000, slow=100_000)
def test_a_mutated_packet_is_read_or_refused(rng, cases):
    refused = 0
    tracemalloc.start()
    try:
        for case in range(cases):
            packet = packet_of(rng)
            mutate(rng, packet)
            try:
                messages = wire.decode(bytes(packet))
            except WireError:
                refused += 1
                continue
            assert len(messages) * wire.SMALLEST <= len(packet), case
            assert wire.decode(wire.encode(messages)) == messages or "nan" in repr(messages), case
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert cases / 10 < refused < cases
    assert peak < 1 << 20


@pytest.mark.fuzz(cases=200, slow=10_000)
def test_a_client_comes_back_after_each_mutated_packet(rng, cases, monkeypatch):
    monkeypatch.setattr(module, "FIRST", 0.0005)
    monkeypatch.setattr(module, "LONGEST", 0.0005)
    welcome = wire.encode([Message(wire.WELCOME, data=wire.NUMBER, text="asynchronous")])
    served: list[int] = []
    delivered: list[Message] = []

    async def serve(reader, writer):
        packet = packet_of(rng)
        mutate(rng, packet)
        served.append(len(packet))
        try:
            writer.write(welcome + packet)
            writer.write_eof()
            await reader.read()  # until the client has left
        except OSError:
            pass

    async def work():
        client = Client("a", "127.0.0.1", 0, delivered.append)
        server = Loopback(serve)
        client.port = server.start()
        task = asyncio.create_task(client.run())
        while len(served) < cases and not task.done():
            await asyncio.sleep(0.01)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        server.close()
        await asyncio.sleep(0.05)
        return client.counts

    counts = asyncio.run(work())
    assert counts["garbage"] > cases / 10 and counts["lost"] > cases / 20
    assert all(message.kind == wire.NOTIFY for message in delivered)
