"""Runs compared: changes of quantities, paired errors, the page, and folders that cannot be compared."""

import json
import math

import numpy as np
import pytest

from usvlearn.cli.compare import work
from usvlearn.errors import UsvlearnError
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.report.side_by_side import CHANGED, SAME, VAGUE, change, read_boats, sections

HEAD = "boat,run,ahead,steps,persistence,ensemble"


def run(folder, speed, error, boats=("heron",), **facts):
    """A finished run, as far as a comparison reads it."""
    folder.mkdir(parents=True)
    (folder / "runs.json").write_text("{}")
    top = {"value": speed, "low": speed - 0.1, "high": speed + 0.1, "unit": "m/s"}
    known = {"steady_speed_full": top, "time_constant": top | {"low": -9.0, "high": 9.0}, "drag_linear": top}
    whole = {"boats": {boat: {} for boat in boats}, "identified": dict.fromkeys(boats, known), "output": "ensemble"}
    (folder / "results.json").write_text(json.dumps(whole | facts))
    rows = [f"{boat},{k},step,{100 + k},0.5,{error * (1 + k / 10)}" for boat in boats for k in range(4)]
    (folder / "errors.csv").write_text("\n".join([HEAD, *rows, ""]))
    return str(folder)


def test_the_interval_of_a_difference_holds_as_often_as_it_says():
    rng, inside = np.random.default_rng(1), 0
    for one, other in rng.normal(0.0, [1.0, 2.0], (4000, 2)):
        result = change(*(Quantity(x, x - 1.645 * s, x + 1.645 * s, "m") for x, s in ((one, 1.0), (other, 2.0))))
        inside += result.low <= 0 <= result.high
    assert 0.88 < inside / 4000 < 0.92


def test_a_skewed_interval_counts_on_the_side_of_the_other_value():
    skewed, plain = Quantity(1.0, 0.9, 9.0, "m"), Quantity(3.0, 2.9, 3.1, "m")
    assert change(skewed, plain).verdict == VAGUE and change(skewed, Quantity(0.5, 0.4, 0.6, "m")).verdict == CHANGED


def test_what_changed_is_told_first_and_errors_are_paired(tmp_path, capsys):
    before, after = run(tmp_path / "a", 2.6, 0.10), run(tmp_path / "b", 2.0, 0.08)
    work([before, after, "--out", str(tmp_path / "page")])
    shown = capsys.readouterr().out
    assert shown.index("changed") < shown.index("steady_speed_full") < shown.index(VAGUE) < shown.index("time_constant")
    assert "drag_linear" not in shown and "-0.600 (-0.741 to -0.459)" in shown
    (section,) = sections(read_boats([before, after]))
    (row,) = section.sheets[1].rows
    assert row[1:3] == ("next step", pytest.approx(0.1151, abs=1e-3)) and row[4] == pytest.approx(-0.0230, abs=1e-3)
    assert row[-1] == CHANGED and any("same missions" in each for each in section.here)
    page = (tmp_path / "page" / "index.html").read_text()
    assert "Runs compared" in page and "<svg" in page and "drag_linear" in page
    assert list((tmp_path / "page" / "tensorboard").rglob("*tfevents*"))


def test_other_boats_and_other_missions_are_told(tmp_path):
    one, other = run(tmp_path / "a", 2.6, 0.1), run(tmp_path / "b", 2.6, 0.1, boats=("otter",))
    text = (tmp_path / "b" / "errors.csv").read_text()
    (tmp_path / "b" / "errors.csv").write_text(text.replace("step,10", "step,20"))
    (section,) = sections(read_boats([one, other, one]))
    assert section.title == "heron and otter" and len(section.sheets[0].rows) == 6
    assert {row[-1] for row in section.sheets[0].rows} == {SAME, VAGUE}
    assert any("A → B: they share no missions" in each for each in section.here)


NOT_COMPARED = {
    "one run": (lambda at: [run(at / "a", 1, 1)], "found 1 runs, expected 2"),
    "no run": (lambda at: [run(at / "a", 1, 1), str(at)], "found 2 runs below|no run"),
    "nothing": (lambda at: [run(at / "a", 1, 1), str(at / "b")], "found no run below"),
    "other boats": (
        lambda at: [run(at / "a", 1, 1, ("x", "y")), run(at / "b", 1, 1, ("z", "w"))],
        "found none that all runs have, .*a has x, y; .*b has z, w",
    ),
    "unfinished": (lambda at: [run(at / "a", 1, 1), run(at / "b", 1, 1, partial={})], "b: is not finished"),
    "damaged": (lambda at: [run(at / "a", 1, 1), run(at / "b", 1, 1, identified={"heron": 3})], "b: is damaged"),
}


@pytest.mark.parametrize("case", NOT_COMPARED)
def test_what_cannot_be_compared_is_told_and_nothing_is_written(case, tmp_path):
    folders, words = NOT_COMPARED[case][0](tmp_path), NOT_COMPARED[case][1]
    if case == "no run":
        run(tmp_path / "b", 1, 1)
    with pytest.raises(UsvlearnError, match=words):
        work([*folders, "--out", str(tmp_path / "page")])
    assert not (tmp_path / "page").exists()


def test_nan_is_no_change(tmp_path):
    nothing = {"heron": {"steady_speed_full": {"value": None, "low": None, "high": None, "unit": "m/s"}}}
    one, other = run(tmp_path / "a", 2.6, 0.1), run(tmp_path / "b", 2.6, 0.1, identified=nothing)
    (section,) = sections(boats := read_boats([one, other]))
    assert not section.figures and "No quantity is known in both." in section.here
    assert math.isnan(boats[0][1].quantities["steady_speed_full"].value)
