"""An ArduPilot log gives the numbers that pymavlink gives, commands as shares of full scale, and nothing of damage."""

import struct
import warnings
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.support import few, files
from tests.support.ardupilot import LAYOUTS, PACKED, PARAMETERS, SERVOS, dataflash, described, header, logged
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.formats import messages
from usvlearn.logs.formats.ardupilot.dataflash import PLAIN, DataFlash

STEPS = np.arange(60)
LIMITS_ALONE = {name: value for name, value in PARAMETERS.items() if not name.endswith("_FUNCTION")}


def write(tmp_path, content: bytes) -> Path:
    path = tmp_path / "a.BIN"
    path.write_bytes(content)
    return path


one = partial(files.one, DataFlash())


def refused(path, name="RCOU", field="throttle_left", **how) -> str:
    message = files.refused(LogFormatError, one, path, name, field, **how)
    assert message.startswith(str(path)) and message.isprintable()
    return message


# ---------------------------------------------------------------- names and numbers


@pytest.mark.thorough
def test_numbers_are_scaled_and_stamped(tmp_path):
    path = write(tmp_path, dataflash())
    roll, dropped = one(path, "ATT", "Roll", unit="deg")
    np.testing.assert_allclose(roll.value, np.radians(-1.5), rtol=1e-15)
    np.testing.assert_allclose(roll.time, 5.00001 + 0.1 * STEPS, atol=1e-9)  # since the first message, which is at 0
    assert dropped == {} and (np.diff(roll.order) == 5).all()
    speed, _ = one(path, "[NX]KF1", "VN, VE")
    np.testing.assert_allclose(speed.value, 1.5, rtol=1e-6)  # the log has float32


def test_an_index_names_one_of_several_sensors(tmp_path):
    for units in (True, False):  # without units, the sensor's number is known by its name
        path = write(tmp_path, dataflash(units=units))
        for name, expected in (("IMU", 0.2), ("IMU[0]", 0.2), ("IMU[1]", 0.3), ("I*[1]", 0.3)):
            np.testing.assert_allclose(one(path, name, "GyrZ")[0].value, [expected] * 60, rtol=1e-6)
        assert "no channel 'IMU[2]'. The log has: IMU[0], IMU[1]: name one" in refused(path, "IMU[2]", "GyrZ")


def test_an_unknown_name_or_field_lists_what_there_is(tmp_path):
    path = write(tmp_path, dataflash())
    message = refused(path, "ATTI", "Yaw")
    assert "data.channels.surge.name: no channel 'ATTI'. Did you mean ATT?" in message and "XKF1" in message
    message = refused(path, "ATT", "yaw")
    assert "data.channels.surge.field: no field 'yaw': did you mean Yaw?" in message and "Roll, Yaw" in message
    assert "no field is named. The fields of ATT are: Roll, Yaw" in refused(path, "ATT", None)
    assert "no channel 'MSG'" in refused(path, "MSG", "Message")  # it is described, but was never logged


def test_a_survey_gives_all_numbers_with_names_that_find_them(tmp_path):
    path = write(tmp_path, dataflash())
    survey = DataFlash(disarmed="keep").survey(path)
    units = {(series.name, series.field): series.unit for series in survey}
    assert units == {
        **{("RCOU", f"C{n}"): "us" for n in (1, 2, 3, 4)},
        **{("RCOU", side): "1" for side in ("throttle_left", "throttle_right")},
        **{("ATT", "Roll"): "deg", ("ATT", "Yaw"): "deg"},
        **{(f"IMU[{n}]", field): unit for n in (0, 1) for field, unit in (("GyrZ", "rad/s"), ("Temp", "mV"))},
        **{("XKF1[0]", field): "m/s" if field[0] == "V" else "m" for field in ("VN", "VE", "PN", "PE")},
    }
    files.assert_same_as_read(DataFlash(), path, survey, ("time", "value", "order"))


def test_old_logs_are_stamped_in_milliseconds_and_their_gps_apart(tmp_path):
    content = described(1, "ATT", "If", "TimeMS,Yaw") + described(2, "GPS", "IHIf", "TimeMS,Week,T,Spd")
    content += described(3, "EV", "B", "Id")
    for k in range(5):
        content += b"\xa3\x95\x01" + np.array([2000 + 100 * k], "<u4").tobytes() + np.array([k], "<f4").tobytes()
        content += b"\xa3\x95\x02" + np.array([345_000_000 + k], "<u4").tobytes() + b"\1\1"
        content += np.array([2050 + 100 * k], "<u4").tobytes() + np.array([k], "<f4").tobytes()
        content += b"\xa3\x95\x03\x07"
    path = write(tmp_path, content)
    np.testing.assert_allclose(one(path, "ATT", "Yaw")[0].time, 0.1 * np.arange(5), atol=1e-12)
    np.testing.assert_allclose(one(path, "GPS", "Spd")[0].time, 0.05 + 0.1 * np.arange(5), atol=1e-12)
    before = 0.05 + 0.1 * np.arange(5)  # the stamp of the message before
    np.testing.assert_allclose(one(path, "EV", "Id")[0].time, before, atol=1e-12)


def test_a_message_that_is_described_anew_goes_on(tmp_path):
    wide = described(70, "ATT", "Qfd", "TimeUS,Extra,Yaw")
    content = header() + logged("ATT", 1_000_000, 0, 1.0) + wide
    content += b"\xa3\x95\x46" + np.array([2_000_000], "<u8").tobytes() + bytes(4) + np.array([2.0], "<f8").tobytes()
    channel, _ = one(write(tmp_path, content + logged("ATT", 3_000_000, 0, 3.0)), "ATT", "Yaw")
    assert (channel.time.tolist(), channel.value.tolist()) == ([1, 2, 3], [1, 2, 3])


# ---------------------------------------------------------------- commands


def test_commands_are_shares_of_full_scale(tmp_path):
    channels, dropped = DataFlash().read(write(tmp_path, dataflash()), SERVOS)
    np.testing.assert_allclose(channels["command_left"].value, 5 * STEPS / 500, rtol=1e-15)
    np.testing.assert_allclose(channels["command_right"].value, 4 * STEPS / 500, rtol=1e-15)  # reversed
    assert dropped == {"command_left": {}, "command_right": {}}


def test_no_pulses_are_no_thrust_and_the_first_servo_stands_for_several(tmp_path):
    parameters = {**PARAMETERS, "SERVO4_FUNCTION": 73.0, "SERVO1_FUNCTION": 0.0, "SERVO2_FUNCTION": 73.0}
    with pytest.warns(
        UserWarning, match=r"SERVO2_MIN 1100, SERVO2_TRIM 1500, SERVO2_MAX 1900, .*assumed these defaults"
    ):
        channel, _ = one(write(tmp_path, dataflash(parameters=parameters)), "RCOU", "throttle_left")
    np.testing.assert_array_equal(channel.value, np.zeros(60))  # C2 is 0 us


def test_parameters_are_the_last_in_the_log(tmp_path):
    late = [(30, logged("PARM", 8_000_000, "SERVO1_MAX", 1600.0, 0.0))]
    path = write(tmp_path, dataflash(events=late))
    with pytest.warns(
        UserWarning, match="SERVO1_MAX is 2000, and later 1600: the last value is taken for all of the log"
    ):
        channel, _ = one(path, "RCOU", "throttle_left")
    np.testing.assert_allclose(channel.value, 5 * STEPS / 100, rtol=1e-15)
    with pytest.warns(UserWarning, match="SERVO1_MAX"):
        units = {each.field: each.unit for each in DataFlash().survey(path)}
    assert units["throttle_left"] == "" and units["throttle_right"] == "1"  # so that `inspect` asks for its span


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({}, "found no such parameters: name the servo's column, with its zero and span"),
        ({"SERVO1_FUNCTION": 70.0, "SERVO3_FUNCTION": 26.0},
         "one throttle at servo 1 (70) and steering at servo 3 (26): set field: throttle for command_left and for "),
        ({"SERVO2_FUNCTION": 33.0, "SERVO3_FUNCTION": 0.0}, "found servo 2: 33: name the servo's column"),
        ({"SERVO9_FUNCTION": 73.0}, "the throttle left is servo 9, which RCOU does not hold"),
        ({**PARAMETERS, "SERVO1_MAX": 1400.0}, "SERVO1_TRIM 1500, SERVO1_MAX 1400, expected them to rise"),
        ({**PARAMETERS, "SERVO1_MIN": float("nan")}, "SERVO1_MIN nan"),
    ],
)  # fmt: skip
def test_servos_that_do_not_make_a_command_are_told(tmp_path, parameters, words):
    assert words in refused(write(tmp_path, dataflash(parameters=parameters)))


def test_one_thruster_with_a_rudder_has_a_throttle_and_steering(tmp_path):
    parameters = {**LIMITS_ALONE, "SERVO1_FUNCTION": 70.0, "SERVO3_FUNCTION": 26.0}
    path = write(tmp_path, dataflash(parameters=parameters))
    np.testing.assert_allclose(one(path, "RCOU", "throttle")[0].value, 5 * STEPS / 500, rtol=1e-15)
    np.testing.assert_allclose(one(path, "RCOU", "steering")[0].value, 4 * STEPS / 500, rtol=1e-15)


# ---------------------------------------------------------------- armed


@pytest.mark.parametrize(
    "events",
    [
        [(20, logged("ARM", 0, 1)), (40, logged("ARM", 0, 0)), (50, logged("EV", 0, 10))],
        [(20, logged("EV", 0, 10)), (30, logged("EV", 0, 25)), (40, logged("EV", 0, 11))],
    ],
)
def test_servo_outputs_count_while_the_vehicle_is_armed(tmp_path, events):
    path = write(tmp_path, dataflash(events=events))
    channel, dropped = one(path, "RCOU", "throttle_left")
    np.testing.assert_allclose(channel.value, 5 * STEPS[20:40] / 500, rtol=1e-15)
    assert dropped == {"disarmed": 40}
    assert len(one(path, "RCOU", "C1")[0].value) == 20 and len(one(path, "ATT", "Yaw")[0].value) == 60
    channel, dropped = files.one(DataFlash(disarmed="keep"), path, "RCOU", "throttle_left")
    assert len(channel.value) == 60 and dropped == {}
    assert "held: found true, expected false" in refused(path, held=True)


def test_a_log_that_begins_armed_counts_from_its_start(tmp_path):
    channel, dropped = one(write(tmp_path, dataflash(events=[(40, logged("ARM", 0, 0))])), "RCOU", "C1")
    assert len(channel.value) == 40 and dropped == {"disarmed": 20}


def test_a_log_in_which_nothing_was_armed_is_refused(tmp_path):
    events = [(0, logged("ARM", 0, 0)), (59, logged("ARM", 0, 0))]
    content = dataflash(events=events)
    first = content.index(logged("ARM", 0, 0))
    outputs = content.index(b"\xa3\x95\x44")
    assert first < outputs  # so that no output lies before the first message, where it counts as armed
    assert "found no RCOU while the vehicle was armed, 60 while it was not" in refused(write(tmp_path, content))


# ---------------------------------------------------------------- damage


def test_damage_is_skipped_and_told(tmp_path):
    whole = dataflash()
    place = whole.index(b"\xa3\x95\x45", len(whole) // 2)  # an ATT
    for damaged, lost in (
        (whole[:place] + b"\0\xa3\x95\x45\x80\xa3garbage" + whole[place:], (0, 1)),
        (whole[: place + 4] + whole[place + 9 :], (1, 1)),
        (whole[: place + 1] + b"\0" + whole[place + 2 :], (1, 1)),
    ):
        with pytest.warns(
            UserWarning, match=r"a\.BIN: the log is damaged: skipped \d+ of \d+ bytes, in 1 places, which"
        ):
            channel, _ = one(write(tmp_path, damaged), "ATT", "Yaw")
        assert 60 - len(channel.value) in lost
        assert set(channel.value) <= set(one(write(tmp_path, whole), "ATT", "Yaw")[0].value)


def test_the_message_that_was_being_written_and_an_empty_end_are_no_damage(tmp_path):
    whole = dataflash()
    for content, count in ((whole[:-5], 59), (whole + bytes(5000), 59), (whole + b"\xff" * 5000, 59), (whole, 60)):
        assert len(one(write(tmp_path, content), "XKF1", "VN")[0].value) == count


def test_garbage_at_the_end_is_damage(tmp_path):
    rng = np.random.default_rng(0)
    with pytest.warns(UserWarning, match="skipped 5000 of"):
        one(write(tmp_path, dataflash() + logged("MSG", 0, "end") + b"\xa3\x95\xff" + rng.bytes(4997)), "ATT", "Yaw")


def test_a_description_that_contradicts_itself_describes_nothing(tmp_path):
    wrong = bytearray(described(69, "ATT", "Qcf", "TimeUS,Roll,Yaw"))
    wrong[4] += 1  # the length
    channel, _ = one(write(tmp_path, header() + bytes(wrong) + logged("ATT", 0, 0, 1.0)), "ATT", "Yaw")
    assert channel.value.tolist() == [1.0]


WRONG_TYPES = {  # of the format letters of a description: text for numbers, numbers for text, fractions for ids
    "UNIT": ("QZZ", "Qbd", "Qfb"), "MULT": ("QZd", "QbZ", "Qfd"), "FMTU": ("QZNN", "QBff", "QfNN", "QBNf"),
    "PARM": ("Qfff", "QNZf", "QZZf"), "ARM": ("QZ", "Qf"),
}  # fmt: skip


@pytest.mark.parametrize("name, letters", [(name, each) for name, kinds in WRONG_TYPES.items() for each in kinds])
def test_a_description_of_another_type_tells_nothing_and_ends_nothing(tmp_path, name, letters):
    kind, _, columns, *_ = LAYOUTS[name]
    content = struct.pack("<" + "".join(map(PACKED.get, letters)), *(b"1" if each in "ZN" else 1 for each in letters))
    foreign = described(kind, name, letters, columns) + bytes([0xA3, 0x95, kind]) + content
    again = described(kind, name, *LAYOUTS[name][1:3])
    path = write(tmp_path, header() + foreign + again + dataflash()[len(header()) :])
    np.testing.assert_allclose(one(path, "RCOU", "throttle_left")[0].value[:3], [0, 0.01, 0.02], atol=1e-12)
    units = {(series.name, series.field): series.unit for series in DataFlash().survey(path)}
    assert units["ATT", "Yaw"] == "deg" and units["XKF1[0]", "VN"] == "m/s"


def test_many_layouts_of_one_name_are_read_in_proportion(tmp_path, monkeypatch):
    asked, names, content, count = [], messages.Messages.names, header(), 120
    monkeypatch.setattr(messages.Messages, "names", lambda self: asked.append(self) or names(self))
    for k in range(count):
        content += described(90, "VARY", "QfB", f"TimeUS,A{k},B{k}") + b"\xa3\x95\x5a" + struct.pack("<QfB", k, k, 1)
    survey = DataFlash().survey(write(tmp_path, content))
    assert len(survey) == 2 * count and [each.value.tolist() for each in survey[2:4]] == [[1.0], [1.0]]
    assert len(asked) <= 4 * count


@pytest.mark.parametrize("content", [b"t,l,r\n0,1,2\n" * 20, b"\xa3\x95\x80" + bytes(200), b"\xa3", header()[:89]])
def test_what_is_no_log_is_refused(tmp_path, content):
    assert "expected an ArduPilot DataFlash log, found no message" in refused(write(tmp_path, content))


def test_an_unknown_choice_is_refused():
    with pytest.raises(ConfigError, match=r"data\.reader\.disarmed: found 'no', expected one of drop, keep"):
        DataFlash(disarmed="no")


# ---------------------------------------------------------------- real logs


def assert_equals_pymavlink(path) -> set[tuple[str, str]]:
    """Our columns and units are those of pymavlink; returns the columns that only pymavlink has."""
    reference = pytest.importorskip("pymavlink.DFReader", reason="needs the package pymavlink")
    expected = defaultdict(list)
    log = reference.DFReader_binary(str(path))
    while (message := log.recv_msg()) is not None:
        for field in message.get_fieldnames():
            expected[message.get_type(), field].append(getattr(message, field))
    formats = {layout.name: layout for layout in log.formats.values()}
    log.close()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*assumed these defaults", UserWarning)
        by_name = defaultdict(list)
        for series in DataFlash().survey(path):
            if not series.field.startswith("throttle"):
                by_name[series.name.partition("[")[0], series.field].append(series)
    for (kind, field), parts in by_name.items():  # several sensors: in the order of the log
        place = np.argsort(np.concatenate([series.order for series in parts]))
        value = np.concatenate([series.value for series in parts])[place]
        np.testing.assert_array_equal(value, np.array(expected[kind, field], float), err_msg=f"{kind}.{field}")
        assert parts[0].unit == PLAIN.get(unit := formats[kind].get_unit(field), unit)
    return set(expected) - set(by_name)


def test_a_small_log_equals_pymavlink_in_every_column(tmp_path):
    assert_equals_pymavlink(write(tmp_path, dataflash()))


@pytest.mark.parametrize("name", few(["log171.bin", "synthetic_boat_30s.BIN"], ["synthetic_boat_30s.BIN"], "thorough"))
def test_real_logs_equal_pymavlink_in_every_column(real_logs, name):
    path = real_logs / "formats" / "ardupilot" / name
    if not path.is_file():
        pytest.skip(f"needs shared/data/formats/ardupilot/{name}, which is not part of the repository")
    missing = {name for name in assert_equals_pymavlink(path) if name[0] in ("GPS", "IMU", "RCOU", "ATT")}
    assert {field for _, field in missing - {("GPS", "T")}} <= {
        "TimeUS",
        "TimeMS",
        "I",
    }  # the stamp, the sensor's number
