"""When logs began, where they tell it: runs of one boat that share minutes are of two boats, or copies."""

import struct

import numpy as np
import pytest

from tests.support.ardupilot import SERVOS, dataflash, described, tlog
from tests.support.files import write
from tests.support.strangers import sail
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.checks.data_check import check_data
from usvlearn.logs.formats.ardupilot.dataflash import DataFlash
from usvlearn.logs.formats.ardupilot.tlog import Tlog
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.inspection.logfiles import open_logs
from usvlearn.logs.read import read_recordings

UNIX = 1717406100.0  # 2024-06-03 09:15:00


def start(reader, path, **sources):
    return next(iter(reader.read(path, sources)[0].values())).start


@pytest.mark.parametrize("stamp", ["{:.1f}", "ns", "2024-06-03T09:15:{:04.1f}"])
def test_a_table_begins_at_its_first_stamp(tmp_path, stamp):
    shown = [UNIX + k / 10 if "T" not in stamp else k / 10 for k in range(200)]
    cells = [f"{each * 1e9:.0f}" if stamp == "ns" else stamp.format(each) for each in shown]
    path = write(tmp_path / "a.csv", "time,v\n" + "".join(f"{each},{k}\n" for k, each in enumerate(cells)))
    assert start(Table.of_file(path)[0], path, surge=Source("v")) == pytest.approx(UNIX, abs=1e-3)


def test_logs_of_moos_and_of_ardupilot_begin_when_they_say(tmp_path):
    path = write(tmp_path / "a.alog", "%%%\n%% LOGSTART  1717406100.5\n%%%\n0.5 NAV_SPEED iGPS 1.2\n")
    assert start(Alog(), path, surge=Source("NAV_SPEED")) == UNIX + 0.5
    path = write(tmp_path / "b.alog", "0.5 NAV_SPEED iGPS 1.2\n")
    assert np.isnan(start(Alog(), path, surge=Source("NAV_SPEED")))
    (tmp_path / "a.tlog").write_bytes(tlog(20))
    assert start(Tlog(), tmp_path / "a.tlog", heading=Source("ATTITUDE", "yaw")) == pytest.approx(1.7e9, abs=1)
    (tmp_path / "a.bin").write_bytes(dataflash(20))
    assert np.isnan(start(DataFlash(), tmp_path / "a.bin", **SERVOS))
    week, rest = divmod(UNIX - 315964800, 604800)
    fix = b"\xa3\x95\x4b" + struct.pack("<QIH", 5_500_000, round(rest * 1000), round(week))  # 5.5 s after its start
    (tmp_path / "a.bin").write_bytes(described(75, "GPS", "QIH", "TimeUS,GMS,GWk") + dataflash(20) + fix)
    assert start(DataFlash(), tmp_path / "a.bin", **SERVOS) == pytest.approx(UNIX - 5.5, abs=1e-3)


def rows(seed, begin, name):
    boat = sail(1, seed)
    columns = zip(boat["time"] + begin, boat["l"], boat["r"], boat["hdg"], boat["u"], strict=True)
    return [f"{t:.2f},{name},{left:.3f},{right:.3f},{psi:.1f},{v:.2f}\n" for t, left, right, psi, v in columns]


def shared(path):
    """What the check says of runs that share minutes."""
    names = {"command_left": "l", "command_right": "r", "heading": "psi", "surge": "v"}
    recordings = read_recordings(path, Table("time"), {name: {"name": each} for name, each in names.items()})
    return [each.found for each in check_data(recordings, None, {}) if each.kind == "together"]


@pytest.mark.parametrize(("first", "second", "told"), [(UNIX, UNIX + 30, 1), (UNIX, UNIX + 99, 0), (0, 0, 0)])
def test_two_boats_in_two_files_of_the_same_minutes_are_found(tmp_path, first, second, told):
    for name, begin in (("anna", first), ("bert", second)):
        write(tmp_path / f"{name}.csv", "time,id,l,r,psi,v\n" + "".join(rows(len(name), begin, 7)))
    findings = shared(tmp_path)
    assert len(findings) == told and all("anna and bert are of the same" in each for each in findings)


@pytest.mark.filterwarnings("ignore:.*the stamps jump back")
@pytest.mark.parametrize(("column", "names"), [("id", (1, 2)), ("node", ("red", "blue")), ("run", (1, 2))])
@pytest.mark.parametrize("begin", [0.0, UNIX])
def test_a_column_that_changes_where_the_clock_jumps_back_is_asked_about(tmp_path, column, names, begin):
    blocks = rows(1, begin, names[0]) + rows(2, begin, names[1])
    path = write(tmp_path / "a.csv", f"time,{column},l,r,psi,v\n" + "".join(blocks))
    asked = [each for each in open_logs([str(path)]).doubts if each.startswith("rows: ")]
    assert len(asked) == (column != "run") and all(f"data.boat_column={column}" in each for each in asked)
    assert len(shared(path)) == (begin > 0)
