"""Small logs of ArduPilot: DataFlash (`.BIN`) and MAVLink telemetry (`.tlog`)."""

import struct

import numpy as np

from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES

PACKED = {**{letter: letter for letter in "bBhHiIqQfd"}, "g": "e", "n": "4s", "N": "16s", "Z": "64s", "a": "64s",
          "M": "B", "c": "h", "C": "H", "e": "i", "E": "I", "L": "i"}  # fmt: skip
LAYOUTS = {  # name: type, format, fields, units, multipliers
    "PARM": (64, "QNff", "TimeUS,Name,Value,Default", "s---", "F---"),
    "UNIT": (65, "QbZ", "TimeUS,Id,Label", "s--", "F--"),
    "MULT": (66, "Qbd", "TimeUS,Id,Mult", "s--", "F--"),
    "FMTU": (67, "QBNN", "TimeUS,FmtType,UnitIds,MultIds", "s---", "F---"),
    "RCOU": (68, "QHHHH", "TimeUS,C1,C2,C3,C4", "sYYYY", "F----"),
    "ATT": (69, "Qcf", "TimeUS,Roll,Yaw", "sdh", "FB0"),
    "IMU": (70, "QBfi", "TimeUS,I,GyrZ,Temp", "s#Ev", "F-0C"),
    "XKF1": (71, "QBffff", "TimeUS,C,VN,VE,PN,PE", "s#nnmm", "F-0000"),
    "ARM": (72, "QB", "TimeUS,ArmState", "s-", "F-"),
    "EV": (73, "QB", "TimeUS,Id", "s-", "F-"),
    "MSG": (74, "QZ", "TimeUS,Message", "s-", "F-"),
}
UNITS = {
    "s": "s",
    "Y": "us",
    "d": "deg",
    "h": "degheading",
    "E": "rad/s",
    "n": "m/s",
    "m": "m",
    "v": "V",
    "#": "instance",
}
MULTIPLIERS = {"-": 0.0, "0": 1.0, "B": 1e-2, "C": 1e-3, "F": 1e-6}
PARAMETERS = {
    "SERVO1_FUNCTION": 73.0, "SERVO1_MIN": 1100.0, "SERVO1_TRIM": 1500.0, "SERVO1_MAX": 2000.0, "SERVO1_REVERSED": 0.0,
    "SERVO3_FUNCTION": 74.0, "SERVO3_MIN": 1000.0, "SERVO3_TRIM": 1500.0, "SERVO3_MAX": 1900.0, "SERVO3_REVERSED": 1.0,
}  # fmt: skip
SERVOS = {"command_left": Source("RCOU", "throttle_left"), "command_right": Source("RCOU", "throttle_right")}
STEP = 0.1  # s


def described(kind: int, name: str, letters: str, columns: str) -> bytes:
    """An FMT message."""
    size = 3 + struct.calcsize("<" + "".join(PACKED[letter] for letter in letters))
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, size, name.encode(), letters.encode(), columns.encode())


def logged(name: str, *values) -> bytes:
    """A message of `LAYOUTS`; values as they stand in the file, text as str."""
    kind, letters, *_ = LAYOUTS[name]
    packed = "<" + "".join(PACKED[letter] for letter in letters)
    raw = (value.encode() if isinstance(value, str) else value for value in values)
    return bytes([0xA3, 0x95, kind]) + struct.pack(packed, *raw)


def header(units: bool = True) -> bytes:
    """FMT of all messages, and their units."""
    content = described(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns")
    content += b"".join(described(kind, name, *rest[:2]) for name, (kind, *rest) in LAYOUTS.items())
    if units:
        content += b"".join(logged("UNIT", 0, ord(key), label) for key, label in UNITS.items())
        content += b"".join(logged("MULT", 0, ord(key), factor) for key, factor in MULTIPLIERS.items())
        content += b"".join(logged("FMTU", 0, kind, *rest[2:]) for kind, *rest in LAYOUTS.values())
    return content


def dataflash(steps: int = 60, parameters=PARAMETERS, events=(), units: bool = True) -> bytes:
    """A boat that goes ahead at 1.5 m/s on a slow turn; events are (step, message)."""
    content = header(units) + b"".join(logged("PARM", 0, name, value, 0.0) for name, value in parameters.items())
    for k in range(steps):
        us, psi = 5_000_000 + 100_000 * k, np.radians(10.0) + 0.02 * k
        content += b"".join(message for step, message in events if step == k)
        content += logged("RCOU", us, 1500 + 5 * k, 0, 1500 - 4 * k, 1500)
        content += logged("ATT", us + 10, -150, float(np.degrees(psi)))
        content += logged("IMU", us + 20, 0, 0.2, 21) + logged("IMU", us + 20, 1, 0.3, 22)
        content += logged("XKF1", us + 30, 0, 1.5 * np.cos(psi), 1.5 * np.sin(psi), 1.0 * k, 2.0 * k)
    return content


def frame(name: str, receipt: float, version: int = 2, sender=(1, 1), signed: bool = False, **values) -> bytes:
    """A record of a telemetry log: the time of receipt, s, and a frame with some of its values, the others zero."""
    number, message = next((number, each) for number, each in MESSAGES.items() if each.name == name)
    if unknown := set(values) - set(message.fields):
        raise KeyError(unknown)
    end = max(where.offset + np.dtype(where.dtype).itemsize for where in message.fields.values())
    payload = bytearray(end)
    for field, value in values.items():
        where = message.fields[field]
        raw = np.array([value], dtype=where.dtype).tobytes()
        payload[where.offset : where.offset + len(raw)] = raw
    return packet(number, message.extra, bytes(payload), receipt, version, sender, signed)


def packet(number, extra, payload, receipt=0.0, version=2, sender=(1, 1), signed=False) -> bytes:
    """A record with any payload."""
    if version == 2:
        payload = payload.rstrip(b"\0") or b"\0"
        head = struct.pack("<BBBBBB", len(payload), int(signed), 0, 7, *sender) + struct.pack("<I", number)[:3]
    else:
        head = struct.pack("<BBBBB", len(payload), 7, *sender, number)
    crc = 0xFFFF
    for byte in head + payload + bytes([extra]):  # bit by bit, as X.25 is defined
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    magic = b"\xfd" if version == 2 else b"\xfe"
    stamp = struct.pack(">Q", 1_700_000_000_000_000 + round(1e6 * receipt))
    return stamp + magic + head + payload + struct.pack("<H", crc) + (bytes(13) if signed else b"")


def tlog(steps: int = 60, armed_from: int = 0, parameters=PARAMETERS, version: int = 2) -> bytes:
    """The same boat, as a ground station heard it, 20 to 60 ms late."""
    content = b"".join(
        frame("PARAM_VALUE", 0.001 * k, version, param_id=name.encode(), param_value=value)
        for k, (name, value) in enumerate(parameters.items())
    )
    for k in range(steps):
        ms, psi, receipt = 5000 + 100 * k, np.radians(10.0) + 0.02 * k, 0.1 * k + 0.02 * (1 + k % 3)
        if k % 10 == 0:
            mode = 128 if k >= armed_from else 0
            content += frame("HEARTBEAT", receipt, version, type=11, autopilot=3, base_mode=mode)
            content += frame("HEARTBEAT", receipt, version, (255, 190), type=6, autopilot=8)
        widths = {"servo1_raw": 1500 + 5 * k, "servo3_raw": 1500 - 4 * k}
        content += frame("SERVO_OUTPUT_RAW", receipt, version, time_usec=1000 * ms, **widths)
        content += frame("ATTITUDE", receipt, version, time_boot_ms=ms, yaw=psi, yawspeed=0.2)
        content += frame("VFR_HUD", receipt, version, groundspeed=1.5)
        velocity = {"vx": 1.5 * np.cos(psi), "vy": 1.5 * np.sin(psi), "x": k, "y": 2 * k}
        content += frame("LOCAL_POSITION_NED", receipt, version, time_boot_ms=ms, **velocity)
    return content
