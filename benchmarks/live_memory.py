"""What a live node takes at 10 Hz, stage by stage: resident memory, time of the processor.

python benchmarks/live_memory.py [SECONDS [HOURS [MODULE …]]]        prints the table of docs/benchmarks/live_memory.md

A node that starts from the prior gets messages of a simulated boat: heading, yaw rate and both commands at 10 Hz, the
speed at 5 Hz; for SECONDS in real time, then for HOURS as fast as it can. It predicts, learns, records, saves and
checks its data; only the middleware is missing, whose modules can be named: they are imported at the end. Run it where
no torch is installed, since what is installed counts: numba imports SciPy where it finds it. The first run compiles.
It reads /proc of Linux.
"""

from __future__ import annotations

import importlib
import itertools
import math
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

EVERY = {"heading": 1, "yaw_rate": 1, "command_left": 1, "command_right": 1, "surge": 2}  # a message in so many periods
PERIOD, SECOND, HOUR = 0.1, 10, 36_000  # s; periods
WARM_UP = 30.0  # s, after which the processor time is counted: the node has loaded its code, and saved once


def memory() -> dict[str, float]:
    """MB: resident, of which files such as libraries, of which its own (anonymous), and the most resident so far."""
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    found = {words[0].rstrip(":"): float(words[1]) / 1024 for words in lines if len(words) == 3 and words[2] == "kB"}
    return {name: found[name] for name in ("VmRSS", "RssFile", "RssAnon", "VmHWM")}


def processor() -> float:
    """Seconds of processor time of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def row(what: str) -> None:
    """Print a row of the table."""
    found = memory()
    print(f"| {what} | {found['VmRSS']:.0f} | {found['RssFile']:.0f} | {found['RssAnon']:.0f} | {processor():.1f} |")


def sailing() -> Iterator[dict[str, float]]:
    """The values of each channel, period by period, of a boat that follows its commands."""
    speed = 0.0
    for k in itertools.count():
        left, right = 0.5 + 0.3 * math.sin(0.005 * k), 0.5 + 0.3 * math.cos(0.003 * k)
        speed += PERIOD * (0.5 * (left + right) - 0.3 * speed * abs(speed))
        yield {"heading": 0.002 * k, "yaw_rate": 0.02, "command_left": left, "command_right": right,
               "surge": speed + 0.01 * math.sin(7.0 * k)}  # fmt: skip


def main(seconds: float, hours: float, modules: list[str]) -> None:
    """Run a node, and print its memory and processor time as a table."""
    print("| after | resident, MB | of which files | own | CPU, s |\n|---|---|---|---|---|")
    row("start of Python")
    import numpy  # noqa: F401

    row("import of numpy")
    import numba  # noqa: F401

    row("import of numba")
    from usvlearn.live.session import Session
    from usvlearn.live.start import Middleware, Options

    with tempfile.TemporaryDirectory() as folder:
        options = Options(Path(folder), mass=28.0, surge_max=2.74, record=True, save_period=10.0)
        channels = {name: {"name": name, "window": 0.4} for name in EVERY}
        with Session(options, Middleware("benchmark", "usvlearn.logs.formats.csv.table.Table", channels)) as session:
            session.start()
            while not session.wait():
                time.sleep(0.1)
            row("loading of compiled code")
            boat = enumerate(sailing())

            def sail() -> int:
                """One period; returns its number."""
                k, values = next(boat)
                for name, every in EVERY.items():
                    if k % every == 0:
                        session.push(name, 1e9 + k * PERIOD, values[name])
                if k % SECOND == 0:
                    session.tick()
                return k

            began, counted = time.monotonic(), (0.0, 0.0)
            while (now := time.monotonic() - began) < seconds:
                if not counted[0] and now >= min(WARM_UP, seconds / 2):
                    counted = now, processor()
                time.sleep(max(0.0, began + (sail() + 1) * PERIOD - time.monotonic()))
            share = (processor() - counted[1]) / (time.monotonic() - began - counted[0])
            row(f"{now:.0f} s in real time")
            for k in range(1, int(hours * HOUR) + 1):
                sail()
                if k % (HOUR // 2) == 0:
                    row(f"{k / HOUR:.1f} h as fast as it can")
            for module in modules:
                importlib.import_module(module)
                row(f"import of {module}")
            heavy = [name for name in ("scipy", "torch", "tensorboard") if name in sys.modules]
            print(f"\n{share:.1%} of a core in real time; at most {memory()['VmHWM']:.0f} MB resident; imported: "
                  f"{', '.join(heavy) or 'neither SciPy nor torch'}; {session.tick().sentence}")  # fmt: skip


if __name__ == "__main__":
    numbers = [float(each) for each in sys.argv[1:3]] + [300.0, 2.0][len(sys.argv[1:3]) :]
    main(*numbers, sys.argv[3:])
