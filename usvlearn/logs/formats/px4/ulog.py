"""PX4 logs (`.ulg`), read by the package pyulog: https://docs.px4.io/main/en/dev_log/ulog_file_format.html

Its parameters tell which motor and servo drives what: https://docs.px4.io/main/en/config/actuators.html
"""

from __future__ import annotations

import contextlib
import fnmatch
import io
import math
import re
import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError, MissingExtraError, printable
from usvlearn.logs.channels.channel import QUOTED, Channel, Source, build_channel, match_name
from usvlearn.logs.channels.series import ELEMENTS, Reader, Series, interleaved
from usvlearn.logs.formats.ros.message_fields import yaw

FIELDS = 50_000  # of all subscriptions of a log; a log of PX4 has some thousands
MARGIN = 100_000  # reads, and hundreds of bytes, beyond those that are in proportion to the size
DEEPEST = 10  # messages within each other
ELEMENT = re.compile(r"(.+)\[(\d+)\]")
CLOCKS = ("vehicle_gps_position", "sensor_gps")  # topics that tell the time in UTC
QUATERNIONS = ("q", "q_d")  # fields of attitudes, and of their setpoints
TOPICS = MOTORS, SERVOS, OUTPUTS = "actuator_motors", "actuator_servos", "actuator_outputs"
FUNCTION = re.compile(r"PWM_(MAIN|AUX)_FUNC(\d{1,2})")
FIRST = {MOTORS: 101, SERVOS: 201}  # values of PWM_MAIN_FUNCn
DRIVEN = ("throttle_left", "throttle_right", "throttle", "steering", "motor_1", "motor_2")
Topics = Mapping[str, Mapping[str, np.ndarray]]  # topic -> field -> (n,)


class _Topic(NamedTuple):
    """The messages of one topic and instance."""

    name: str  # with its instance, where that is not 0
    time: np.ndarray  # (n,) float64, s since the log's start
    fields: dict[str, np.ndarray]  # (n,) each, as logged

    def value(self, field: str, where: str) -> np.ndarray:
        """The numbers of a field, or the norm of several."""
        parts = [self._one(part.strip(), where) for part in field.split(",")]
        return parts[0] if len(parts) == 1 else np.array(list(map(math.hypot, *(part.tolist() for part in parts))))

    def _one(self, field: str, where: str) -> np.ndarray:
        if field in self.fields:
            return _floats(self.fields[field])
        quaternion = [self.fields.get(f"{field}[{place}]") for place in range(4)]  # w, x, y, z
        if field and all(part is not None for part in quaternion) and f"{field}[4]" not in self.fields:
            w, x, y, z = (part.tolist() for part in quaternion if part is not None)
            return np.array(list(map(yaw, x, y, z, w)), np.float64)
        names = ", ".join(name[:QUOTED] for name in list(self.fields)[:40])
        raise LogFormatError(f"{where}: no field {field!r} in {self.name}. The fields here are: {names}; name one")


@dataclass(frozen=True)
class Ulog(Reader):
    """Reads a log of PX4. `Source.name` is a topic, `Source.field` a field of its messages.

    A topic is named as in `vehicle_attitude`, and its further instances as in `actuator_outputs[1]`. A field is named
    as in `vx` or `control[0]`; several, comma-separated, give their Euclidean norm. A field of four numbers, such as
    `q`, is taken as a quaternion (w, x, y, z) and gives its yaw in rad, which is clockwise from north in PX4. Where the
    parameters tell what drives it, the topic of a command has the further fields of `DRIVEN`.

    >>> Ulog().suffixes
    ('.ulg', '.ulog')
    """

    suffixes: ClassVar[tuple[str, ...]] = (".ulg", ".ulog")

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        wanted = [source.name for source in sources.values()]
        wanted += [*(match[1] for name in wanted if (match := ELEMENT.fullmatch(name))), *CLOCKS]
        seen: set[str] = set()

        def keep(name: str) -> bool:
            seen.add(name)
            return any(name == pattern or fnmatch.fnmatchcase(name, pattern) for pattern in wanted)

        topics = {topic.name: topic for topic in _topics(path, keep)}
        matched = {}
        for channel, source in sources.items():
            where = f"{path}: data.channels.{channel}"
            matched[channel] = match_name(source.name, {*topics, *seen}, f"{where}.name")
            if matched[channel] not in topics:
                raise LogFormatError(
                    f"{where}.name: the log holds no message of {matched[channel][:QUOTED]!r}: name another topic"
                )
        order = dict(zip(topics, interleaved([topic.time for topic in topics.values()]), strict=True))
        channels, dropped, start = {}, {}, _start(topics)
        for channel, source in sources.items():
            topic = topics[matched[channel]]
            raw = topic.value(source.field or "", f"{path}: data.channels.{channel}.field")
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, topic.time, raw, order[topic.name], start=start
            )
        return channels, dropped

    def survey(self, path: Path) -> list[Series]:
        topics = _topics(path, lambda name: True)
        series = []
        for topic, order in zip(topics, interleaved([topic.time for topic in topics]), strict=True):
            arrays = Counter(match[1] for name in topic.fields if (match := ELEMENT.fullmatch(name)))
            kind = topic.name.partition("[")[0]
            for name, numbers in topic.fields.items():
                array = match[1] if (match := ELEMENT.fullmatch(name)) else ""
                if "timestamp" in name or arrays[array] > ELEMENTS:
                    continue
                if array in QUATERNIONS and match and match[2] == "0" and arrays[array] == 4:
                    value = topic.value(array, topic.name)
                    series.append(Series(topic.name, array, topic.time, value, order, "rad", kind))
                unit = "1" if name in DRIVEN else ""
                series.append(Series(topic.name, name, topic.time, _floats(numbers), order, unit, kind))
        return series


def _start(topics: Mapping[str, _Topic]) -> float:
    """When a log began, s since 1970, by the fixes of its receivers; NaN without one."""
    fixes = [(topics[name].time, topics[name].fields.get("time_utc_usec")) for name in CLOCKS if name in topics]
    known = [1e-6 * (utc - 1e6 * time)[utc > 1e15] for time, utc in fixes if utc is not None]
    return float(np.median(np.concatenate(known))) if any(map(len, known)) else math.nan


def _floats(numbers: np.ndarray) -> np.ndarray:
    """As float64; a signalling NaN, which damage can make, stays a NaN."""
    with np.errstate(invalid="ignore"):
        return numbers.astype(np.float64)


def _topics(path: Path, keep: Callable[[str], bool]) -> list[_Topic]:
    """The topics to be kept that have messages, by name and instance; warns if the file is damaged."""
    try:
        with path.open("rb") as file:
            log = _parsed(file, path.stat().st_size, keep)
    except MissingExtraError:
        raise
    except Exception as error:  # pyulog raises many types for damage
        if isinstance(error, OSError) and error.filename is not None:
            raise
        what = printable(" ".join(str(error).split())[:200].rstrip(".")) or type(error).__name__
        raise LogFormatError(
            f"{path}: expected a ULog of PX4, found: {what}: leave it out, or name its reader"
        ) from error
    if log.file_corruption:
        warnings.warn(f"{path}: this log is damaged: messages that could not be read are left out", stacklevel=4)
    parts: dict[str, list[Any]] = defaultdict(list)
    for data in log.data_list:
        kinds = {field.field_name: field.type_str for field in data.field_data}
        name = data.name + (f"[{data.multi_id}]" if data.multi_id else "")
        if kinds.get("timestamp") == "uint64_t":
            parts[name].append((data, kinds))
        else:
            warnings.warn(f"{path}: skipped the topic {name[:QUOTED]}, which has no timestamp in us", stacklevel=4)
    topics = []
    for name, pieces in parts.items():
        stamps = np.concatenate([data.data["timestamp"] for data, _ in pieces]).astype(np.int64)
        fields = {
            field: np.concatenate([data.data[field] for data, _ in pieces])
            for field, kind in pieces[0][1].items()
            if kind != "char" and field and all(kinds.get(field) == kind for _, kinds in pieces)
        }
        topics.append(_Topic(name, (stamps - np.uint64(log.start_timestamp).astype(np.int64)) * 1e-6, fields))
    logged = {topic.name: topic.fields for topic in topics}
    for name, (kind, numbers) in actuators(log.initial_parameters).items():
        with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers
            commands = [command(kind, number, log.initial_parameters, logged) for number in numbers]
        for topic in topics:
            if same := [values for place, values in commands if place == topic.name]:
                topic.fields[name] = np.mean(same, axis=0)
    return topics


def _parsed(file: BinaryIO, size: int, keep: Callable[[str], bool]) -> Any:
    """The log, parsed by pyulog; the types that it defines may not have millions of fields."""
    try:
        from pyulog import ULog
    except ImportError as error:
        raise MissingExtraError("pyulog", "logs", "reading logs of PX4") from error
    left = FIELDS

    class Subscription(ULog._MessageAddLogged):
        def _parse_format(self, message_formats: Any) -> None:
            nonlocal left
            left -= _count(message_formats, self.message_name, {})
            if left < 0:
                raise RuntimeError(f"messages with more than {FIELDS} fields in all")
            super()._parse_format(message_formats)

    class Log(ULog):
        _MessageAddLogged = Subscription

    class Names:
        def __contains__(self, name: str) -> bool:
            return keep(name)

    with contextlib.redirect_stdout(io.StringIO()):  # it prints about damage
        return Log(_Bounded(file, size), Names())


class _Bounded:
    """A file that is read a bounded number of times: pyulog steps back in a damaged one, perhaps without end."""

    def __init__(self, file: BinaryIO, size: int):
        self.tell, self.close = file.tell, file.close
        self._file, self._calls, self._bytes = file, 4 * size + MARGIN, 100 * (size + MARGIN)

    def read(self, size: int) -> bytes:
        data = self._file.read(size)
        self._calls -= 1
        self._bytes -= len(data)
        if self._calls < 0 or self._bytes < 0:
            raise RuntimeError("damage in which pyulog finds no end")
        return data

    def seek(self, offset: int, origin: int = 0) -> int:
        return self._file.seek(max(0, offset + (self._file.tell() if origin else 0)))


def _count(formats: Any, name: str, known: dict[str, int], depth: int = 0) -> int:
    """The fields of a type with all types in it; more than `FIELDS` if there are too many, or they never end."""
    if depth > DEEPEST:
        return FIELDS + 1
    if name not in known:
        known[name] = min(
            FIELDS + 1,
            sum(
                max(1, length) * (max(1, _count(formats, kind, known, depth + 1)) if kind in formats else 1)
                for kind, length, _ in formats[name].fields
            ),
        )
    return known[name]


def actuators(parameters: Mapping[str, float]) -> dict[str, tuple[str, list[int]]]:
    """name of `DRIVEN` -> the topic and the numbers, from 0, of what drives it; {} where nothing tells."""
    places = {number: parameters.get(f"CA_ROTOR{number}_PY", 0.0) for number in range(12)}
    left, right = ([number for number, y in places.items() if sign * y > 0] for sign in (-1, 1))
    if left and right:
        return {"throttle_left": (MOTORS, left), "throttle_right": (MOTORS, right)}
    ackermann = {"throttle": (MOTORS, [0]), "steering": (SERVOS, [0])}
    differential = {"motor_1": (MOTORS, [0]), "motor_2": (MOTORS, [1])}  # firmwares number them differently
    return {5.0: ackermann, 6.0: differential}.get(parameters.get("CA_AIRFRAME", 0.0), {})


def command(kind: str, number: int, parameters: Mapping[str, float], topics: Topics) -> tuple[str, np.ndarray]:
    """The topic that holds an actuator's command, and its shares of full scale; pulses in us without limits."""
    share = topics.get(kind, {}).get(f"control[{number}]")
    if share is not None and np.isfinite(share).any():
        return kind, np.nan_to_num(share.astype(np.float64))  # NaN stops a motor
    for bank, output in (each.groups() for each in map(FUNCTION.fullmatch, parameters) if each):
        topic = f"{OUTPUTS}[1]" if bank == "AUX" and f"{OUTPUTS}[1]" in topics else OUTPUTS
        pulses = topics.get(topic, {}).get(f"output[{int(output) - 1}]")
        if pulses is None or parameters[f"PWM_{bank}_FUNC{output}"] != FIRST[kind] + number:
            continue
        names = *(f"PWM_{bank}_{name}" for name in (f"MIN{output}", f"MAX{output}", "REV")), "CA_R_REV"
        low, high, backward, both = (parameters.get(name, math.nan) for name in names)
        if not high > low or not math.isfinite(backward + both):
            return topic, pulses.astype(np.float64)
        zero = (low + high) / 2 if kind == SERVOS or int(both) >> number & 1 else low
        sign = -1 if int(backward) >> (int(output) - 1) & 1 else 1
        stopped = ~(pulses > 0) | (pulses == parameters.get(f"PWM_{bank}_DIS{output}"))
        return topic, np.where(stopped, 0.0, sign * (pulses - zero) / (high - zero))
    return "", np.empty(0)  # nothing holds it
