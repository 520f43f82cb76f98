"""What it costs to read a long log: seconds of the processor and peak memory of each format.

python benchmarks/readers.py [MB] [FORMAT ...]        writes readers.md if no format is named; needs the extra logs

The logs are written for this: a boat at 50 Hz with 12 more signals that are not read.
"""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from accuracy import publish
from timing import machine, table

from usvlearn.logs.alog import Alog
from usvlearn.logs.channel import Source
from usvlearn.logs.csv_table import Table
from usvlearn.logs.read import Reader
from usvlearn.logs.rosbag import Rosbag
from usvlearn.logs.ulog import Ulog

MB = 1_000_000
RATE = 50  # Hz
CHANNELS = ("command_left", "command_right", "heading", "surge")
OTHERS = tuple(f"other_{k}" for k in range(12))
NAMES = (*CHANNELS, *OTHERS)
START = 1_750_000_000  # s since 1970


def rows() -> Iterator[tuple[float, list[float]]]:
    """Endless rows of time, s, and the value of each name."""
    k = 0
    while True:
        t = k / RATE
        boat = [0.5 + 0.3 * math.sin(0.1 * t), 0.5 + 0.3 * math.sin(0.13 * t), (3 * t) % 360, 1.5 + math.sin(0.05 * t)]
        yield t, [*boat, *(math.sin(t / (2 + n)) for n in range(len(OTHERS)))]
        k += 1


def write_text(path: Path, size: int, head: str, line: Callable[[float, list[float]], str]) -> None:
    with path.open("w") as file:
        written = file.write(head)
        for t, values in rows():
            if written >= size:
                return
            written += file.write(line(t, values))


def write_csv(path: Path, size: int) -> None:
    write_text(
        path, size, f"time,{','.join(NAMES)}\n", lambda t, x: f"{t:.2f}," + ",".join(f"{v:.6f}" for v in x) + "\n"
    )


def write_german(path: Path, size: int) -> None:
    def line(t: float, values: list[float]) -> str:
        stamp = time.strftime("%d.%m.%Y %H:%M:%S", time.gmtime(START + int(t)))
        return f"{stamp},{int(100 * (t % 1)):02};" + ";".join(f"{v:.6f}" for v in values).replace(".", ",") + "\n"

    write_text(path, size, f"time;{';'.join(NAMES)}\n", line)


def write_alog(path: Path, size: int) -> None:
    def line(t: float, values: list[float]) -> str:
        return "".join(
            f"{t:<15.3f} {name:<20} pBoat           {v:.6f}\n" for name, v in zip(NAMES, values, strict=True)
        )

    write_text(path, size, f"%% LOGSTART {START}\n", line)


def write_ulog(path: Path, size: int) -> None:
    def block(kind: bytes, data: bytes) -> bytes:
        return struct.pack("<Hc", len(data), kind) + data

    with path.open("wb") as file:
        fields = ";".join(f"float {name}" for name in NAMES)
        written = file.write(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0))
        written += file.write(block(b"F", f"boat:uint64_t timestamp;{fields};".encode()))
        written += file.write(block(b"A", struct.pack("<BH", 0, 0) + b"boat"))
        for t, values in rows():
            if written >= size:
                return
            written += file.write(block(b"D", struct.pack(f"<HQ{len(values)}f", 0, round(1e6 * t), *values)))


def write_ros1(path: Path, size: int) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS1_NOETIC), "std_msgs/msg/Float64"
    with Writer(path) as bag:
        _messages(bag, kind, store, lambda message: store.serialize_ros1(message, kind), lambda: path, size)


def write_ros2(plugin: str) -> Callable[[Path, int], None]:
    def write(path: Path, size: int) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        store, kind = get_typestore(Stores.ROS2_HUMBLE), "std_msgs/msg/Float64"
        folder = path.with_suffix("")
        with Writer(folder, version=9, storage_plugin=StoragePlugin[plugin]) as bag:
            _messages(
                bag, kind, store, lambda message: bytes(store.serialize_cdr(message, kind)),
                lambda: next(folder.glob(f"*{path.suffix}"), path), size,
            )  # fmt: skip
        next(folder.glob(f"*{path.suffix}")).rename(path)

    return write


def _messages(bag: Any, kind: str, store: Any, data: Callable, file: Callable[[], Path], size: int) -> None:
    connections = [bag.add_connection(f"/{name}", kind, typestore=store) for name in NAMES]
    for k, (t, values) in enumerate(rows()):
        if k and k % 1000 == 0 and file().exists() and file().stat().st_size >= size:
            return
        for connection, value in zip(connections, values, strict=True):
            bag.write(connection, int(1e9 * (START + t)), data(store.types[kind](data=value)))


class Format(NamedTuple):
    """How a log of a format is written and read."""

    suffix: str
    write: Callable[[Path, int], None]  # path, least bytes
    reader: Reader
    sources: dict[str, Source]


NAMED = {name: Source(name) for name in CHANNELS}
FORMATS = {  # a new one is a line here
    "CSV": Format(".csv", write_csv, Table("time"), NAMED),
    "CSV, decimal comma, day first": Format(".csv", write_german, Table("time"), NAMED),
    "MOOS": Format(".alog", write_alog, Alog(), NAMED),
    "ROS 1": Format(".bag", write_ros1, Rosbag(), NAMED),
    "ROS 2, mcap": Format(".mcap", write_ros2("MCAP"), Rosbag(), NAMED),
    "ROS 2, db3": Format(".db3", write_ros2("SQLITE3"), Rosbag(), NAMED),
    "ULog": Format(".ulg", write_ulog, Ulog(), {name: Source("boat", field=name) for name in CHANNELS}),
}


def memory() -> float:
    """The most memory that this process had, MB, as Linux tells it (`getrusage` counts what the parent had)."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def measure(name: str, small: Path, path: Path, survey: bool) -> None:
    """Read, or survey, a log in this process, and print what it cost."""
    one = FORMATS[name]
    one.reader.read(small, one.sources)  # what is imported and compiled at the first log is not measured
    before, began = memory(), time.process_time()
    if survey:
        found = len(one.reader.survey(path))
    else:
        channels, _ = one.reader.read(path, one.sources)
        found = sum(len(channel.time) for channel in channels.values())
    print(json.dumps([time.process_time() - began, memory() - before, found]))


def child(*arguments: str) -> list[float]:
    done = subprocess.run([sys.executable, __file__, *arguments], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main(size: int, names: list[str]) -> None:
    lines = []
    for name in names or FORMATS:
        with tempfile.TemporaryDirectory() as folder:
            small, path = (Path(folder) / f"{which}{FORMATS[name].suffix}" for which in ("small", "log"))
            FORMATS[name].write(small, MB // 50)
            FORMATS[name].write(path, size * MB)
            seconds, peak, values = child("--read", name, str(small), str(path))
            surveyed, most, series = child("--survey", name, str(small), str(path))
            lines.append([
                name, f"{path.stat().st_size / MB:.0f}", f"{values:.2g}", f"{seconds:.1f}", f"{peak:.0f}",
                f"{series:.0f}", f"{surveyed:.1f}", f"{most:.0f}",
            ])  # fmt: skip
            print(*lines[-1], sep=" | ", flush=True)
    if not names:
        publish(
            Path(__file__).with_suffix(".md"),
            [
                "# Readers",
                "",
                f"Measured by `python benchmarks/readers.py` on: {machine()}.",
                "",
                f"A log of about {size} MB with {len(NAMES)} signals at {RATE} Hz: four of them are read as channels,",
                "or all are surveyed. Seconds are of the processor; memory is what the process grew by.",
                "",
                *table(["format", "MB", "values read", "s", "peak, MB", "series", "survey, s", "peak, MB"], lines),
            ],
        )


if __name__ == "__main__":
    warnings.simplefilter("ignore", UserWarning)
    if sys.argv[1:2] in (["--read"], ["--survey"]):
        measure(sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]), sys.argv[1] == "--survey")
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 100, sys.argv[2:])
