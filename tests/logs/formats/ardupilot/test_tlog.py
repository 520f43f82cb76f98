"""A telemetry log gives the numbers that pymavlink gives, with the vehicle's own stamps, and only of intact frames."""

from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.support import files
from tests.support.ardupilot import PARAMETERS, frame, packet, tlog
from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES
from usvlearn.logs.formats.ardupilot.tlog import Tlog

STEPS = np.arange(60)


def write(tmp_path, content: bytes) -> Path:
    path = tmp_path / "a.tlog"
    path.write_bytes(content)
    return path


one, KEEP = partial(files.one, Tlog()), Tlog(disarmed="keep")


def refused(path, name="ATTITUDE", field="yaw") -> str:
    message = files.refused(LogFormatError, one, path, name, field)
    assert message.startswith(str(path)) and message.isprintable()
    return message


# ---------------------------------------------------------------- numbers and names


@pytest.mark.parametrize("version", [1, 2])
def test_numbers_are_those_that_were_sent_at_the_time_of_the_vehicle(tmp_path, version):
    path = write(tmp_path, tlog(version=version))
    yaw, dropped = one(path, "ATTITUDE", "yaw")
    np.testing.assert_allclose(yaw.value, np.radians(10) + 0.02 * STEPS, rtol=1e-6)  # float32
    np.testing.assert_allclose(yaw.time, 0.02 + 0.1 * STEPS, atol=2e-6)  # the quickest message came after 20 ms
    assert dropped == {}
    np.testing.assert_allclose(one(path, "LOCAL_POSITION_NED", "vx,vy")[0].value, 1.5, rtol=1e-6)
    received = one(path, "VFR_HUD", "groundspeed")[0].time  # it has no stamp
    np.testing.assert_allclose(received, 0.1 * STEPS + 0.02 * (1 + STEPS % 3), atol=2e-6)


def test_a_signed_frame_and_one_that_is_cut_are_whole(tmp_path):
    content = frame("ATTITUDE", 1.0, signed=True, time_boot_ms=1, yaw=1.5) + frame("ATTITUDE", 2.0, time_boot_ms=1001)
    assert one(write(tmp_path, content), "ATTITUDE", "yaw")[0].value.tolist() == [1.5, 0.0]


def test_names_of_senders_ports_and_arrays(tmp_path):
    content = b"".join(
        frame("HEARTBEAT", k, sender=(system, 1), autopilot=3) + frame("ATTITUDE", k, sender=(system, 1), yaw=system)
        for k in range(3)
        for system in (1, 2)
    )
    path = write(tmp_path, content)
    message = refused(path)
    assert "'ATTITUDE' comes from 2 senders: name ATTITUDE@1.1 or ATTITUDE@2.1" in message
    for name in ("ATTITUDE@2.1", "ATT*@2.*"):
        assert one(path, name, "yaw")[0].value.tolist() == [2, 2, 2]
    assert "no channel 'ATTITUDE@3.1'. The log has: ATTITUDE@1.1, ATTITUDE@2.1" in refused(path, "ATTITUDE@3.1")
    content = frame("HEARTBEAT", 0, sender=(7, 1), autopilot=3, base_mode=128)
    content += frame("HEARTBEAT", 0, sender=(255, 1), autopilot=8)
    for port in (1, 0):
        content += frame("SERVO_OUTPUT_RAW", 1, sender=(7, 1), port=port, servo1_raw=1500 + port, servo16_raw=port)
    content += frame("ESC_TELEMETRY_1_TO_4", 2, sender=(7, 1), **{"rpm.1": 900})
    content += frame("ATTITUDE", 2, sender=(255, 1), yaw=1) + frame("ATTITUDE", 2, sender=(7, 1), yaw=2)
    path = write(tmp_path, content)
    assert one(path, "SERVO_OUTPUT_RAW", "servo1_raw")[0].value.tolist() == [1500]
    assert one(path, "SERVO_OUTPUT_RAW[1]", "servo1_raw")[0].value.tolist() == [1501]
    assert one(path, "SERVO_OUTPUT_RAW[1]", "servo16_raw")[0].value.tolist() == [1]
    assert one(path, "ESC_TELEMETRY_1_TO_4", "rpm.1")[0].value.tolist() == [900]
    assert one(path, "ATTITUDE", "yaw")[0].value.tolist() == [2]  # the autopilot's
    assert one(path, "HEARTBEAT@255.1", "autopilot")[0].value.tolist() == [8]


def test_a_survey_gives_all_numbers_with_names_that_find_them(tmp_path):
    path = write(tmp_path, tlog())
    survey = KEEP.survey(path)
    units = {(series.name, series.field): series.unit for series in survey}
    assert units["ATTITUDE", "yawspeed"] == "rad/s" and units["LOCAL_POSITION_NED", "vx"] == "m/s"
    assert units["SERVO_OUTPUT_RAW[0]", "throttle_right"] == "1" and units["SERVO_OUTPUT_RAW[0]", "servo1_raw"] == "us"
    assert ("HEARTBEAT@255.190", "base_mode") in units and ("HEARTBEAT", "base_mode") in units
    assert not {field for _, field in units} & {"time_boot_ms", "time_usec", "port", "param_value"}
    files.assert_same_as_read(KEEP, path, survey)


# ---------------------------------------------------------------- time


def test_a_reboot_and_the_end_of_a_counter_do_not_move_the_time(tmp_path):
    content, late = b"", 0.03
    for k in range(40):
        ms = 4_294_000 + 100 * k if k < 20 else 100 * (k - 20)  # 20 s without power between them
        receipt = 0.1 * k + (20.0 if k >= 20 else 0.0) + late * (k % 2)
        content += frame("ATTITUDE", receipt, time_boot_ms=ms, yaw=k)
        content += frame("SERVO_OUTPUT_RAW", receipt, time_usec=1000 * ms % 2**32, servo1_raw=k)
        content += frame("GPS_RAW_INT", receipt, time_usec=1_700_000_000_000_000, vel=k)  # no time since boot
    path = write(tmp_path, content)
    expected = 0.1 * np.arange(40) + np.where(np.arange(40) >= 20, 20.0, 0.0)
    np.testing.assert_allclose(one(path, "ATTITUDE", "yaw")[0].time, expected, atol=2e-6)
    np.testing.assert_allclose(one(path, "SERVO_OUTPUT_RAW", "servo1_raw")[0].time, expected, atol=2e-6)
    received = expected + late * (np.arange(40) % 2)
    np.testing.assert_allclose(one(path, "GPS_RAW_INT", "vel")[0].time, received, atol=2e-6)


def test_an_old_measurement_that_is_sent_again_keeps_its_time(tmp_path):
    content = b""
    for k in range(200):
        fixed = 100 * min(k, 120)  # ms; the receiver is lost after 12 s
        content += frame("ATTITUDE", 0.1 * k, time_boot_ms=100 * k)
        content += frame("GPS_RAW_INT", 0.1 * k, time_usec=1000 * fixed, vel=k)
    channel, _ = one(write(tmp_path, content), "GPS_RAW_INT", "vel")
    np.testing.assert_allclose(channel.time, 0.1 * np.minimum(np.arange(200), 120), atol=2e-6)


def test_a_clock_of_another_rate_stays_near_the_receipt(tmp_path):
    content = b"".join(frame("ATTITUDE", 0.1 * k, time_boot_ms=99 * k) for k in range(9000))  # 9 s slow after 15 min
    channel, _ = one(write(tmp_path, content), "ATTITUDE", "roll")
    assert np.abs(channel.time - 0.1 * np.arange(9000)).max() < 5.1
    assert (np.diff(channel.time) > 0).all() and (np.diff(channel.time) > 0.2).sum() == 1


# ---------------------------------------------------------------- commands


def test_commands_count_while_the_vehicle_is_armed(tmp_path):
    path = write(tmp_path, tlog(armed_from=20))
    channel, dropped = one(path, "SERVO_OUTPUT_RAW", "throttle_left")
    np.testing.assert_allclose(channel.value, 5 * STEPS[20:] / 500, rtol=1e-15)
    assert dropped == {"disarmed": 20}
    channel, dropped = files.one(KEEP, path, "SERVO_OUTPUT_RAW", "throttle_right")
    np.testing.assert_allclose(channel.value, 4 * STEPS / 500, rtol=1e-15)
    assert dropped == {} and len(one(path, "ATTITUDE", "yaw")[0].value) == 60
    message = refused(write(tmp_path, tlog(armed_from=99)), "SERVO_OUTPUT_RAW", "servo1_raw")
    assert "found no SERVO_OUTPUT_RAW while the vehicle was armed, 60 while it was not" in message


def test_a_log_without_parameters_names_no_servo(tmp_path):
    message = refused(write(tmp_path, tlog(parameters={})), "SERVO_OUTPUT_RAW", "throttle_left")
    assert "found no such parameters: name the servo's column" in message
    assert len(PARAMETERS) == 10


# ---------------------------------------------------------------- damage


def test_damaged_frames_are_skipped_and_told(tmp_path):
    whole = tlog()
    good = set(one(write(tmp_path, whole), "ATTITUDE", "yaw")[0].value)
    place = whole.index(frame("ATTITUDE", 3.02, time_boot_ms=8000, yaw=np.radians(10.0) + 0.02 * 30, yawspeed=0.2))
    for damaged, lost in (
        (whole[: place + 30] + bytes([whole[place + 30] ^ 1]) + whole[place + 31 :], 1),
        (whole[: place + 20] + whole[place + 25 :], 1),
        (whole[:place] + b"\xfd\xfe\xfdgarbage" + whole[place:], 0),
    ):
        with pytest.warns(
            UserWarning, match=r"a\.tlog: the log is damaged: skipped \d+ of \d+ bytes, in 1 places, which"
        ):
            yaw = one(write(tmp_path, damaged), "ATTITUDE", "yaw")[0].value
        assert len(yaw) == 60 - lost and set(yaw) <= good
    assert len(one(write(tmp_path, whole[:-3]), "LOCAL_POSITION_NED", "vx")[0].value) == 59  # it was being written


def test_unknown_messages_are_passed_over(tmp_path):
    unknown = (
        packet(11_111, 5, b"anything") + packet(200, 5, b"anything", version=1) + packet(16_000_000, 5, b"anything")
    )
    content = b"".join(unknown + frame("ATTITUDE", k, yaw=k) for k in range(4)) + unknown
    assert one(write(tmp_path, content), "ATTITUDE", "yaw")[0].value.tolist() == [0, 1, 2, 3]
    with pytest.warns(UserWarning, match="skipped 15 messages of types that are not known"):
        Tlog().survey(write(tmp_path, content))


@pytest.mark.parametrize("content", [b"t,l,r\n0,1,2\n" * 20, bytes(3000), b"\xfd" * 300, packet(11_111, 5, b"any")])
def test_what_is_no_log_is_refused(tmp_path, content):
    assert "expected a MAVLink telemetry log, found no time of receipt" in refused(write(tmp_path, content))


# ---------------------------------------------------------------- pymavlink


@pytest.fixture
def dialect():
    return pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="needs the package pymavlink")


def test_declared_messages_are_those_of_pymavlink(dialect):
    for number, message in MESSAGES.items():
        theirs = dialect.mavlink_map[number]
        names = [
            f"{field}.{k}" if count and field != "param_id" else field
            for field, count in zip(theirs.ordered_fieldnames, theirs.array_lengths, strict=True)
            for k in range(max(1, count) if field != "param_id" else 1)
        ]
        assert (message.name, message.extra) == (theirs.msgname, theirs.crc_extra)
        assert list(message.fields) == names[: len(message.fields)], message.name  # later extensions are left out
        for field, where in message.fields.items():
            assert where.unit == theirs.fieldunits_by_name.get(field.partition(".")[0], ""), (message.name, field)


@pytest.mark.parametrize("version", [1, 2])
def test_frames_of_pymavlink_equal_pymavlink_in_every_field(tmp_path, dialect, version):
    from pymavlink import mavutil

    rng, content = np.random.default_rng(version), b""
    link = dialect.MAVLink(None, srcSystem=3, srcComponent=1)
    for number in MESSAGES:
        theirs = dialect.mavlink_map[number]
        if version == 1 and number > 255:
            continue
        for k in range(5):
            values = [_drawn(theirs, field, rng) for field in theirs.fieldnames]
            content += (1_700_000_000_000_000 + 100_000 * k).to_bytes(8, "big")
            content += theirs(*values).pack(link, force_mavlink1=version == 1)
    path = write(tmp_path, content)
    expected = defaultdict(list)
    log = mavutil.mavlink_connection(str(path), dialect="ardupilotmega")
    while (message := log.recv_match()) is not None:
        for field in message.get_fieldnames():
            value = getattr(message, field)
            for k, each in enumerate(value) if isinstance(value, list) else [(None, value)]:
                expected[message.get_type(), field if k is None else f"{field}.{k}"].append(each)
    log.close()
    survey = KEEP.survey(path)
    names = {series.name.partition("[")[0] for series in survey}
    assert names | {"PARAM_VALUE"} == {name for name, _ in expected}
    compared = 0
    for series in survey:
        if value := expected.get(
            (series.name, series.field)
        ):  # else a sensor's number splits it, or version 1 lacks it
            np.testing.assert_array_equal(series.value, np.array(value, float))
            compared += 1
    assert compared > 130


def _drawn(message, field: str, rng):
    """A value, or several, that a field can hold."""
    if field == "param_id":
        return b"SERVO1_TRIM"
    count = message.array_lengths[message.ordered_fieldnames.index(field)]
    kind = float if "float" in message.fieldtypes[message.fieldnames.index(field)] else int
    values = [kind(x) for x in rng.integers(1, 100, max(1, count))]
    return values if count else values[0]
