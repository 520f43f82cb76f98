"""Whatever bytes a log holds, it is read and aligned or refused in one sentence, in bounded time and memory."""

import resource
import signal
import struct
import threading
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from tests.support.ardupilot import dataflash, tlog
from tests.support.bags import NS, START, STEPS, unindexed, write_bag
from tests.support.ulogs import boat
from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ardupilot.dataflash import DataFlash
from usvlearn.logs.formats.ardupilot.tlog import Tlog
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.px4.ulog import Ulog
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.read import read_recordings
from usvlearn.logs.recordings import align_fleet

SECONDS, MEGABYTES = 20, 400  # of one log of some kB: a bag whose message types are large compiles them for a while
TOKENS = [
    b"nan", b"inf", b"-1", b"1e999", b"-1e308", b"9" * 400, b"1e18", b",", b",,,,", b"\n", b"\r", b'"', b"\0",
    b"\0" * 64, b" ", b"\t", b"%%", b"\x1b[31m", b"\xff\xfe", b"\xef\xbb\xbf", b"_", b"0x1", "٣".encode(),
    b"2025-02-30 25:61:61", b"0001-01-01T00:00:00+23:59", b"[", b"[4000000000]", b"[]", b"std_msgs/Empty[] ", b"time",
    b"string",
    *(struct.pack("<I", x) for x in (0, 1, 255, 2**16, 2**31 - 1, 2**31, 2**32 - 1)),
    *(struct.pack("<Q", x) for x in (2**32, 2**40, 2**63 - 1, 2**63, 2**64 - 1)),
    *(struct.pack("<d", x) for x in (np.nan, np.inf, -1e308, 5e-324)),
]  # fmt: skip
CHANNELS = {
    "command_left": {"name": "l", "held": True},
    "command_right": {"name": "r", "held": True},
    "heading": {"name": "psi", "unit": "deg"},
    "surge": {"name": "v"},
}
ROS1 = {
    "command_left": {"name": "*left_thruster", "span": 36.5 * STEPS},
    "command_right": {"name": "usv/right_thruster", "span": STEPS},
    "heading": {"name": "*right_thruster", "unit": "deg"},
    "surge": {"name": "*velocity", "field": "x, y", "span": 5 * STEPS},
}
ULOG = {
    "command_left": {"name": "motors", "field": "control[0]"},
    "command_right": {"name": "motors", "field": "control[1]"},
    "heading": {"name": "motion", "field": "psi", "unit": "deg"},
    "surge": {"name": "motion", "field": "v"},
}
ROS2 = {name: {"name": each["name"]} for name, each in CHANNELS.items()}
ARDUPILOT = {
    "command_left": {"name": "RCOU", "field": "throttle_left"},
    "command_right": {"name": "RCOU", "field": "throttle_right"},
    "heading": {"name": "A*", "field": "Yaw", "unit": "deg"},
    "yaw_rate": {"name": "IMU[1]", "field": "GyrZ"},
    "surge": {"name": "XKF1", "field": "VN,VE"},
}
MAVLINK = {
    "command_left": {"name": "SERVO*", "field": "throttle_left"},
    "command_right": {"name": "SERVO_OUTPUT_RAW", "field": "servo3_raw", "zero": 1500, "span": -400},
    "heading": {"name": "ATTITUDE@1.1", "field": "yaw"},
    "surge": {"name": "VFR_HUD", "field": "groundspeed"},
}


def rows() -> np.ndarray:
    t = 0.1 * np.arange(60)
    return np.stack([t, 0.5 + 0.1 * np.sin(t), 0.4 + 0 * t, 20 * t, 1.5 + 0.2 * np.cos(t)], 1)


def table(_) -> bytes:
    return b"t,l,r,psi,v\n" + b"".join(b"%.2f,%.3f,%.3f,%.2f,%.3f\n" % tuple(row) for row in rows())


def dated(_) -> bytes:
    stamped = (b"2025-07-24 17:18:%06.3f,%.3f,%.3f,%.2f,%.3f\n" % tuple(row) for row in rows())
    return b"t,l,r,psi,v\n" + b"".join(stamped)


def german(_) -> bytes:
    """A semicolon, decimal commas, units, cp1252, a line above the header, and comments."""
    lines = [b"%.2f;%.3f;%.3f;%.2f;%.3f\n" % tuple(row) for row in rows()]
    lines[20:20] = [b"# note; 1; 2\n"]
    head = "Logger 3,1\nZeit (s);l;r;psi (°);v (m/s)\n".encode("cp1252")
    return head + b"".join(lines).replace(b".", b",")


def day_first(_) -> bytes:
    stamped = (b"24.07.2025\t17:18:%06.3f\t%.3f\t%.3f\t%.2f\t%.3f\n" % tuple(row) for row in rows())
    return ("Date\tTime\tl\tr\tpsi\tv\n\ts\t%\t%\tdeg\tm/s\n" + b"".join(stamped).decode()).encode("utf-16")


def spaced(_) -> bytes:
    return b"// run 3\n t   l r psi v\n" + b"".join(b"%6.2f  %.3f %.3f %7.2f %.3f\n" % tuple(row) for row in rows())


def px4(_) -> bytes:
    return boat(rows())


def alog(_) -> bytes:
    lines = [b"%% LOGSTART 1.5e9\n"]
    for t, *values in rows():
        lines += [
            b"%.3f %s iApp:aux %.4f\n" % (t, name, x)
            for name, x in zip((b"l", b"r", b"psi", b"v"), values, strict=True)
        ]
    return b"".join(lines)


def bag(compression: str) -> Callable[[Path], bytes]:
    return lambda folder: write_bag(folder / "a.bag", compression).read_bytes()


def scanned(compression: str) -> Callable[[Path], bytes]:
    return lambda folder: unindexed(bag(compression)(folder))


def ros2(plugin: str) -> Callable[[Path], bytes]:
    def made(folder: Path) -> bytes:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS2_HUMBLE)
        number = store.types["std_msgs/msg/Float64"]
        with Writer(folder / "run", version=9, storage_plugin=StoragePlugin[plugin]) as recording:
            kind = number.__msgtype__
            connections = [
                recording.add_connection(f"/{each['name']}", kind, typestore=store) for each in ROS2.values()
            ]
            for k in range(STEPS):
                for connection in connections:
                    recording.write(connection, START + k * NS // 10, store.serialize_cdr(number(data=0.01 * k), kind))
        (path,) = (folder / "run").glob("run*.[md]*")
        return path.read_bytes()

    return made


FORMATS = {  # what makes a whole log, its name, its reader and channels
    "csv": (table, "a.csv", Table("t"), CHANNELS),
    "csv with dates": (dated, "a.csv", Table("t"), CHANNELS),
    "csv of semicolons": (german, "a.csv", Table("Zeit"), CHANNELS),
    "csv of tabs": (day_first, "a.csv", Table("Date+Time"), CHANNELS),
    "csv of spaces": (spaced, "a.csv", Table("t"), CHANNELS),
    "ulog": (px4, "a.ulg", Ulog(), ULOG),
    "alog": (alog, "a.alog", Alog(), CHANNELS),
    **{f"bag {kind}": (bag(kind), "a.bag", Rosbag(), ROS1) for kind in ("none", "bz2", "lz4")},
    **{f"scan {kind}": (scanned(kind), "a.bag.active", Rosbag(), ROS1) for kind in ("none", "bz2", "lz4")},
    "mcap": (ros2("MCAP"), "a.mcap", Rosbag(), ROS2),
    "dataflash": (lambda _: dataflash(), "a.BIN", DataFlash(), ARDUPILOT),
    "tlog": (lambda _: tlog(), "a.tlog", Tlog(), MAVLINK),
    "db3": (ros2("SQLITE3"), "a.db3", Rosbag(), ROS2),
}


def mutated(rng: np.random.Generator, whole: bytes) -> bytes:
    """Up to four changes: bits, bytes, tokens, parts that are lost, doubled or put elsewhere."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 5)):
        if not data:
            break
        place, length = (
            int(rng.integers(len(data))),
            int(rng.integers(1, 1 + min(len(data), 4 ** int(rng.integers(1, 6))))),
        )
        token = TOKENS[rng.integers(len(TOKENS))]
        match rng.integers(8):
            case 0:
                data[place] ^= 1 << int(rng.integers(8))
            case 1:
                data[place : place + length] = rng.bytes(length)
            case 2:
                data[place : place + len(token)] = token
            case 3:
                data[place:place] = token
            case 4:
                del data[place : place + length]
            case 5:
                data[place:place] = data[place : place + length]
            case 6:
                del data[place:]
            case _:
                other = int(rng.integers(len(data)))
                data[place:place] = data[other : other + length]
    return bytes(data)


class Stalled(BaseException):
    """Not an Exception, so that no reader takes it for damage."""


@contextmanager
def in_time(seconds: int):
    def stalled(*_):
        raise Stalled

    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGALRM, stalled)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def assert_one_sentence(text: str) -> None:
    assert text.isprintable() and len(text) < 6000, text  # 60 names of 60 characters


def survey_or_refuse(reader, path: Path) -> bool:
    """Survey a log; whether it is read."""
    try:
        series = reader.survey(path)
    except LogFormatError as error:
        assert_one_sentence(str(error))
        return False
    for each in series:
        assert len(each.time) == len(each.value) == len(each.order) and np.isfinite(each.time).all()
    return True


@pytest.mark.fuzz(cases=60, slow=10_000)
@pytest.mark.parametrize("name", FORMATS)
def test_a_log_is_read_or_refused(tmp_path, rng, cases, name):
    pytest.importorskip("rosbags", reason="needs the package rosbags")
    pytest.importorskip("pyulog", reason="needs the package pyulog")
    make, file, reader, channels = FORMATS[name]
    with TemporaryDirectory() as folder:
        whole = make(Path(folder))
    path, read, surveyed = tmp_path / file, 0, 0
    path.write_bytes(whole)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        align_fleet(read_recordings(path, reader, channels))  # whole it is read; and what is compiled, is compiled now
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(cases):
        path.write_bytes(mutated(rng, whole))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                with in_time(SECONDS):
                    surveyed += survey_or_refuse(reader, path)
                    fleet = align_fleet(read_recordings(path, reader, channels))
            except LogFormatError as error:
                assert_one_sentence(str(error))
            else:
                read += 1
                assert all(np.isfinite(run.samples.surge[run.samples.measured]).all() for run in fleet.runs)
        for warning in caught:
            assert warning.category is UserWarning, str(warning)  # what was recovered, or left out
            assert_one_sentence(str(warning.message))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < MEGABYTES * 1024
    assert 0.02 * cases < read < cases  # the mutations are neither harmless nor all deadly
    assert surveyed > 0.02 * cases
    print(f"{name}: {read} of {cases} read, {surveyed} surveyed, the others refused; {grown / 1024:.0f} MB")
