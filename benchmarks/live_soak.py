"""A day of sailing over MOOS, as fast as the node takes it, while the database is killed again and again.

python benchmarks/live_soak.py [HOURS [RESTARTS]]       writes docs/benchmarks/live_soak.md

This program plays the boat and the database; the node is a process of its own. Before each kill the node is given time
to read what is on the way, so nothing may be lost: what it publishes is compared with a node that is given the same
messages without a network. (Messages in flight at a kill are lost; the tests kill without warning.)
"""

from __future__ import annotations

import asyncio
import math
import sys
import tempfile
import time
from array import array
from collections.abc import Iterator
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
from live_moos import BURST_PACKET, Voyage, options
from pages import publish
from timing import machine, table

from usvlearn.live.moos.block import MIDDLEWARE
from usvlearn.live.moos.wire import Message
from usvlearn.live.session import Session
from usvlearn.logs.channels.channel import Recording
from usvlearn.simulate.fleet import fleet

HOURS, RESTARTS = 24.0, 100
SCALE = {"command_left": 100.0, "command_right": 100.0, "heading": 180 / math.pi, "surge": 1.0}
IDLE = 0.5  # s without a post, after which the node has read all
SAMPLES = 24  # of the memory
SAVE = 15.0  # s between two saves


class Day(Voyage):
    """A node that sails for a day, and what it published."""

    def __init__(self, folder: Path):
        super().__init__(None, folder, [f"save_period = {SAVE}"])
        self.values, self.stamps, self.gaps = array("d"), array("d"), array("d")
        self.heard = time.monotonic()

    def take(self, message: Message) -> None:
        super().take(message)
        self.heard = time.monotonic() if message.key.startswith("USV_SPEED") else self.heard
        if message.key == "USV_SPEED_NEXT":
            self.values.append(message.value)
            self.stamps.append(message.time)
        elif message.key == "PUSVLEARN_ITER_GAP":
            self.gaps.append(message.value)

    async def rest(self) -> None:
        """Wait until the node has read all."""
        await self.link.drain()
        self.heard = time.monotonic()
        while time.monotonic() - self.heard < IDLE:
            await asyncio.sleep(IDLE / 10)


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


def sail(hours: float, restarts: int) -> tuple[Day, list[float], float]:
    """The node's posts, its memory as the day went by, MB, and the day's length, s."""
    resident: list[float] = []
    took = 0.0
    packets = math.ceil(sum(1 for _ in rows(hours, START)) / BURST_PACKET)  # now: a database that is busy seems frozen

    async def work(day: Voyage) -> None:
        nonlocal took
        assert isinstance(day, Day) and day.process
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
        day = Day(Path(folder))
        asyncio.run(day.run(work))
    return day, resident, took


def alone(hours: float) -> list[float]:
    """The same messages, to a node without a network."""
    with tempfile.TemporaryDirectory() as folder, Session(options(Path(folder)), MIDDLEWARE) as session:
        session.start()
        session.wait()
        steps = (step for row in rows(hours, START) for step in session.push(*row))
        return [step.next for step in steps if math.isfinite(step.next)]


START = math.ceil(time.time()) + 3600.0  # so that no message is as old as a last value of the database


def main() -> None:
    given = [float(each) for each in sys.argv[1:]]
    hours = given[0] if given else HOURS
    restarts = int(given[1]) if len(given) > 1 else RESTARTS
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
        "# A day of sailing over MOOS",
        "",
        f"Measured by `python benchmarks/live_soak.py`: {hours:g} h of a simulated boat, {restarts} kills of the",
        f"database, a save every {SAVE:g} s. {machine()}.",
        "",
        *table(["", "found"], facts),
        "",
    ]
    publish(__file__, text)


if __name__ == "__main__":
    main()
