"""Small logs of PX4, written byte by byte as https://docs.px4.io/main/en/dev_log/ulog_file_format.html says."""

import struct
from collections.abc import Iterable

MAGIC = b"ULog\x01\x12\x35\x01"
START = 5_000_000  # us
CODES = {"uint64_t": "Q", "float": "f", "double": "d", "uint8_t": "B", "int32_t": "i", "char": "c", "bool": "?"}


def block(kind: str, data: bytes) -> bytes:
    return struct.pack("<Hc", len(data), kind.encode()) + data


def header(formats: dict[str, str]) -> bytes:
    """The head of a file; formats are texts such as `uint64_t timestamp;float[4] q;`."""
    head = MAGIC + struct.pack("<Q", START)
    return head + b"".join(block("F", f"{name}:{fields}".encode()) for name, fields in formats.items())


def parameters(**values: float) -> bytes:
    """Parameters; those of an int are integers."""
    blocks = []
    for name, value in values.items():
        kind, code = ("int32_t", "i") if isinstance(value, int) else ("float", "f")
        key = f"{kind} {name}".encode()
        blocks.append(block("P", bytes([len(key)]) + key + struct.pack("<" + code, value)))
    return b"".join(blocks)


def subscribe(number: int, name: str, instance: int = 0) -> bytes:
    return block("A", struct.pack("<BH", instance, number) + name.encode())


def message(number: int, microseconds: int, layout: str, *values: float) -> bytes:
    """A message with a stamp after the start, and further values laid out as `struct` describes."""
    return block("D", struct.pack("<HQ" + layout, number, START + microseconds, *values))


def boat(rows: Iterable[tuple[float, float, float, float, float]]) -> bytes:
    """A log of rows of time, left, right, heading in deg and speed."""
    formats = {"motors": "uint64_t timestamp;float[2] control;", "motion": "uint64_t timestamp;float psi;double v;"}
    data = [header(formats), subscribe(0, "motors"), subscribe(1, "motion")]
    for t, left, right, heading, speed in rows:
        data += [
            message(0, round(1e6 * t), "2f", left, right),
            message(1, round(1e6 * t) + 1, "fd", heading, speed),
        ]
    return b"".join(data)
