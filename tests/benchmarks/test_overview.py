"""The overview of the benchmarks: from given figures, against earlier runs, and from a quick run."""

import doctest
import itertools
from datetime import datetime, timedelta

import overview
import overview_sections
import pytest
from history import Figure, read, timed
from overview_sections import Part
from timing import ratio

MEASURED = {"ratio": 2.0}


def a_section(amount, logs):
    rounds = [MEASURED["ratio"] * each for each in (0.99, 1.0, 1.01)]
    figures = [timed("speed: aid, streamed", rounds, "C"), Figure("accuracy: heron", 0.6, "MAE of persistence")]
    return Part(["| µs | C |", "|---|---:|", "| aid | 1 |", "", "A sentence."], figures)


@pytest.fixture
def given_figures(monkeypatch, tmp_path):
    """Sections that cost nothing; what they measure is MEASURED."""
    monkeypatch.setattr(overview, "SECTIONS", {"speed": ("Speed", a_section)})
    monkeypatch.setattr(overview, "FOLDER", tmp_path)
    monkeypatch.setitem(MEASURED, "ratio", 2.0)
    days, real = itertools.count(1), overview.this_run
    monkeypatch.setattr(overview, "this_run", lambda effort: real(effort)._replace(date=f"2026-01-0{next(days)}"))
    return tmp_path


def test_examples():
    for module in (overview, overview_sections):
        assert doctest.testmod(module).failed == 0 < doctest.testmod(module).attempted


def test_the_page_of_given_figures(given_figures):
    assert overview.main([]) == 0
    text = (given_figures / "overview.md").read_text()
    assert text.startswith("# Speed, accuracy") and "\n## Speed\n\n| µs | C |\n" in text and "cores" in text
    assert "Against earlier runs" not in text and "history.svg" not in text  # there are none
    (first, second) = read(given_figures / "history.csv")
    assert f"on {first.run.date} in 0 min" in text and first.figure.value == 2.0 and second.figure.spread is None


def test_a_slowdown_is_shown_and_fails_the_check(given_figures, capsys):
    assert overview.main(["--check"]) == 0
    assert "Nothing to compare with." in capsys.readouterr().out
    MEASURED["ratio"] = 2.1
    assert overview.main(["--check"]) == 0
    assert "No figure is worse, of 2 with comparable entries." in capsys.readouterr().out
    text = (given_figures / "overview.md").read_text()
    assert "\n## Against earlier runs\n" in text and "with comparable entries: 2; worse: 0." in text
    assert "| accuracy: heron | 0.600 | MAE of persistence |  | 1 | +0 % | +0 % | 2 % |  |" in text
    assert "over the first entry" in (given_figures / "history.svg").read_text()
    MEASURED["ratio"] = 2.6
    assert overview.main([]) == 0  # it is told, but only --check fails
    assert overview.main(["--check", "--only", "speed"]) == 1
    out = capsys.readouterr().out
    assert out.splitlines()[-1].startswith("1 of 2 figures are worse: speed: aid, streamed (+0 % since the last entry")
    text = (given_figures / "overview.md").read_text()
    assert "| speed: aid, streamed | 2.60 | C | 1 % | 2 | +24 % | +27 % | 10 % | **worse** |" in text
    assert "(history.svg)" in text
    assert len(read(given_figures / "history.csv")) == 2 * 3  # of --only nothing is appended


def test_one_section_or_a_quick_run_writes_nothing(given_figures, tmp_path):
    assert overview.main(["--only", "speed"]) == overview.main(["--quick"]) == 0
    assert not list(given_figures.iterdir())
    assert overview.main(["--quick", "--folder", str(tmp_path / "new")]) == 0
    assert {entry.run.effort for entry in read(tmp_path / "new" / "history.csv")} == {"quick"}


def test_a_damaged_history_is_told_before_anything_is_measured(given_figures, capsys, monkeypatch):
    monkeypatch.setattr(overview, "SECTIONS", {"speed": ("Speed", None)})
    (given_figures / "history.csv").write_text("<html>\n")
    with pytest.raises(SystemExit) as left:
        overview.main([])
    assert left.value.code == 2
    assert capsys.readouterr().err.startswith(f"error: {given_figures / 'history.csv'}, line 1: found the columns")


def test_logs_that_are_not_there_are_told(given_figures, capsys):
    with pytest.raises(SystemExit):
        overview.main(["--logs", str(given_figures)])
    assert "--logs: found no folder blueboat, vtec, dalian in" in capsys.readouterr().err


def test_a_date_is_iso_and_utc():
    assert datetime.fromisoformat(overview.this_run("whole").date).utcoffset() == timedelta(0)


def test_a_ratio_is_that_of_the_rounds():
    spent, reference = [2.0, 30.0, 4.0], [1.0, 10.0, 4.0]
    assert timed("step", overview_sections.by_round(spent, reference), "C").value == ratio(spent, reference) == 2.0


@pytest.mark.slow
def test_a_quick_run_measures_all(tmp_path):
    assert overview.main(["--quick", "--folder", str(tmp_path)]) == 0
    text = (tmp_path / "overview.md").read_text()
    for title, _ in overview.SECTIONS.values():
        assert f"\n## {title}\n" in text
    found = read(tmp_path / "history.csv")
    names = [entry.figure.name for entry in found]
    assert {name.partition(":")[0] for name in names} == set(overview.SECTIONS) and len(names) == len(set(names))
    assert all(entry.figure.value > 0 for entry in found)
    assert overview.main(["--quick", "--only", "accuracy", "--folder", str(tmp_path)]) == 0
    again = read(tmp_path / "history.csv")[len(found) :]  # what is not timed is the same, to the digits of the file
    assert [each.figure for each in again] == [x.figure for x in found if x.figure.name.startswith("accuracy")]
