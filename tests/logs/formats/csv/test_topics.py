"""Tables that are topics of one run: which column a name means, how time joins them, and what is refused."""

import math

import numpy as np
import pytest

from tests.support.files import refused, write
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.read import read_recordings

NAMES = {"command_left": "drive.left", "command_right": "right", "heading": "imu.q", "surge": "odom.v"}
CHANNELS = {name: {"name": each} for name, each in NAMES.items()}


def quaternion(yaw: float) -> str:
    return f"0,0,{math.sin(yaw / 2):.6f},{math.cos(yaw / 2):.6f}"


def topics(folder, start=100.0, imu_start=100.0):
    write(folder / "drive.csv", "t,left,right\n" + "".join(f"{start + k},{k / 10},0.5\n" for k in range(5)))
    rows = "".join(f"{(imu_start + k + 0.25) * 1e3:.0f},{quaternion(0.1 * k)}\n" for k in range(5))
    write(folder / "imu.csv", "stamp_ms,qx,qy,qz,qw\n" + rows)
    write(folder / "odom.csv", "time,v\n" + "".join(f"{start + k + 0.5},{k}\n" for k in range(5)))
    return folder


def read(folder, channels=CHANNELS, table=None):
    return read_recordings(folder, table or Table("auto"), channels)


def test_time_joins_them(tmp_path):
    (run,) = read(topics(tmp_path / "logs" / "heron"))
    assert (run.boat, run.run) == ("heron", "heron")
    assert run.channels["heading"].value == pytest.approx(0.1 * np.arange(5), abs=1e-5)
    starts = {name: each.time[0] for name, each in run.channels.items()}
    assert starts == pytest.approx({"command_left": 0, "command_right": 0, "heading": 0.25, "surge": 0.5})
    places = sorted((place, name) for name, each in run.channels.items() for place in each.order.tolist())
    assert [name for _, name in places[:5]] == ["command_left", "command_right", "heading", "surge", "command_left"]


def test_each_folder_below_is_a_run(tmp_path):
    for day in (10, 9):
        topics(tmp_path / "logs" / f"day_{day}", start=100.0 * day, imu_start=100.0 * day)
    assert [run.run for run in read(tmp_path / "logs")] == ["day_9", "day_10"]


@pytest.mark.parametrize(("imu_start", "surge", "told"), [
    (100.0, "v", ["'v' is in several tables: name one of odom.v, wanted.v"]),
    (100.0, "odom.speed", ["'odom.speed'", "drive.left", "odom.v"]),
    (0.0, "odom.v", ["imu from 0.25 to 4.25 s", "their clocks or time zones differ"]),
    (1.7e9, "odom.v", ["imu from 2023-11-14", "their clocks or time zones differ"]),
])  # fmt: skip
def test_what_cannot_be_joined_is_told(tmp_path, imu_start, surge, told):
    folder = topics(tmp_path, imu_start=imu_start)
    write(folder / "wanted.csv", "time,v\n" + "".join(f"{100 + k},9\n" for k in range(5)))
    message = refused(LogFormatError, read, folder, CHANNELS | {"surge": {"name": surge}})
    assert all(part in message for part in told)
    if imu_start == 100:
        assert read(folder)[0].channels["surge"].value.max() == 4


def test_a_complete_table_beside_others_is_a_run(tmp_path):
    """So what was read before topics were known is read as then."""
    folder = topics(tmp_path)
    write(folder / "whole.csv", "time,L,R,psi,v\n0,0,0,0,1\n1,0,0,0,1\n")
    names = {"command_left": "L", "command_right": "R", "heading": "psi", "surge": "v"}
    with pytest.warns(UserWarning, match="log left out"):
        (run,) = read(folder, {name: {"name": each} for name, each in names.items()}, Table("time"))
    assert run.run == "whole"
    message = refused(LogFormatError, read, folder, CHANNELS, Table("time", files="runs"))
    assert "drive.csv" in message


def test_of_two_clocks_that_share_nothing_the_longer_tables_are_read(tmp_path):
    for name, begin, rows in (("a", 1e9, 50), ("b", 1e9, 50), ("c", 2e9, 5), ("d", 2e9, 5)):
        write(tmp_path / f"{name}.csv", "time,v\n" + "".join(f"{begin + k},{k}\n" for k in range(rows)))
    with pytest.warns(UserWarning, match="table left out") as caught:
        assert {each.name for each in Table("auto").survey(tmp_path)} == {"a.v", "b.v"}
    assert len(caught) == 2


def test_a_bad_quaternion_is_masked_and_counted(tmp_path):
    folder = topics(tmp_path)
    lines = (folder / "imu.csv").read_text().splitlines()
    lines[2], lines[3], lines[4] = "101250,0,0,0,0.5", "102250,0,0,nan,1", "103250,,,,"
    write(folder / "imu.csv", "\n".join(lines))
    (run,) = read(folder)
    assert run.dropped["heading"] == {"no_rotation": 2, "empty": 1} and len(run.channels["heading"].time) == 2


def test_time_backwards_and_unreadable_stamps_are_no_crash(tmp_path):
    folder = topics(tmp_path)
    write(folder / "odom.csv", "time,v\n102,1\n101,2\nx,3\n103,4\n")
    (run,) = read(folder, table=Table("time"))
    assert run.channels["surge"].value.tolist() == [1, 2, 4] and run.dropped["surge"] == {"no_time": 1}
    assert (np.diff(run.channels["surge"].order) > 0).all()


def test_an_empty_table_is_left_out_or_named(tmp_path):
    folder = topics(tmp_path)
    write(folder / "empty.csv", "")
    with pytest.warns(UserWarning, match=r"empty\.csv: expected a table, found an empty file"):
        read(folder)
    write(folder / "odom.csv", "")
    with pytest.warns(UserWarning, match="table left out"):
        message = refused(LogFormatError, read, folder)
    assert "'odom.v'" in message


def test_force_and_moment_are_commands_with_a_unit(tmp_path):
    folder = topics(tmp_path)
    write(folder / "wrench.csv", "time,X,N\n" + "".join(f"{100 + k},{100 * k},{-50 * k}\n" for k in range(5)))
    mixed = {"name": ["wrench.X", "wrench.N"], "unit": ["N", "N·m"], "span": [800, 400]}
    sides = {f"command_{side}": mixed | {"weight": [1, way]} for side, way in (("left", 1), ("right", -1))}
    (run,) = read(folder, CHANNELS | sides)
    assert run.channels["command_right"].value == pytest.approx(0.25 * np.arange(5))
    for unit, text in ((["N", "Nm"], "'Nm'"), (["N"], "1 values"), ("m/s", "'m/s'")):
        assert text in refused(ConfigError, read, folder, CHANNELS | {"command_left": mixed | {"unit": unit}})
    message = refused(ConfigError, read, folder, CHANNELS | {"command_left": {"name": "wrench.X", "unit": "N"}})
    assert "span: found 1 for 'wrench.X' in N, expected the greatest one" in message


def test_a_name_of_a_quaternion_finds_its_yaw_in_one_table(tmp_path):
    path = write(tmp_path / "a.csv", "t,o.x,o.y,o.z,o.w\n" + "".join(f"{k},{quaternion(k)}\n" for k in range(3)))
    channels, _ = Table("t").read(path, {"heading": Source("o", unit="enu_rad")})
    assert channels["heading"].value == pytest.approx(math.pi / 2 - np.arange(3), abs=1e-5)
    (series,) = Table("t").survey(path)
    assert (series.name, series.unit) == ("o", "enu_rad")
