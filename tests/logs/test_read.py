"""`read_recordings` finds the logs that a path means, and refuses bad ones in one sentence."""

import functools
import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from tests.support import REAL_LOGS, ROOT, few
from tests.support.files import configured, refused, write
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import AUXILIARY, Source
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.inspection.logfiles import open_logs
from usvlearn.logs.read import read_recordings

CONFIGS = ROOT / "configs" / "data"
DATA = REAL_LOGS
CHANNELS = {
    "command_left": {"name": "L"},
    "command_right": {"name": "R"},
    "heading": {"name": "psi", "unit": "deg"},
    "surge": {"name": "v"},
}
HEADER = "t,L,R,psi,v\n"


def test_runs_are_found_below_a_folder_in_natural_order(tmp_path):
    for name in ("day2/run_10.csv", "day2/run_2.csv", "day10/run_1.CSV", "day2/note.txt", ".trash/run_0.csv"):
        write(tmp_path / "heron" / name, HEADER + "0,0,0,0,1\n")
    recordings = read_recordings(tmp_path / "heron", Table("t"), CHANNELS)
    assert [r.run for r in recordings] == ["day2/run_2", "day2/run_10", "day10/run_1"]
    assert {r.boat for r in recordings} == {"heron"}
    recordings = read_recordings(str(tmp_path / "heron/day*/run_1*"), Table("t"), CHANNELS, boat="a")
    assert [(r.boat, r.run) for r in recordings] == [("a", "day2/run_10"), ("a", "day10/run_1")]


def test_a_mapping_names_the_boats_and_a_file_names_itself(tmp_path):
    path = write(tmp_path / "run[1].csv", HEADER + "0,0,0,0,1\n")
    recordings = read_recordings({"anna": path, "bert": str(tmp_path)}, Table("t"), CHANNELS)
    assert [(r.boat, r.run) for r in recordings] == [("anna", "run[1]"), ("bert", "run[1]")]
    assert read_recordings(path, Table("t"), CHANNELS)[0].boat == "run[1]"
    assert "BOAT: FILE" in refused(ConfigError, read_recordings, {"anna": path}, Table("t"), CHANNELS, "bert")


def test_channels_that_are_not_logged_are_skipped(tmp_path):
    path = write(tmp_path / "a.csv", HEADER + "0,0,0,0,1\n")
    for absent in (None, {"name": None, "unit": "rad/s"}):
        (recording,) = read_recordings(path, Table("t"), {**CHANNELS, "yaw_rate": absent})
        assert list(recording.channels) == ["command_left", "command_right", "heading", "surge"]
    (recording,) = read_recordings(path, Table("t"), {**CHANNELS, "yaw_rate": Source("v", unit="deg/s")})
    np.testing.assert_allclose(recording.channels["yaw_rate"].value, [math.pi / 180], rtol=1e-15)


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("mission.csv", ["mission.csv", "does not exist", "did you mean", "missions.csv"]),
        ("nothing/like/it", ["does not exist", "(.csv or .tsv or .slog"]),
        ("empty", ["empty", "0 files", ".csv"]),
        ("other", ["none among its 1 files", ".csv"]),
        ("no*.csv", ["no*.csv", "0 files"]),
        *((unset, ["is not set: set data.path=FILE"]) for unset in (None, "???", "")),
        (3, ["found 3", "pattern"]),
        ({}, ["no boat"]),
    ],
)
def test_a_path_without_logs_is_refused(tmp_path, monkeypatch, path, expected):
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    write(Path("other/a.alog"), "0 A b 1\n")
    write(Path("missions.csv"), HEADER)
    message = refused(ConfigError, read_recordings, path, Table("t"), CHANNELS)
    assert message.startswith("data.path") and all(part in message for part in expected)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"speed": {"name": "v"}}, ["'speed'", "surge"]),
        ({"surge": None}, ["no surge", "data.channels.surge.name"]),
        ({"surge": {"column": "v"}}, ["'column'", "name, field"]),
        ({"surge": "v"}, ["data.channels.surge", "'v'"]),
        ({"surge": {"name": "v", "span": "wide"}}, ["data.channels.surge.span", "'wide'"]),
        ({"surge": {"name": "v", "held": "yes"}}, ["data.channels.surge.held", "'yes'"]),
        ({"surge": {"name": "v", "unit": "Mach"}}, ["'Mach'", "knots"]),
        *(({"surge": {"name": "v", "period": each}}, ["data.channels.surge.period: found ", words])
          for each, words in (("fast", "a time in s, or auto"), (-1.0, "a time of 0 to 10 s, or auto"),
                             (50, "a time of 0 to 10 s, or auto"), (math.nan, "or auto"), (True, "in s, or auto"))),
        *(({name: {"name": "v", "unit": unit}}, [f"data.channels.{name}.unit: found {unit!r}, expected one of {legal}"])
          for name, unit, legal in (("surge", "deg", "1, m/s"), ("surge", "kn", "1, m/s"), ("sway", "deg/s", "1, m/s"),
                                   ("heading", "m/s", "1, rad, deg"), ("command_left", "rad", "1, percent"),
                                   ("yaw_rate", "deg", "1, rad/s"), ("latitude", "m", "1, deg"),
                                   ("north", "deg", "1, m"))),
    ],
)  # fmt: skip
def test_badly_declared_channels_are_refused(tmp_path, change, expected):
    path = write(tmp_path / "a.csv", HEADER + "0,0,0,0,1\n")
    message = refused(ConfigError, read_recordings, path, Table("t"), {**CHANNELS, **change})
    assert all(part in message for part in expected)


@pytest.mark.parametrize(
    ("name", "content", "reader", "expected"),
    [
        ("a.csv", "", Table("t"), ["empty file"]),
        ("a.csv", "\n\n", Table("t"), ["time column 't'", "(none)"]),
        ("a.csv", HEADER, Table("t"), ["nothing below the header"]),
        ("a.csv", HEADER + "0,0,0\n", Table("t"), ["5 cells", "found 3 in line 2"]),
        ("a.csv", HEADER + "0,0,0,0,1\n", Table("stamp"), ["'stamp'", "'t', 'L', 'R'", "data.reader.time"]),
        ("a.csv", HEADER.replace(",", ";"), Table("t", delimiter=","), ["data.reader.delimiter"]),
        ("a.csv", HEADER + "noon,0,0,0,1\n", Table("t"), ["line 2", "'noon'", "data.reader.time"]),
        (
            "a.csv",
            HEADER.replace("v", "vel") + "0,0,0,0,1\n",
            Table("t"),
            ["channels.surge.name", "'v'", "vel"],
        ),
        ("a.csv", HEADER + "0,0,0,0,fast\n1,0,0,0,\n", Table("t"), ["surge", "'v'", "'fast'", "1 empty"]),
        ("a.csv", HEADER + "0,0,0,0," + "9" * 200_000, Table("t"), ["line 2", "fix"]),
        ("a.csv", "#ROSBAG V2.0\nE\0\0\0index_pos=", Table("t"), ["binary data"]),
        ("a.alog", "t,L,R\n0,1,2\n", Alog(), ["no row of the form"]),
        ("a.alog", "%% LOGSTART 1\n", Alog(), ["no row of the form"]),
        ("a.alog", "0 L a 0\n0 R a 0\n0 psi a 0\n0 w a 0\n", Alog(), ["surge.name", "'v'", "L, R, psi, w"]),
        ("a.alog", "0 L a 0\n0 R a 0\n0 psi a 0\n0 v a n/a\n", Alog(), ["surge", "'v'", "'n/a'"]),
        ("a.bag", "0.1 L a 0\n", Rosbag(), ["whole ROS bag"]),
    ],
)
def test_a_log_that_is_not_as_declared_is_refused(tmp_path, name, content, reader, expected):
    path = write(tmp_path / name, content)
    message = refused(LogFormatError, read_recordings, path, reader, CHANNELS)
    assert message.startswith(str(path)) and all(part in message for part in expected)


def test_a_file_name_of_any_bytes_names_a_run_that_can_be_written(tmp_path):
    path = write(tmp_path / os.fsdecode(b"caf\xe9\n.csv"), "t,L,R,v,psi\n" + "0,0.5,0.5,1,90\n" * 3)
    (recording,) = read_recordings(path, Table("t"), CHANNELS)
    assert recording.run == recording.boat == "caf\\udce9\\n" and recording.run.encode()


# ---------------------------------------------------------------- configs/data


@pytest.mark.parametrize(
    ("name", "count"), [("alog", 14), ("ardupilot", 10), ("csv", 14), ("rosbag", 14), ("tlog", 10)]
)
def test_generic_configs_list_every_option_of_every_channel(name, count):
    channels = OmegaConf.load(CONFIGS / f"{name}.yaml").data.channels
    options = set(Source.__dataclass_fields__) - ({"field"} if name in ("alog", "csv") else set())
    assert len(channels) == count
    for name, source in channels.items():
        if name in AUXILIARY and source.name is None:  # a line each, with what is set most often
            assert {"name", "unit", "span", "window"} <= set(source) <= options | {"field"}, name
            continue
        measured = name == "surge" or name in AUXILIARY
        assert set(source) - {"weight"} == options - {"delay" if measured else "period"}, name


def test_alog_config_holds_commands_that_are_posted_on_change(tmp_path):
    rows = "0 DESIRED_THRUST_L p 50\n0 DESIRED_THRUST_R p -100\n1 NAV_HEADING g 90\n1 NAV_SPEED g 1\n"
    (recording,) = configured("alog", write(tmp_path / "a.alog", rows))
    left, right = recording.channels["command_left"], recording.channels["command_right"]
    assert (left.value, right.value) == (0.5, -1.0) and left.held and right.held
    assert recording.channels["heading"].value == pytest.approx(math.pi / 2)
    assert not recording.channels["surge"].held


@functools.cache
def recorded(boat: str) -> list:
    if not (DATA / boat).is_dir():
        pytest.skip(f"needs the logs in shared/data/{boat}, which are not part of the repository")
    return configured(boat, DATA / boat)


RECORDED = {  # boat -> runs, counts of messages, least and greatest speed, messages dropped
    "blueboat": (12, (14067, 14067, 14067, 14067, 14055), (-2.32, 3.42), 12),
    "vtec": (18, (47555, 47669, 29004, 11851, 11851), (-0.12, 1.48), 0),
    "dalian": (1, (1536, 1536, 1536, 0, 1536), (0.17, 1.06), 0),
    "pearl": (1, (700, 700, 88, 0, 88), (0.0, 0.44), 0),
}


@pytest.mark.parametrize("boat", few(RECORDED, {*RECORDED} - {"vtec"}, "thorough"))
def test_real_logs(boat):
    (runs, counts, surge, dropped), recordings = RECORDED[boat], recorded(boat)
    assert len(recordings) == runs == len({r.run for r in recordings})
    assert {r.boat for r in recordings} == {boat}
    channels = ("command_left", "command_right", "heading", "yaw_rate", "surge")
    lengths = [sum(len(r.channels[c].time) for r in recordings if c in r.channels) for c in channels]
    assert lengths == list(counts)
    speeds = np.concatenate([r.channels["surge"].value for r in recordings])
    assert (speeds.min(), speeds.max()) == pytest.approx(surge, abs=0.01)
    assert sum(sum(r.dropped.get(name, {}).values()) for r in recordings for name in channels) == dropped
    for side in ("command_left", "command_right"):
        share = np.concatenate([r.channels[side].value for r in recordings])
        assert 0.6 < np.abs(share).max() < 1.03  # PWM 1100 lies 411 us below the BlueBoat's zero, span 400


def test_one_unreadable_log_among_several_is_left_out_with_a_warning(tmp_path):
    write(tmp_path / "good.csv", "t,L,R,v,psi\n0,0.5,0.5,1.0,90\n")
    write(tmp_path / "torn.csv", "")
    channels = {"command_left": "L", "command_right": "R", "surge": "v", "heading": "psi"}
    channels = {name: Source(column) for name, column in channels.items()}
    with pytest.warns(UserWarning, match=r"left out: .*torn\.csv.*empty"):
        recordings = read_recordings(tmp_path, Table("t"), channels)
    assert [recording.run for recording in recordings] == ["good"]
    (tmp_path / "good.csv").unlink()
    with pytest.raises(LogFormatError, match=r"torn\.csv"):
        read_recordings(tmp_path, Table("t"), channels)


def test_a_reader_that_fails_on_one_log_leaves_the_others_in_the_folder(tmp_path, monkeypatch):
    for name in ("bad", "good"):
        write(tmp_path / f"{name}.csv", "t,L,R,v,psi\n" + "".join(f"{k},0.5,0.5,1.{k},{k}\n" for k in range(9)))
    for method in ("read", "survey"):
        original = getattr(Table, method)

        def fails(self, path, *given, original=original):
            return original(self, path, *given) if path.stem != "bad" else {}["Mult"]

        monkeypatch.setattr(Table, method, fails)
    channels = {"command_left": "L", "command_right": "R", "surge": "v", "heading": "psi"}
    text = r"bad\.csv: cannot be read \(KeyError: 'Mult', in test_read\.py:\d+\): leave it out, and report"
    with pytest.warns(UserWarning, match=f"log left out: .*{text}"):
        recordings = read_recordings(tmp_path, Table("t"), {name: Source(column) for name, column in channels.items()})
    assert [recording.run for recording in recordings] == ["good"]
    logs = open_logs([str(tmp_path)])
    assert len(logs.surveyed) == 1 and re.search(text, logs.notes[0])
