"""A stand-in for a MOOSDB: what a client sees of one, on loopback, and the faults that it can have.

It keeps one value a variable, fixes a variable's type at the first post, sends the last value to whoever registers,
answers timing messages, and refuses a second client of one name.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from tests.support.loopback import Loopback
from usvlearn.live.moos import wire
from usvlearn.live.moos.wire import Message, WireError


class _Link:
    """One connected client."""

    def __init__(self, name: str, writer: asyncio.StreamWriter):
        self.name, self.writer = name, writer
        self.registered: set[str] = set()

    def send(self, message: Message) -> None:
        self.writer.write(wire.encode([message]))


class Moosdb:
    """The database; all methods but `in_thread` belong to the loop that it runs in.

    Attributes:
        posted: all that was accepted, in order.
        refused: posts of another type than the variable's first.
        values: variable -> its last post.
    """

    def __init__(self, warp: float = 1.0):
        self.port, self.warp = 0, warp
        self.posted: list[Message] = []
        self.refused: list[Message] = []
        self.values: dict[str, Message] = {}
        self.links: dict[str, _Link] = {}
        self._loopback = Loopback(self._serve)
        self._awake: asyncio.Event | None = None

    def now(self) -> float:
        return self.warp * time.time()

    async def start(self) -> None:
        """Begin to listen, on the port of before if there was one."""
        self._awake = asyncio.Event()
        self._awake.set()
        self.port = self._loopback.start(self.port)

    def kill(self) -> None:
        """End as after SIGKILL: all connections break, and all values are lost."""
        self._loopback.close()
        self.links, self.values = {}, {}

    def freeze(self) -> None:
        """Neither read nor write, as after SIGSTOP; connections stay open."""
        assert self._awake
        self._awake.clear()

    def thaw(self) -> None:
        assert self._awake
        self._awake.set()

    def post(self, key: str, value: float | str, source: str = "boat", at: float | None = None, aux: str = "") -> None:
        """As if a client had posted it; `at` is its stamp, MOOS time."""
        text = isinstance(value, str)
        number, words = (wire.NOTHING, str(value)) if text else (float(value), "")
        kind = wire.TEXT if text else wire.NUMBER
        self._accept(Message(wire.NOTIFY, key, kind, number, words, self.now() if at is None else at, source, aux))

    def inject(self, raw: bytes) -> None:
        """Send bytes to every client."""
        for link in self.links.values():
            link.writer.write(raw)

    def _accept(self, message: Message) -> None:
        before = self.values.get(message.key)
        if before is not None and before.data != message.data:
            self.refused.append(message)
            return
        self.values[message.key] = message
        self.posted.append(message)
        for link in self.links.values():
            if message.key in link.registered:
                link.send(message)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        link = None
        try:
            link = await self._welcome(reader, writer)
            while link is not None and self._awake:
                messages = await wire.read(reader)
                await self._awake.wait()
                for message in messages:
                    self._handle(link, message)
        except (OSError, asyncio.IncompleteReadError, WireError):
            pass
        finally:
            if link is not None and self.links.get(link.name) is link:
                del self.links[link.name]

    async def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> _Link | None:
        async with asyncio.timeout(5.0):
            if await reader.readexactly(len(wire.PROTOCOL)) != wire.PROTOCOL:
                return None
            (hello,) = await wire.read(reader)
        assert self._awake
        await self._awake.wait()
        if hello.kind != wire.DATA or hello.text in self.links:
            reason = f'A client of this name ("{hello.text}") already exists'
            writer.write(wire.encode([Message(wire.POISON, data=wire.TEXT, text=reason)]))
            await writer.drain()
            writer.close()
            return None
        link = self.links[hello.text] = _Link(hello.text, writer)
        skew = self.now() - hello.time
        link.send(Message(wire.WELCOME, "", wire.NUMBER, skew, hello.key, self.now(), community="usv"))
        return link

    def _handle(self, link: _Link, message: Message) -> None:
        kind, key = message.kind, message.key
        if kind == wire.NOTIFY:
            self._accept(message._replace(community=message.community or "usv"))
        elif kind == wire.REGISTER:
            link.registered.add(key)
            if key in self.values:
                link.send(self.values[key])
        elif kind == wire.TIMING:
            link.send(message._replace(value=self.now(), value2=0.0))

    async def _end(self) -> None:
        """Cancel what still runs in this loop, and let the transports close."""
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)
        await asyncio.sleep(0.05)

    @contextlib.contextmanager
    def in_thread(self) -> Iterator[Callable[..., None]]:
        """Run in a thread of its own; yields what calls a method there and waits: `call(db.post, "A", 1.0)`."""
        loop = asyncio.new_event_loop()
        thread = threading.Thread(target=loop.run_forever)
        thread.start()

        def call(method: Callable[..., object], *arguments: object, **named: object) -> None:
            async def work() -> None:
                result = method(*arguments, **named)
                if asyncio.iscoroutine(result):
                    await result

            asyncio.run_coroutine_threadsafe(work(), loop).result(20)

        try:
            call(self.start)
            yield call
            call(self.kill)
        finally:
            call(self._end)
            loop.call_soon_threadsafe(loop.stop)
            thread.join()
            loop.close()
