"""A client of a MOOSDB that stays connected for months, with asyncio.

It reconnects after every kind of end: the database is killed, frozen, restarted empty, or sends nonsense; or the name
is still taken by a connection that the database has not noticed to be dead. The database remembers registrations only
as long as a connection, so each connection begins with all of them. What is posted while there is no connection waits
in a bounded outbox, which drops the oldest first. What one turn of the loop posts leaves in one packet, and at once:
asyncio sets TCP_NODELAY.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Iterable

from usvlearn.errors import printable
from usvlearn.live.moos import wire
from usvlearn.live.moos.wire import Message, WireError

SILENCE = 5.0  # s without a packet: the database is gone or frozen, for it answers every timing message
BEAT = 0.5  # s between two checks for silence
BEATS = round(1.0 / BEAT)  # of them between two timing messages
PATIENCE = 5.0  # s for a connection and the handshake
FIRST, LONGEST = 0.25, 5.0  # s of back-off between two connections
OUTBOX = 1000  # messages that wait
UNSENT = 1 << 18  # bytes that the system has not accepted: above it, messages stay in the outbox
IN_PACKET = 100  # messages
REASON = 200  # characters of a refusal that are shown
APART, ABSURD = 0.1, 1e12  # s: clocks that differ by less are one, by more are none


class NameTakenError(Exception):
    """The database does not accept this client, usually because a client of its name is connected."""


class Client:
    """A connection to a MOOSDB that is renewed for ever."""

    def __init__(
        self,
        name: str,
        host: str,
        port: int,
        deliver: Callable[[Message], None],  # receives each message of a registered variable
        warp: float = 1.0,  # MOOSTimeWarp: MOOS time is Unix time times this
        clock: Callable[[], float] = time.time,
    ):
        self.name, self.host, self.port, self.warp = name, host, port, warp
        self.connected, self.community = False, ""  # whether the database has welcomed this client; its community
        self.trouble = "not yet connected"  # why there is no connection; empty while there is one
        self.counts: Counter[str] = Counter()  # connections, ends by cause, and "outbox": posts that were dropped
        self.round_trip = float("nan")  # s, of the latest timing message
        self.registered: set[str] = set()  # variables
        self._deliver, self._clock = deliver, clock
        self._offset = 0.0  # s, the database's MOOS time less ours, where they really differ
        self._outbox: deque[Message] = deque()
        self._writer: asyncio.StreamWriter | None = None
        self._flushing = False  # whether a flush is due in this turn of the loop
        self._timing = (0.0, 0.0)  # MOOS time and monotonic time of the latest timing message
        self._silent = 0  # beats since the latest packet
        self._backoff = FIRST

    def now(self) -> float:
        """MOOS time, s: the database's, if that differs from this computer's by more than a round trip explains."""
        return self._local() + self._offset

    def _local(self) -> float:
        return self.warp * self._clock()

    def register(self, variable: str) -> None:
        """Ask for all posts of a variable, now and after each reconnection."""
        self.registered.add(variable)
        self._send([self._registration(variable)])

    def notify(self, variable: str, value: float | str) -> None:
        """Post a number or a text to a variable, whose name has no blanks; it waits in the outbox for a connection."""
        message = Message(wire.NOTIFY, variable, time=self.now(), source=self.name)
        if isinstance(value, str):
            message = message._replace(data=wire.TEXT, text=value)
        else:
            message = message._replace(value=float(value))
        if len(self._outbox) >= OUTBOX:
            self._outbox.popleft()
            self.counts["outbox"] += 1
        self._outbox.append(message)
        if len(self._outbox) >= IN_PACKET:
            self._flush()  # much may be posted before the loop's next turn
        elif self.connected and not self._flushing:
            self._flushing = True
            asyncio.get_running_loop().call_soon(self._flush)

    def _flush(self) -> None:
        """Hand the outbox to the system, unless the database has stopped reading."""
        self._flushing, writer = False, self._writer
        while self._outbox and self.connected and writer and writer.transport.get_write_buffer_size() < UNSENT:
            self._send([self._outbox.popleft() for _ in range(min(IN_PACKET, len(self._outbox)))])

    def _send(self, messages: Iterable[Message]) -> None:
        if self._writer is not None and self.connected:
            self._writer.write(wire.encode(messages))

    def _registration(self, variable: str) -> Message:
        return Message(wire.REGISTER, variable, value=0.0, time=self.now(), source=self.name)  # 0 s between two posts

    async def run(self) -> None:
        """Connect, and connect again, until this task is cancelled."""
        while True:
            try:
                await self._live()
            except NameTakenError as error:
                self._ended("name_taken", f"the MOOSDB at {self.host}:{self.port} refuses {self.name}: {error}")
            except WireError as error:
                self._ended("garbage", f"the MOOSDB at {self.host}:{self.port} sent {error}")
            except TimeoutError:
                self._ended("silent", f"the MOOSDB at {self.host}:{self.port} was silent for {SILENCE:g} s")
            except (OSError, asyncio.IncompleteReadError):
                self._ended("lost" if self.connected else "unreachable", f"no MOOSDB at {self.host}:{self.port}")
            finally:
                self.connected = False
            await asyncio.sleep(self._backoff)
            self._backoff = min(2 * self._backoff, LONGEST)

    def _ended(self, cause: str, sentence: str) -> None:
        self.trouble = sentence
        self.counts[cause] += 1

    async def _live(self) -> None:
        """One connection, from its beginning to its end."""
        try:
            async with asyncio.timeout(PATIENCE):
                reader, self._writer = await asyncio.open_connection(self.host, self.port)
                await self._shake_hands(reader, self._writer)
            self.connected, self.trouble, self._silent = True, "", 0
            self.counts["connected"] += 1
            if self.registered:
                self._send(map(self._registration, self.registered))
            self._flush()
            await _first(self._beat(), self._read(reader))
        finally:
            writer, self._writer = self._writer, None
            if writer is not None:
                writer.transport.abort()  # what is unsent may never be accepted

    async def _shake_hands(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        hello = Message(wire.DATA, "asynchronous", wire.TEXT, text=self.name, time=self._local(), source=self.name)
        writer.write(wire.PROTOCOL + wire.encode([hello]))
        answer = (await wire.read(reader))[:1]
        if not answer or answer[0].kind not in (wire.WELCOME, wire.POISON):
            raise WireError("no welcome")
        if answer[0].kind == wire.POISON:
            raise NameTakenError(printable(answer[0].text[:REASON]) or "it gives no reason")
        self.community = answer[0].community

    async def _beat(self) -> None:
        """Send timing messages, and notice silence.

        Beats are counted, not seconds: when this program itself was held up, the packets that arrived in the meantime
        are read before the next beat.
        """
        beat = 0
        while True:
            if beat % BEATS == 0:
                self._timing = self._local(), time.monotonic()
                self._send([Message(wire.TIMING, "_async_timing", value=0.0, time=self._timing[0], source=self.name)])
                self._flush()
            await asyncio.sleep(BEAT)
            beat += 1
            self._silent += 1
            if self._silent * BEAT >= SILENCE:
                raise TimeoutError

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while True:
            messages = await wire.read(reader)
            self._silent, self._backoff = 0, FIRST
            for message in messages:
                if message.kind == wire.NOTIFY:
                    self._deliver(message)
                elif message.kind == wire.TIMING and message.time == self._timing[0]:
                    self._measure(message.value)

    def _measure(self, there: float) -> None:
        """The round trip and the offset of the database's clock, from the answer to the latest timing message."""
        sent, at = self._timing
        self.round_trip = time.monotonic() - at
        trip = self.warp * self.round_trip
        offset = there - (sent + trip / 2)
        self._offset = offset if max(trip, APART * self.warp) < abs(offset) < ABSURD else 0.0

    async def drain(self, seconds: float = 1.0) -> None:
        """Wait until the system has accepted all posts, for at most these seconds."""
        try:
            async with asyncio.timeout(seconds):
                while self.connected and self._writer is not None:
                    self._flush()
                    if not self._outbox and not self._writer.transport.get_write_buffer_size():
                        return
                    await asyncio.sleep(0.01)
        except TimeoutError:
            pass


async def _first(*works: Coroutine[None, None, None]) -> None:
    """Run until one of these ends, and end the others; raises what that one raised.

    A task group would not do: in Python 3.11 it forgets a cancellation that comes as one of its tasks fails.
    """
    tasks = [asyncio.ensure_future(each) for each in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for each in done:
            each.result()
    finally:
        for each in tasks:
            each.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
