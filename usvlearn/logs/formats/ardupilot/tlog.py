"""MAVLink telemetry logs (`.tlog`): frames as a ground station received them, each after its time of receipt.

A record is the time in us since 1970, 8 bytes, the highest first, and a frame of MAVLink 1 or 2:
https://mavlink.io/en/guide/serialization.html.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES
from usvlearn.logs.formats.ardupilot.servos import OUTPUTS, Servos, last_and_former
from usvlearn.logs.formats.messages import Key, MessageLog, MessageReader, Messages, Vehicle

CLOCK_LIMIT = 5.0  # s; a vehicle's stamp further from the receipt belongs to another boot, or to no clock
WRAP = 2**32 * 1e-6  # s, after which a stamp of 32 bits in us begins anew
ARMED = 128  # bit of HEARTBEAT.base_mode
NO_AUTOPILOT, GROUND_STATION = 8, 6  # HEARTBEAT.autopilot, HEARTBEAT.type
HEARTBEAT, PARAM_VALUE = 0, 22  # ids
SERVOS = Servos(OUTPUTS[3:], "servo{n}_raw")


@dataclass(frozen=True)
class Tlog(MessageReader):
    """Reads a telemetry log. `Source.name` is a message such as `ATTITUDE`, `Source.field` a field such as `yaw`.

    `ATTITUDE@1.1` is what component 1 of system 1 sent. Without it, the autopilot's is meant: the component whose
    HEARTBEAT names one. `SERVO_OUTPUT_RAW[1]` is the second output port; `rpm.0` the first number of an array. Several
    fields, comma-separated, give their Euclidean norm. Numbers are as sent, in the units of MAVLink.

    `SERVO_OUTPUT_RAW` has the further fields `throttle_left`, `throttle_right`, `throttle` and `steering`, by the
    parameters in the log: see `usvlearn.logs.formats.ardupilot.dataflash.DataFlash`.

    The time of a message is its own stamp, since boot, if it has one, or else its receipt. Damaged parts are skipped
    with a warning. Messages that `usvlearn.logs.formats.ardupilot.mavlink_messages` does not declare are passed over.

    Args:
        disarmed: `drop` leaves out all servo outputs while the vehicle is disarmed, and counts them as `disarmed`, so
            that nothing is learned while it is towed or carried; `keep` takes them.

    Raises:
        ConfigError: `disarmed` is neither `drop` nor `keep`.

    >>> Tlog().suffixes
    ('.tlog',)
    """

    what: ClassVar[str] = "MAVLink"
    suffixes: ClassVar[tuple[str, ...]] = (".tlog",)
    left_out: ClassVar[tuple[str, ...]] = ("PARAM_VALUE",)

    def _messages(self, path: Path, data: np.ndarray) -> MessageLog:
        from usvlearn.logs.formats.ardupilot import binary_kernel as compiled

        extras = np.full(compiled.IDS, -1, dtype=np.int16)
        for number, message in MESSAGES.items():
            extras[number] = message.extra
        starts, lengths, ids, senders, stamps, skipped = compiled.scan_tlog(data, extras)
        if not len(starts):
            raise LogFormatError(
                f"{path}: expected a MAVLink telemetry log, found no time of receipt that a known message follows: "
                "choose the data option that fits this file"
            )
        received = (stamps - stamps[0]) * 1e-6
        groups = senders.astype(np.int64) * compiled.IDS + ids
        kinds, counts = np.unique(groups, return_counts=True)
        rows = np.split(np.argsort(groups, kind="stable"), np.cumsum(counts)[:-1])
        sent: dict[str, dict[int, Messages]] = {}  # sender -> id -> messages
        for kind, chosen in zip(kinds.tolist(), rows, strict=True):
            sender, number = divmod(kind, compiled.IDS)
            one = Messages(MESSAGES[number].fields, starts[chosen], lengths[chosen], received[chosen], chosen)
            sent.setdefault(f"{sender >> 8}.{sender & 255}", {})[number] = one
        messages: dict[Key, list[Messages]] = {}
        for sender, each in sent.items():
            for number, one in _timed(data, each).items():
                message = MESSAGES[number]
                excluded = message.stamp, message.instance
                shown = {name: where for name, where in message.fields.items() if name not in excluded}
                for instance, part in one.split(data, message.instance):
                    messages[Key(message.name, instance, sender)] = [part._replace(fields=shown)]
        vehicles = {sender: _vehicle(data, each) for sender, each in sent.items()}
        pilots = [each for each in sent if _is_autopilot(data, sent[each])]
        return MessageLog(path, data, messages, SERVOS, vehicles, pilots, skipped, stamps[0] * 1e-6)


def _timed(data: np.ndarray, sent: dict[int, Messages]) -> dict[int, Messages]:
    """The messages of one sender, with the times of its own clock where they are stamped.

    The clock starts anew at each boot. Between two boots its offset from the receipt is the least that was seen: that
    of the message that came fastest.
    """
    clocked = [messages for number, messages in sent.items() if MESSAGES[number].stamp == "time_boot_ms"]
    if not clocked:
        return sent
    order = np.concatenate([messages.order for messages in clocked])
    delay = np.concatenate([messages.time - 1e-3 * messages.numbers(data, "time_boot_ms") for messages in clocked])
    place = np.argsort(order)
    order, delay = order[place], delay[place]
    boots = _boots(delay)
    offsets = np.minimum.reduceat(delay, boots)
    timed = {}
    for number, messages in sent.items():
        if (stamp := MESSAGES[number].stamp) is not None:
            offset = offsets[np.maximum(np.searchsorted(order[boots], messages.order, side="right") - 1, 0)]
            time = messages.numbers(data, stamp) * (1e-3 if stamp == "time_boot_ms" else 1e-6) + offset
            kind = messages.fields[stamp].dtype
            if stamp == "time_usec" and kind == "<u4":
                time += WRAP * np.round((messages.time - time) / WRAP)
            age = np.abs(time - messages.time)
            if kind == "<u8":  # since boot or since 1970; of a measurement, which may be old
                age = np.full_like(age, np.median(age))
            messages = messages._replace(time=np.where(age <= CLOCK_LIMIT, time, messages.time))
        timed[number] = messages
    return timed


def _boots(delay: np.ndarray) -> np.ndarray:
    """Where the offset of a clock changes: at a boot, or when it has drifted far."""
    changes, least = [0], float(delay[0])
    for k, each in enumerate(delay.tolist()):
        if abs(each - least) > CLOCK_LIMIT:
            changes.append(k)
            least = each
        least = min(least, each)
    return np.array(changes)


def _vehicle(data: np.ndarray, sent: dict[int, Messages]) -> Vehicle:
    """The last parameters of a sender, and when it was armed: before its first HEARTBEAT as in that."""
    parameters, former = last_and_former(())
    if one := sent.get(PARAM_VALUE):
        names = (name.decode("ascii", "replace") for name in one.column(data, "param_id").tolist())
        parameters, former = last_and_former(zip(names, one.numbers(data, "param_value").tolist(), strict=True))
    if one := sent.get(HEARTBEAT):
        armed = one.column(data, "base_mode") & ARMED != 0
        return Vehicle(parameters, np.append(-1, one.order), np.append(armed[0], armed), former)
    return Vehicle(parameters, former=former)


def _is_autopilot(data: np.ndarray, sent: dict[int, Messages]) -> bool:
    if (one := sent.get(HEARTBEAT)) is None:
        return False
    return bool(((one.column(data, "type") != GROUND_STATION) & (one.column(data, "autopilot") != NO_AUTOPILOT)).any())
