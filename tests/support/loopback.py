"""A TCP server on loopback that leaves no connection open, whenever it is closed and whenever its loop ends."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Awaitable, Callable

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


class Loopback:
    """Hands each connection to a task of its own, and closes the connection when the task ends.

    asyncio's own server loses a connection that it has accepted and not yet handed on when it is closed (Python 3.11).
    """

    def __init__(self, serve: Serve):
        self._serve = serve
        self._listening: socket.socket | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    def start(self, port: int = 0) -> int:
        """Begin to listen in the loop that runs; returns the port, which is a free one for 0."""
        self._listening = socket.create_server(("127.0.0.1", port), backlog=100)
        self._listening.setblocking(False)
        asyncio.get_running_loop().add_reader(self._listening, self._accept, self._listening)
        return int(self._listening.getsockname()[1])

    def _accept(self, listening: socket.socket) -> None:
        try:
            connection, _ = listening.accept()
        except OSError:  # the client has left
            return
        connection.setblocking(False)
        task = asyncio.ensure_future(self._work(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        task.add_done_callback(lambda _: connection.close())  # also if the task was cancelled before its first step

    async def _work(self, connection: socket.socket) -> None:
        reader, writer = await asyncio.open_connection(sock=connection)
        try:
            await self._serve(reader, writer)
        finally:
            writer.transport.abort()

    def close(self) -> None:
        """Listen no longer, and close all connections."""
        assert self._listening
        asyncio.get_running_loop().remove_reader(self._listening)
        self._listening.close()
        for task in self._tasks:
            task.cancel()
