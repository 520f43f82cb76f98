"""`usvlearn plan`: its tables, and files that other programs read."""

import csv
import sys

import numpy as np
import pytest

from usvlearn.__main__ import main
from usvlearn.core import checkpoint
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.setup import Setup
from usvlearn.model.planning.course import Limits
from usvlearn.model.planning.search import Rehearsal, csv_lines, derived, search

SHORT = Limits(minutes=1.0)


@pytest.fixture(scope="module")
def plan(boat):
    rehearsal = Rehearsal(boat.members, boat.leaves)
    return search(rehearsal, SHORT, 0.4, derived(rehearsal.identified))


def at(times, values, when):
    """The value in force."""
    return values[np.searchsorted(times, when, side="right") - 1]


@pytest.mark.thorough
def test_the_table_states_the_commands_of_every_moment(plan):
    rows = list(csv.DictReader(csv_lines(plan)))
    times = np.array([float(row["time_s"]) for row in rows])
    for side in ("left", "right"):
        values = np.array([float(row[side]) for row in rows])
        for k, value in enumerate(getattr(plan.course, side)):
            assert at(times, values, k * 0.4 + 0.01) == pytest.approx(value, abs=1e-3)
        assert values[-1] == 0
    for row in rows:
        left, right, throttle, steering = (float(row[name]) for name in ("left", "right", "throttle", "steering"))
        assert (throttle + steering, throttle - steering) == pytest.approx((left, right), abs=2e-3)
    assert times[-1] == pytest.approx(60.0, abs=0.2)


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    try:
        return main(["plan", *map(str, arguments)])
    except SystemExit as stopped:
        return stopped.code


@pytest.mark.thorough
def test_the_command_prints_its_tables_and_writes_its_files(saved, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "next"
    arguments = (saved, "--minutes", 1, "--out", folder)
    assert run(monkeypatch, *arguments) == 0
    shown = capsys.readouterr().out
    assert "heron: what to sail for 1 min" in shown and "this plan" in shown and "thrust_full_left" in shown
    assert sorted(path.name for path in folder.iterdir()) == ["heron.csv"]
    before = (folder / "heron.csv").read_text()
    assert run(monkeypatch, *arguments) == 0 and (folder / "heron.csv").read_text() == before


@pytest.mark.thorough
def test_a_boat_that_is_well_known_is_said_to_be_so(saved, tmp_path, monkeypatch, capsys):
    leaves, facts = checkpoint.load(saved)
    for name, leaf in leaves.items():
        if name.endswith(".factor"):
            np.fill_diagonal(leaf, np.diag(leaf) * 1e-6)
    known = tmp_path / "known.safetensors"
    checkpoint.save(known, leaves, **facts)
    assert run(monkeypatch, known, "--minutes", 1, "--out", tmp_path / "next") == 0
    shown = capsys.readouterr().out
    assert "Every quantity is known to ± 10% or better" in shown and "most, by" in shown


def test_a_set_without_a_reader_is_said(saved, tmp_path, monkeypatch, capsys):
    leaves, facts = checkpoint.load(saved)
    facts["kernel"]["members"] = {name: {**each, "kind": "aid"} if each["kind"] == "joint" else each
                                  for name, each in facts["kernel"]["members"].items()}  # fmt: skip
    checkpoint.save(tmp_path / "other.safetensors", leaves, **facts)
    assert run(monkeypatch, tmp_path / "other.safetensors", "--out", tmp_path / "next") == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and not (tmp_path / "next").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--minutes", "0"], "--minutes"),
        (["--command-max", "0"], "--command-max"),
        (["--area", "10", "--command-min", "0.3", "--minutes", "1"], "--area: found 10 m"),
        (["--turn-rate", "-20"], "--turn-rate: found -20, expected 1 to 90 degrees/s"),
        (["--minutes", "1e9", "--segment", "1e9"], "--minutes: found 1e+09, expected 120 at most"),
        (["--boat", "otter"], "--boat: found 'otter', expected heron"),
        (["--heading", "nan"], "--heading"),
    ],
)
def test_bad_options_are_said_in_one_sentence(arguments, said, saved, tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, saved, *arguments, "--out", tmp_path / "next") == 2
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if "compiling" not in line]
    assert len(lines) == 1 and said in lines[0] and not (tmp_path / "next").exists()


@pytest.mark.thorough
def test_a_boats_name_leads_into_no_other_folder(saved, tmp_path, monkeypatch, capsys):
    leaves, facts = checkpoint.load(saved)
    path = checkpoint.save(tmp_path / "a.safetensors", leaves, **{**facts, "boat": "../../evil\n"})
    assert run(monkeypatch, path, "--minutes", 1, "--out", tmp_path / "in" / "out") == 0
    files = [each for each in tmp_path.rglob("*") if each.is_file() and each != path]
    assert len(files) == 1 and all(each.parent == tmp_path / "in" / "out" for each in files)


def test_a_boat_whose_thrust_points_astern_is_not_sent_to_sea(saved, tmp_path, monkeypatch, capsys):
    leaves, facts = checkpoint.load(saved)
    turned = {}
    for name, leaf in leaves.items():
        if name.endswith(("mean", "reading")):
            first = 4 if name.endswith("mean") else 0
            leaf = leaf.copy()
            leaf[first + 3 : first + 11] *= -1  # all thrust
        turned[name] = leaf
    path = checkpoint.save(tmp_path / "a.safetensors", turned, **facts)
    assert run(monkeypatch, path, "--minutes", 1, "--out", tmp_path / "out") == 2
    assert "error: heron: The identified boat is not physical: it has a steady speed" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_table_states_the_speed_at_each_time(plan):
    rows = [[float(x) for x in line.split(",")] for line in list(csv_lines(plan))[1:]]
    expected = np.append(0.0, plan.expected.speed)
    for row in rows:
        assert row[6] == pytest.approx(expected[round(row[0] / plan.course.dt)], abs=0.006)
    assert rows[0][6:] == [0.0, 0.0, 0.0]


@pytest.mark.thorough
def test_a_boat_with_one_command_gets_one_and_learns_no_side(saved, tmp_path, monkeypatch, capsys):
    """Left and right of a plan were posted to the same variable, one after the other."""
    leaves, facts = checkpoint.load(saved)
    channels = {name: Source("DESIRED_THRUST", unit="percent") for name in ("command_left", "command_right")}
    channels |= {"heading": Source("H"), "surge": Source("V")}
    facts["setup"] = Setup(channels, reader="usvlearn.logs.formats.moos.alog.Alog").json()
    checkpoint.save(tmp_path / "one.safetensors", leaves, **facts)
    monkeypatch.setattr(sys, "argv", ["usvlearn", "plan", "one.safetensors", "--minutes=1"])
    monkeypatch.chdir(tmp_path)
    assert main() == 0
    rows = list(csv.DictReader(next((tmp_path / "plan").glob("*.csv")).read_text().splitlines()))
    assert {row["steering"] for row in rows} == {"0.000"}
    shown = capsys.readouterr().out
    assert "steady_speed_full" in shown and "thrust_ratio" not in shown.partition("Half-width")[2].partition("Not")[0]
