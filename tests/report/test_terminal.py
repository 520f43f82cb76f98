"""Tables at any width: every number and name is whole, and no line is wider than the terminal."""

import io
import os
import pty
import re
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console, Group

from tests.support import ROOT, over
from usvlearn.core import jit
from usvlearn.core.activity import doing
from usvlearn.display.terminal import Activity, Blocks, console
from usvlearn.estimators.joint.periodic_estimates import Identified, Quantity
from usvlearn.evaluation.metrics import scores
from usvlearn.report.summary import summary
from usvlearn.report.tables import error_tables, identified_table, quoted, rejection_table, tuning_table

WIDTHS = [60, 80, 100, 160]
NAMES = ["aid", "rls", "ambient_rls_short", "persistence", "average", "a_member_with_a_long_name"]
REMARKS = {"rls": "quasi-static map", "persistence": "baseline"}
NUMBER = r"-?\d+\.\d+%?|\d+"


def printed(table, width: int) -> list[str]:
    screen = Console(file=io.StringIO(), width=width, markup=False)
    screen.print(table)
    return screen.file.getvalue().splitlines()


def fleet(count: int, name: str = "heron") -> dict[str, dict]:
    """Scores of boats; one member is far off, and diverges on the last of them."""
    rng, boats = np.random.default_rng(count), {}
    for k in range(count):
        surge = rng.random(2000)
        predictions = surge[:, None] + 10.0 ** -np.arange(len(NAMES)) * rng.normal(size=(2000, len(NAMES)))
        predictions[:3, 1] = np.inf if k + 1 == count > 1 else 1.0
        boats[f"{name}{k + 1}"] = scores(predictions, surge, NAMES, 0.1 + np.abs(predictions - surge[:, None]))
    return boats


@pytest.mark.thorough
@pytest.mark.parametrize("width", WIDTHS)
@over("name", ["heron", "blueboat_of_the_northern_harbour_"])
@over("count", [1, 8, 20])
def test_the_tables_of_a_run_are_whole(count, name, width):
    boats = fleet(count, name)
    channels = {
        "surge": {"stale": 1234567, "out_of_range": 7654321, "duplicate": 17, "repeated": 4},
        "heading": {"lost": 3},
    }
    rejected = dict.fromkeys(boats, channels)
    lines = printed(Group(rejection_table(rejected), error_tables(boats, REMARKS)), width)
    assert max(map(len, lines)) <= width and "…" not in "".join(lines)
    whole = printed(Group(rejection_table(rejected), error_tables(boats, REMARKS)), 10_000)
    assert max(map(len, whole)) > width or width >= 100 or count == 1
    for text in (lines, whole):
        words = " ".join(text).split()
        for rows in boats.values():
            for row in rows.values():
                for value, digits in ((row["mae"], 4), (row["rmse"], 4), (row["skill"], 3)):
                    assert value is None or f"{value:.{digits}f}" in words
        assert set(boats) <= set(words) and {"1234567,", "7654321,"} <= set(words)
        for each in NAMES:
            assert words.count(each) + words.count(f"{each},") >= count
    narrow, wide = (Counter(re.findall(NUMBER, " ".join(text))) for text in (lines, whole))
    assert not wide - narrow  # none is lost


@pytest.mark.parametrize("width", WIDTHS)
def test_the_table_of_a_tuning_is_whole(width):
    setting = "memory=3.16228 covariance=0.000316228 spread=12.5 rate=0.0008 pretrained=a_file_with_a_long_name"
    rows = [("1", setting, {"mae": 0.0123456, "gain": 12.34}), ("default", "", {"mae": None, "gain": None})]
    lines = printed(tuning_table("grid=rls: 64 evaluations", rows), width)
    words = " ".join(lines).split()
    assert max(map(len, lines)) <= width
    assert {*setting.split(), "0.01235", "12.3", "diverged", "default"} <= set(words)


@pytest.mark.parametrize("folded", [(), ("a_name_that_no_terminal_holds",)])
def test_a_word_wider_than_the_terminal_is_folded_not_cut(folded):
    table = Blocks("title", ["a_name_that_no_terminal_holds"], ["number_one", "number_two"], folded)
    table.add("q" * 30, "1.25", "2.5")
    lines = printed(table, 20)
    assert max(map(len, lines)) <= 20 and "".join(lines).count("q") == 60  # in two blocks
    assert {"number_one", "number_two", "1.25", "2.5"} <= set(" ".join(lines).split())
    assert printed(Blocks("none", ["channel"], []), 20) == ["none", "", "channel", "───────", ""]


def test_blocks_are_even():
    table = Blocks("MAE", ["estimator"], [f"boat{k}" for k in range(8)])
    table.add("aid", *(["0.1234"] * 8))
    heads = [line for line in printed(table, 9 + 7 * 8) if "boat" in line]
    assert [line.count("boat") for line in heads] == [4, 4]


PRINT = """
from usvlearn.display.terminal import Blocks, console
table = Blocks("title", ["name"], [f"column{k}" for k in range(40)])
table.add("aid", *map(str, range(40)))
console().print(table)
"""


def test_a_pipe_has_no_width_and_a_terminal_has_its_own(monkeypatch):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm"}
    del environment["COLUMNS"]
    command = [sys.executable, "-c", PRINT]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert "column0  column1" in done.stdout and "column38  column39" in done.stdout.splitlines()[2]
    done = subprocess.run(command, env={**environment, "COLUMNS": "60"}, capture_output=True, text=True, check=True)
    assert max(map(len, done.stdout.splitlines())) <= 60
    ours, theirs = pty.openpty()
    process = subprocess.Popen(command, env={**environment, "COLUMNS": "60"}, stdout=theirs)
    os.close(theirs)
    text = ""
    with open(ours, encoding="utf-8", errors="replace") as screen:
        try:
            while part := screen.read(1):
                text += part
        except OSError:  # its other end is closed
            pass
    assert process.wait() == 0 and "\x1b[1m" in text
    assert max(len(re.sub(r"\x1b\[[\d;]*m", "", line)) for line in text.splitlines()) <= 60
    monkeypatch.delenv("COLUMNS")
    assert console(quiet=True).quiet and console().width > 10_000


def test_a_notebook_is_sent_plain_text(monkeypatch, capsys):
    """Rich would show HTML in Jupyter, and escape sequences in the text that `print(learned)` makes."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    table = Blocks("title", ["name"], ["MAE"])
    table.add("aid", "0.0312", style="bold")
    console().print(table)
    assert capsys.readouterr().out.splitlines() == ["title", "", "name     MAE", "────────────", "aid   0.0312", ""]


def test_a_folder_below_the_current_one_is_named_from_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert quoted(tmp_path / "outputs" / "a b") == "'outputs/a b'" and quoted(Path("/elsewhere")) == "/elsewhere"


@over("count", [1, 3, 20])
def test_first_the_ensemble_the_baseline_and_the_best_member_are_shown(count):
    boats = {boat: {**rows, "best": rows["rls"] | {"mae": 1e-6}} for boat, rows in fleet(count).items()}
    horizons = {h: {"mae": 0.1, "skill": 0.5, "covers": 0.9, "covers_stay": 0.9, "interval": 0.2} for h in ("2", "10")}
    forecast = {boat: {name: horizons for name in ("best", "aid", "persistence", "average")} for boat in boats}
    main = "average", ["best", "aid", "rls", "persistence"]
    lines = printed(error_tables(boats, REMARKS, ["a note"], forecast, main), 80)
    first = [line.split()[0].strip(",") for line in lines if line]
    assert {"average", "best", "persistence"} <= set(first) and not {"rls", "ambient_rls_short", "a"} & set(first)
    assert "while commands are steady" in "\n".join(lines) and "interval score" not in "\n".join(lines)
    assert len(lines) <= 24 and (count == 1 or f"means of {count} boats" in "\n".join(lines))
    every = "\n".join(printed(error_tables(boats, REMARKS, ["a note"], forecast), 80))
    assert "ambient_rls_short" in every and "a note" in every and "interval score" in every


RESULTS = {
    "output": "ensemble", "measure": "ensemble.mae", "objective": 0.0394, "data_check": [{}, {}],
    "events": {"heron": []},
    "boats": {"heron": {"ensemble": {"mae": 0.0394, "fit": 95.04}}}, "free_fit": {"heron": {"ensemble": None}},
    "forecast": {"heron": {"ensemble": {"2": {"mae": 0.05}, "30": {"mae": 0.12}}}},
    "tracks": {"heron": {"30": {"position": 6.71}}}, "rejected": {"heron": {"surge": {"stale": 3, "lost": 4}}},
}  # fmt: skip
BOAT = {
    "steady_speed_full": Quantity(2.78, 2.64, 2.91, "m/s"), "time_constant": Quantity(1.7, 0.2, 9.0, "s"),
    "yaw_rate_full": Quantity(0.482, 0.465, 0.5, "rad/s"),
}  # fmt: skip


def test_a_run_ends_with_a_summary_of_eight_lines():
    asked = {"mass": {"certainty": "unsure"}, "span": {"certainty": "probable"}}
    assert summary(RESULTS, asked, {"heron": BOAT}) == [
        "data         2 findings; 2 guesses unconfirmed, 1 unsure; 7 values rejected",
        "speed        2.78 m/s (2.64 to 2.91) at full command",
        "response     time constant not known; turns 27.6 °/s (26.6 to 28.6)",
        "error        0.039 m/s a step ahead; 0.120 m/s and 6.71 m 30 s ahead",
        "fit          95.0 % a step ahead",
        "alarms       none",
    ]
    loss = {"kind": "loss", "side": "left", "run": "a\x1b", "time": 61.2}
    many = {**RESULTS, "data_check": None, "objective": 0.5, "measure": "rnn.skill", "events": {"heron": [loss] * 3}}
    said = summary(many | {"boats": {"heron": {"ensemble": {"mae": None, "fit": None}}}, "forecast": {}}, {}, {})
    assert said[0].startswith("data         not checked") and said[1] == "speed        not known at full command"
    assert said[3:] == [
        "error        skill of rnn 0.5000",
        "fit          unknown",
        r"alarms       left thruster lost thrust, heron, run a\x1b, 61 s and 2 more",
    ]
    slow = BOAT | {"steady_speed_full": Quantity(1.5, 1.4, 1.6, "m/s")}
    fast, none = {"a": BOAT, "b": slow, "c": {}}, {**RESULTS, "data_check": [], "events": None, "rejected": {}}
    assert summary(none, {}, fast)[:2] == [
        "data         ok",
        "speed        1.50 to 2.78 m/s (2 of 3 boats) at full command",
    ]


@over("width", WIDTHS)
def test_what_eight_boats_are_fits_the_terminal(width):
    each = {"drag_linear": Quantity(-12.34, -20.0, -5.0, "kg/s"), "time_constant": Quantity(1.234, 0.5, np.nan, "s")}
    nothing = np.zeros(0)
    boats = {
        f"heron{k}": Identified(
            each, "Means of 9 periodic estimates.", "", ("It drifted.",) * (k == 3), 28.0, *[nothing] * 3
        )
        for k in range(1, 9)
    }
    lines = printed(identified_table(boats), width)
    assert all(len(line) <= width for line in lines)
    text = "\n".join(lines)
    assert sum(line.split() == ["time_constant", "1.23", "0.500", "–", "s"] for line in lines) == 8
    assert "drag_linear" not in text and "heron8" in lines
    assert text.count("Means of 9 periodic estimates.") == 1 and "heron3: It drifted." in text
    one = "\n".join(printed(identified_table({"heron1": boats["heron1"]}, {"heron1": {"time_constant": 1.5}}), width))
    assert "truth" in one and "1.50" in one
    vague = replace(boats["heron1"], unknown=frozenset(["drag_linear"]))
    plain = "\n".join(printed(identified_table({"heron1": vague}), width))
    assert "-12.3" in one and "-12.3" not in plain and "–: not known yet" in plain and "not known yet" not in one
    assert "".join(printed(identified_table({}), width)) == ""


def test_the_line_of_activity_shows_what_is_done_and_leaves_nothing():
    shown = io.StringIO()
    with Activity(Console(file=shown, force_terminal=True, width=80, legacy_windows=False)) as activity:
        doing("reading a\x1b[2J.csv, 1 of 3")
        for _ in range(600):  # it is drawn ten times a second, a minute at most
            time.sleep(0.1)
            if "reading" in shown.getvalue():
                break
        activity.begin("replaying", total=4)
        activity.advance(1)
        activity.completed(4)
        assert activity.done == 4
    text = shown.getvalue()
    assert "reading a\\x1b[2J.csv, 1 of 3" in text and "100%" in text
    assert text.endswith("\x1b[1A\x1b[2K")  # the line is erased
    file = io.StringIO()
    with Activity(Console(file=file)):
        doing("reading")
    assert file.getvalue() == ""
    doing("nobody shows this")


def test_a_compilation_is_told_in_the_line_of_activity_alone(tmp_path, monkeypatch):
    """Printed beside it, each second would be a line."""
    shown, errors = io.StringIO(), io.StringIO()
    monkeypatch.setattr(jit, "folder", lambda source: tmp_path)
    monkeypatch.setattr("sys.stderr", errors)
    with Activity(Console(file=shown, force_terminal=True, width=80, legacy_windows=False)):
        with jit.announce(jit.__file__, "trial"):
            for _ in range(600):
                time.sleep(0.1)
                if "compiling the trial" in shown.getvalue():
                    break
    assert "compiling the trial, only once" in shown.getvalue() and errors.getvalue() == ""
    assert shown.getvalue().endswith("\x1b[1A\x1b[2K") and (tmp_path / "trial").exists()


def test_a_quiet_line_of_activity_loses_nothing_that_others_print(capsys):
    """The lines of a sweep, which a thread prints while a job shows nothing."""
    with Activity(Console(quiet=True, force_terminal=True)):
        print("job 0: done", flush=True)
    assert capsys.readouterr().out == "job 0: done\n"
