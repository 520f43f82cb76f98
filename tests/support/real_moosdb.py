"""A real MOOSDB as a process, with the methods of the stand-in that make sense for one.

A MOOSDB listens on every interface. It is started only where loopback is the only one, as in a network namespace:

    unshare --map-root-user --net sh -c "ip link set lo up && pytest -k real tests/live/moos/test_client.py"
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import subprocess

PORT = 9100


def why_not() -> str:
    """Why no real MOOSDB can be started here; empty if it can."""
    if shutil.which("MOOSDB") is None:
        return "no MOOSDB is on PATH"
    if {name for _, name in socket.if_nameindex()} - {"lo"}:
        return "a MOOSDB listens on every interface, and here is one beside loopback: see tests/support/real_moosdb.py"
    return ""


class RealMoosdb:
    """The database."""

    def __init__(self) -> None:
        self.port = PORT
        self._process: subprocess.Popen[bytes] | None = None

    async def start(self) -> None:
        options = [
            f"--moos_port={self.port}",
            "--moos_community=usv",
            "--moos_suicide_disable",
            "--moos_no_colour",
        ]
        self._process = subprocess.Popen(["MOOSDB", *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(100):
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", self.port)
                writer.close()
                return
            except OSError:
                await asyncio.sleep(0.05)
        raise TimeoutError("the MOOSDB does not listen")

    def kill(self) -> None:
        self._signal(signal.SIGKILL)
        if self._process:
            self._process.wait()
            self._process = None

    def freeze(self) -> None:
        self._signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._signal(signal.SIGCONT)

    def _signal(self, number: signal.Signals) -> None:
        if self._process:
            os.kill(self._process.pid, number)
