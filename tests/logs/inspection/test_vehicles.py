"""Which vehicle, or vehicles, a log is of: what `usvlearn inspect` refuses, asks, or never mixes."""

import glob
from pathlib import Path

import numpy as np
import pytest

from tests.support.ardupilot import PARAMETERS, dataflash, frame
from tests.support.strangers import concluded, pulses, sail, told
from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.series import Series
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.inspection.logfiles import boats_of
from usvlearn.logs.inspection.vehicles import told_apart


@pytest.mark.parametrize("function", [4.0, 33.0])
def test_a_log_of_an_aeroplane_or_a_copter_is_refused_unless_it_is_wanted(tmp_path, function):
    path = tmp_path / "a.bin"
    path.write_bytes(dataflash(80, PARAMETERS | {"SERVO1_FUNCTION": function, "SERVO3_FUNCTION": 0.0}))
    with pytest.raises(LogFormatError, match=r"(aeroplane|multicopter).*--any-vehicle"):
        inspect_logs([str(path)])
    inspect_logs([str(path)], any_vehicle=True)


def test_two_vehicles_of_one_telemetry_log_are_never_one_boat(tmp_path):
    path, frames = tmp_path / "two.tlog", []
    for k in range(300):
        for system in (1, 2):
            at = {"time_boot_ms": 100 * k}
            turned = 0.02 * k * system % 6.28 - 3.14
            frames.append(frame("ATTITUDE", k / 10, sender=(system, 1), yaw=turned, yawspeed=0.2 * system, **at))
            servos = {f"servo{n}_raw": 1500 + (300 * n + 70 * system + 7 * k) % 400 for n in (1, 3)}
            frames.append(frame("SERVO_OUTPUT_RAW", k / 10, sender=(system, 1), time_usec=100_000 * k, **servos))
    path.write_bytes(b"".join(frames))
    result = inspect_logs([str(path)])
    names = {str(each["name"]) for each in result.proposal.channels.values() if each["name"]}
    assert names
    assert all(name.endswith("@1.1") for name in names)
    (asked,) = (each for each in result.decisions if each.what == "system")
    assert (asked.certainty, asked.alternatives) == ("unsure", ("2",))
    assert "@2.1" in asked.reason


@pytest.mark.parametrize("name", ["{0}_{1}", "{1}.{0}", "{0} {1}"])
def test_vehicles_that_only_names_tell_apart_are_never_one_boat(name):
    one, other = sail(6), sail(6, seed=7)
    columns = {}
    for vehicle, boat in zip(("1", "2") if name[1] == "0" else ("anna", "bert"), (one, other), strict=True):
        values = {
            "pwm_left": pulses(boat["l"]),
            "pwm_right": pulses(boat["r"]),
            "heading": boat["hdg"],
            "speed": boat["u"],
        }
        columns |= {name.format(key, vehicle): value for key, value in values.items()}
    proposal = concluded(one, **columns)
    first = "1" if name[1] == "0" else "anna"
    assert {each["name"] for each in proposal.channels.values() if each["name"]} == {
        name.format(key, first) for key in ("pwm_left", "pwm_right", "heading", "speed")
    }
    assert told(proposal)["vehicle", "system"][1] == "unsure"


@pytest.mark.parametrize("name", ["/{1}/{0}", "/{1}/{0}/value", "{1}.{0}"])
def test_vehicles_whose_commands_only_name_a_side_are_never_one_boat(name):
    columns = {}
    for vehicle, boat in (("alpha", sail(4)), ("bravo", sail(4, seed=7))):
        values = {"left": boat["l"], "right": boat["r"], "odom__heading": boat["psi"], "odom__u": boat["u"]}
        columns |= {name.format(key, vehicle): value for key, value in values.items()}
    proposal = concluded(sail(4), **columns)
    assert all("alpha" in each["name"] for each in proposal.channels.values() if each["name"])
    assert told(proposal)["vehicle", "system"] == ("alpha", "unsure")
    others = [other for each in proposal.decisions if each.channel != "vehicle" for other in each.alternatives]
    assert not any("bravo" in other for other in others)
    alone = {"/imu_left/heading": boat["psi"], "/imu_right/heading": boat["psi"], "/imu_left/r": boat["turn"]}
    assert ("vehicle", "system") not in told(concluded(boat, left=boat["l"], right=boat["r"], **alone))


SENDERS = [
    (("ATTITUDE", "1.1"), ("ATTITUDE", "2.1"), "1"), 
    (("DB_TIME", "MOOSDB_abe"), ("DB_TIME", "MOOSDB_ben"), "abe"),
    (("/usv1/odom", "O"), ("/usv2/odom", "O"), "usv1"), (("/usv1/odom", "O"), ("/usv1/odom", "O"), ""),
    (("/odom", "O"), ("/usv1/odom", "O"), ""), (("/imu/data", "I"), ("/gps/fix", "F"), ""),
]  # fmt: skip


@pytest.mark.parametrize(("one", "other", "boat"), SENDERS)
def test_logs_of_several_senders_are_told_apart(one, other, boat):
    logs = [[Series(name, "x", *np.ones((3, 9)), kind=kind)] for name, kind in (one, other)]
    assert next(iter(told_apart(logs)), "") == boat


@pytest.mark.parametrize(
    ("folders", "told"), [("anna bert", 2), ("usv1 usv2", 2), ("calm windy", 0), ("2024-06-01 2024-06-02", 0),
                          ("run1 run2", 0), ("usv_20240601 usv_20240602", 0), ("lap_a lap_b", 0)],
)  # fmt: skip
def test_folders_that_may_be_of_several_boats_are_told(folders, told):
    assert len(boats_of([Path("logs", each, "a.csv") for each in folders.split()])) == told


@pytest.mark.parametrize(
    ("files", "told"), [("anna_2025-06-01 bert_2025-06-02", 2), ("usv-a_20250601 usv-b_20250601", 2),
                        ("hai_01.06.2025 wal_02.06.2025", 2), ("zigzag_2025-06-01 turn_2025-06-01", 0),
                        ("anna bert", 0), ("anna_1 bert_1", 0), ("usv_20250601 usv_20250602", 0)],
)  # fmt: skip
def test_single_files_that_may_be_of_several_boats_are_told(files, told, tmp_path):
    paths = [tmp_path / f"{name}.csv" for name in files.split()]
    for path in paths:
        path.touch()
    boats = boats_of(paths)
    assert len(boats) == told
    assert sorted(path for each in boats.values() for path in glob.glob(each)) == sorted(map(str, paths)) * bool(told)
