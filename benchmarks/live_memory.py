"""Memory and processor time of a live node at 10 Hz: `python benchmarks/live_memory.py [SECONDS [MODULE…]]`.

A node that starts from the prior gets messages of a simulated boat in real time: heading, yaw rate and both commands at
10 Hz, the speed at 5 Hz. It predicts, learns, records and saves; only the middleware is missing, whose modules can be
named: they are imported at the end. Run it where no torch is installed, since what is installed counts: numba imports
SciPy where it finds it. The first run compiles. Linux only.
"""

from __future__ import annotations

import importlib
import math
import resource
import sys
import tempfile
import time
from pathlib import Path

RATES = {"heading": 1, "yaw_rate": 1, "command_left": 1, "command_right": 1, "surge": 2}  # one in so many periods
PERIOD = 0.1  # s
WARM_UP = 30.0  # s, until the processor time is counted: the node loads its code, and checks networks once


def memory() -> dict[str, float]:
    """MB: resident, of which files such as libraries, of which its own (anonymous)."""
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


def sail(seconds: float, modules: list[str]) -> None:
    """Run a node for some seconds, and print its memory and processor time as a table."""
    print("| after | resident, MB | of which files | own | CPU, s |\n|---|---|---|---|---|")
    row("start of Python")
    import numpy  # noqa: F401

    row("import of numpy")
    import numba  # noqa: F401

    row("import of numba")
    from usvlearn.live.session import Session
    from usvlearn.live.start import Middleware, Options

    with tempfile.TemporaryDirectory() as folder:
        options = Options(Path(folder), mass=28.0, surge_max=2.74, record=True, save_period=60.0)
        channels = {name: {"name": name} for name in RATES}
        with Session(options, Middleware("benchmark", "usvlearn.logs.csv_table.Table", channels)) as session:
            session.start()
            while not session.wait():
                time.sleep(0.1)
            row("loading of compiled code")
            began = time.monotonic()
            speed, counted, steps, k = 0.0, (0.0, 0.0), 0, 0
            while (now := time.monotonic() - began) < seconds:
                if not counted[0] and now >= min(WARM_UP, seconds / 2):
                    counted = now, processor()
                left, right = 0.5 + 0.3 * math.sin(0.05 * k * PERIOD), 0.5 + 0.3 * math.cos(0.03 * k * PERIOD)
                speed += PERIOD * (0.5 * (left + right) - 0.3 * speed * abs(speed))
                values = {"heading": 0.02 * k * PERIOD, "yaw_rate": 0.02, "command_left": left,
                          "command_right": right, "surge": speed + 0.01 * math.sin(7.0 * k)}  # fmt: skip
                for name, every in RATES.items():
                    if k % every == 0:
                        steps += len(session.push(name, 1e9 + k * PERIOD, values[name]))
                if k % 10 == 0:
                    session.tick()
                k += 1
                time.sleep(max(0.0, began + k * PERIOD - time.monotonic()))
            share = (processor() - counted[1]) / (time.monotonic() - began - counted[0])
            row(f"{now:.0f} s, {steps} steps")
            for module in modules:
                importlib.import_module(module)
                row(f"import of {module}")
            installed = [name for name in ("scipy", "torch", "tensorboard") if name in sys.modules]
            print(f"\n{share:.1%} of a core; at most {memory()['VmHWM']:.0f} MB resident; {len(sys.modules)} modules, "
                  f"of which {', '.join(installed) or 'neither SciPy nor torch'}")  # fmt: skip


if __name__ == "__main__":
    sail(float(sys.argv[1]) if sys.argv[1:] else 300.0, sys.argv[2:])
