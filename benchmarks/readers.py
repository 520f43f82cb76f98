"""What it costs to read a long log: seconds of the processor and peak memory of each format.

python benchmarks/readers.py [MB] [FORMAT ...]        writes docs/benchmarks/readers.md if no format is named

The script needs the extra logs.

The logs are written for this: a boat at 50 Hz with 12 more signals that are not read.
"""

from __future__ import annotations

import functools
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

from pages import publish
from timing import machine, table

from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.dataflash import DataFlash
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES
from usvlearn.logs.formats.ardupilot.tlog import Tlog
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.px4.ulog import Ulog
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.read import Reader

MB = 1_000_000
RATE = 50  # Hz
CHANNELS = ("command_left", "command_right", "heading", "surge")
OTHERS = tuple(f"other_{k}" for k in range(12))
NAMES = (*CHANNELS, *OTHERS)
X25 = [functools.reduce(lambda crc, _: crc >> 1 ^ 0x8408 * (crc & 1), range(8), byte) for byte in range(256)]
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


def write_dataflash(path: Path, size: int) -> None:
    def described(kind: int, length: int, name: str, form: str, columns: str) -> bytes:
        texts = (name.encode(), form.encode(), columns.encode())
        return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, length, *texts)

    halves = {1: "BOAT", 2: "MORE"}  # a message has at most 16 columns, whose names take 64 characters
    with path.open("wb") as file:
        written = file.write(described(128, 89, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"))
        for kind, name in halves.items():
            columns = ",".join(["TimeUS", *(f"V{k}" for k in range(8))])
            written += file.write(described(kind, 43, name, "Qffffffff", columns))
        for t, values in rows():
            if written >= size:
                return
            for kind, part in zip(halves, (values[:8], values[8:]), strict=True):
                written += file.write(struct.pack("<BBBQ8f", 0xA3, 0x95, kind, round(1e6 * t), *part))


def write_tlog(path: Path, size: int) -> None:
    """Of ATTITUDE (30), VFR_HUD (74) and SERVO_OUTPUT_RAW (36), in MAVLink 1."""
    with path.open("wb") as file:
        written = 0
        for k, (t, x) in enumerate(rows()):
            if written >= size:
                return
            ms, pwm = round(1000 * t), [round(1500 + 400 * value) for value in (x[0], x[4], x[1], *x[5:10])]
            messages = {
                30: struct.pack("<I6f", ms, x[10], x[11], math.radians(x[2]), *x[12:15]),
                74: struct.pack("<4fhH", x[3], x[3], x[15], 0.0, round(x[2]), 50),
                36: struct.pack("<I8HB", 1000 * ms % 2**32, *pwm, 0),
            }
            if k % RATE == 0:
                messages[0] = struct.pack("<IBBBBB", 0, 11, 3, 128, 4, 3)  # HEARTBEAT of an armed boat
            for number, data in messages.items():
                head = struct.pack("<BBBBB", len(data), k % 256, 1, 1, number)
                check = _x25(head + data + bytes([MESSAGES[number].extra]))
                stamp = struct.pack(">Q", round(1e6 * (START + t)))
                written += file.write(stamp + b"\xfe" + head + data + struct.pack("<H", check))


def _x25(data: bytes) -> int:
    """The checksum of MAVLink, CRC-16/MCRF4XX."""
    found = 0xFFFF
    for byte in data:
        found = found >> 8 ^ X25[(found ^ byte) & 0xFF]
    return found


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
    "ArduPilot": Format(".BIN", write_dataflash, DataFlash(), {
        name: Source("BOAT", field=f"V{k}") for k, name in enumerate(CHANNELS)
    }),
    "MAVLink": Format(".tlog", write_tlog, Tlog(), {
        "command_left": Source("SERVO_OUTPUT_RAW", field="servo1_raw"),
        "command_right": Source("SERVO_OUTPUT_RAW", field="servo3_raw"),
        "heading": Source("ATTITUDE", field="yaw"),
        "surge": Source("VFR_HUD", field="groundspeed"),
    }),
    "ULog": Format(".ulg", write_ulog, Ulog(), {name: Source("boat", field=name) for name in CHANNELS}),
}  # fmt: skip


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
            __file__,
            [
                "# Time and memory of reading logs",
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
