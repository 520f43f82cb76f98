"""A real MOOSDB as a process, with the methods of the stand-in that make sense for one.

A MOOSDB listens on every interface. It is started only where loopback is the only one, as in a network namespace.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import socket
import subprocess
import sys

import pytest

from tests.support import ROOT

PORT = 9100
ISOLATED = ("unshare", "--map-root-user", "--net")  # runs a command in a network namespace of its own


def why_not() -> str:
    """Why no real MOOSDB can be started here; empty if it can."""
    if shutil.which("MOOSDB") is None:
        return "no MOOSDB is on PATH"
    if {name for _, name in socket.if_nameindex()} - {"lo"}:
        return "a MOOSDB listens on every interface, and here is one beside loopback; another test isolates it"
    return ""


def run_isolated(file: str) -> None:
    """Run the tests of a file that use a real database in a network namespace of their own; skip where that cannot be.

    Args:
        file: the test module.
    """
    if shutil.which("MOOSDB") is None:
        pytest.skip("no MOOSDB is on PATH")
    if not why_not():
        pytest.skip("this is the run in a network of its own")
    if shutil.which("unshare") is None or subprocess.run([*ISOLATED, "true"], capture_output=True).returncode:
        pytest.skip("no network namespace can be made here, and a MOOSDB listens on every interface")
    tests = f"'{sys.executable}' -m pytest -q -p no:cacheprovider -m '' -k 'real and not against' '{file}'"
    done = subprocess.run(
        [*ISOLATED, "sh", "-c", f"ip link set lo up && {tests}"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout


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
