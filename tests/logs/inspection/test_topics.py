"""Tables of which each has one topic: what `usvlearn inspect` joins, what it leaves apart, and what it says."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.support import few
from tests.support.exported import write_table
from tests.support.shapes import certainties, score
from tests.support.topic_tables import TOPICS, ferry, numbers, rostopic, rotation
from tests.support.voyages import voyage
from usvlearn.cli.main import main
from usvlearn.composition.configuration import configs_folder, recordings_of
from usvlearn.errors import LogFormatError
from usvlearn.logs.inspection.inspected import inspect_logs


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Runs the command in an empty folder; gives its code and all that it printed, in one line."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("COLUMNS", "80")

    def call(path):
        monkeypatch.setattr(sys, "argv", ["usvlearn"])
        try:
            code = main(["inspect", str(path)])
        except SystemExit as end:
            code = end.code
        return code, " ".join("".join(capsys.readouterr()).split())

    return call


@pytest.mark.thorough
@pytest.mark.parametrize("name", few(TOPICS, ["rostopic"], "thorough"))
def test_topics_are_read_as_they_were_written(tmp_path, name):
    read = inspect_logs([str(TOPICS[name].write(tmp_path, voyage(0, minutes=4.0)))])
    result = score(read.proposal.channels, certainties(read.decisions), TOPICS[name].truth)
    assert result.wrong == result.unsure == []
    assert len(read.recordings) == 1 and read.findings == []


@pytest.mark.parametrize(("prefix", "dot"), [("field.twist.twist.", "."), ("/boat/odom/twist/", "/")])
def test_the_twist_of_an_odometry_without_a_position_is_the_speed(tmp_path, prefix, dot):
    log, time = voyage(0, minutes=4.0), np.arange(1.0, 200.0, 0.2)
    turned = rotation(f"orientation{dot}", np.pi / 2 - log.at("heading", time))
    drive = {side: log.at(f"command_{side}", time) for side in ("left", "right")}
    wanted = {f"/cmd_vel/linear{dot}x": 1.1 * log.at("surge", time)}
    twist = {
        f"{prefix}linear{dot}{axis}": value for axis, value in (("x", log.at("surge", time)), ("y", 0.01 * time % 0.1))
    }
    for name, columns in {"cmd_drive": drive, "imu": turned, "goal": wanted, "odom": twist}.items():
        write_table(tmp_path / f"{name}.csv", {"__time": time, **columns})
    result = inspect_logs([str(tmp_path)])
    assert result.proposal.channels["surge"]["name"] == f"odom.{prefix}linear{dot}x"
    assert result.findings == []


def test_tables_of_one_number_are_told_by_their_files(tmp_path):
    log, time = voyage(0, minutes=4.0), np.arange(1.0, 200.0, 0.2)
    names = {"port": "command_left", "starboard": "command_right", "heading": "heading", "speed": "surge"}
    for name, of in names.items():
        write_table(tmp_path / f"{name}.csv", {"timestamp": time, "value": log.at(of, time)})
    result = inspect_logs([str(tmp_path)])
    assert {result.proposal.channels[of]["name"] for of in names.values()} == {f"{name}.value" for name in names}
    sides = [each.reason for each in result.decisions if (each.channel, each.what) == ("command_left", "series")]
    assert [each.partition(";")[0] for each in sides] == ["by name"]


@pytest.mark.thorough
def test_a_folder_of_runs_each_with_a_folder_of_topics(tmp_path, run):
    for k in range(2):
        shutil.move(rostopic(tmp_path, voyage(k, minutes=2.0)), tmp_path / "logs" / f"run_{k}")
    code, printed = run(tmp_path / "logs")
    assert code == 0 and "joined by time (cmd_drive, imu, odom): none has all channels" in printed.replace("\n", " ")
    recordings, _ = recordings_of("my_boat.yaml", {})
    assert [(each.boat, each.run) for each in recordings] == [("logs", "run_0"), ("logs", "run_1")]


def plain(path, **changes):
    time = np.arange(0, 60, 0.1)
    wave = np.sin(time / 5)
    columns = {"time": time, "left": wave, "right": np.cos(time / 7), "heading": 90 + 80 * wave, "speed": 1 + wave}
    return write_table(path, columns | changes)


@pytest.mark.thorough
def test_runs_stay_apart_and_it_says_why(tmp_path, run):
    plain(tmp_path / "run_1.csv")
    plain(tmp_path / "run_2.csv")
    assert "Each file is a run: they have the same columns" in run(tmp_path)[1]
    assert len(recordings_of("my_boat.yaml", {})[0]) == 2
    write_table(tmp_path / "battery.csv", {"time": np.arange(60.0), "volt": np.arange(60.0), "soc": np.arange(60.0)})
    result = inspect_logs([str(tmp_path)])
    assert result.logs.joined == "Each file is a run: run_1.csv has all channels."
    assert len(result.logs.files) == 3 and len(result.recordings) == 2


def test_several_tables_of_a_run_are_given_by_name(tmp_path):
    folder = numbers(tmp_path, voyage(0, minutes=2.0))
    files = sorted(map(str, folder.glob("*.csv")))
    assert inspect_logs(files).settings["data"]["path"] == str(folder)
    with pytest.raises(LogFormatError, match=r"found 3 given and speed\.csv not: give the folder"):
        inspect_logs(files[:-1])


@pytest.mark.thorough
def test_a_table_of_another_clock_is_left_out(tmp_path):
    folder = rostopic(tmp_path, voyage(0, minutes=2.0))
    lines = (folder / "imu.csv").read_text().splitlines()
    simulated = [
        f"{int(cell) - 1690000000 * 10**9},{rest}" for cell, _, rest in (each.partition(",") for each in lines[1:])
    ]
    (folder / "imu.csv").write_text("\n".join([lines[0], *simulated]))
    (folder / "empty.csv").write_text("")
    (folder / "header.csv").write_text("%time,field.data\n")
    result = inspect_logs([str(folder)])
    assert result.settings["data"]["channels"]["heading"]["name"] == "odom.field.pose.pose.orientation"
    notes = " ".join(result.notes)
    assert (
        "found imu from 0." in notes
        and "cmd_drive from 2023-07-22 04:26:40" in notes
        and "their clocks or time zones differ" in notes
    )
    assert "empty.csv" in notes and "header.csv" in notes


def test_azimuth_thrusters_without_a_force_are_told_in_one_sentence(tmp_path, run):
    folder = ferry(tmp_path, voyage(0, minutes=2.0))
    (folder / "wrench.csv").unlink()
    code, printed = run(folder)
    assert code == 2 and "the thrusters turn (thrusters.azimuth_1, thrusters.azimuth_2)" in printed
    assert "as tau_x and tau_n" in printed and not Path("my_boat.yaml").exists()


def test_the_template_that_a_message_names_reads_these_logs(tmp_path, run):
    folder, time = tmp_path / "logs", np.arange(0, 8, 0.2)
    folder.mkdir()
    write_table(folder / "one.csv", {"stamp": time, "alpha": np.sin(time), "beta": np.cos(time)})
    write_table(folder / "two.csv", {"stamp": time, "gamma": time, "delta": 1 + 0 * time, "qx": 0 * time,
                                     "qy": 0 * time, "qz": np.sin(time / 9), "qw": np.cos(time / 9)})  # fmt: skip
    code, printed = run(folder)
    assert code == 2 and "found no command_left, command_right" in printed
    template = configs_folder() / "data" / "topics.yaml"
    assert f"copy {template} to my_boat.yaml" in printed
    settings = yaml.safe_load(template.read_text())
    settings["data"]["path"] = str(folder)
    names = {"command_left": "one.alpha", "command_right": "beta", "surge": "two.delta", "heading": "two.q"}
    for channel, name in names.items():
        settings["data"]["channels"][channel]["name"] = name
    Path("my_boat.yaml").write_text("# @package _global_\n" + yaml.safe_dump(settings))
    (recording,) = recordings_of("my_boat.yaml", {})[0]
    assert recording.channels["heading"].value == pytest.approx(np.pi / 2 - 2 * time / 9)


def test_one_table_of_several_names_its_folder(tmp_path, run):
    folder = rostopic(tmp_path, voyage(0, minutes=2.0))
    code, printed = run(folder / "odom.csv")
    assert code == 2 and "if another table of its folder has them, give the folder" in printed
