"""Names of commands that say little: a side alone, revolutions, abbreviations, a third thruster."""

import pytest

from tests.support import few
from tests.support.exported import rows, write_table
from tests.support.traps import columns
from tests.support.voyages import voyage
from usvlearn.logs.inspection.inspected import inspect_logs


def proposed(folder, swap=False, **names):
    """What is proposed for a log whose commands have these names."""
    log, own = voyage(0, minutes=4.0), {"thrust_left": None, "thrust_right": None}
    for name, side in names.items():
        sides = side.split() if not swap else ["right" if each == "left" else "left" for each in side.split()]
        own[name] = sum(log.at(f"command_{each}", rows(log)) for each in sides) / len(sides)
    return inspect_logs([str(write_table(folder / "a.csv", columns(log, **own)))]).proposal


def told(found, what):
    return {each.channel: each for each in found.decisions if each.what == what}


NAMES = [
    ("L", "R"),
    ("Motor BB [%]", "Motor StB [%]"),
    ("motors.port", "motors.starboard"),
    ("left", "right"),
    ("rpm_l", "rpm_r"),
    ("thrusters/left", "thrusters/right"),
]


@pytest.mark.parametrize(("left", "right"), few(NAMES, NAMES[:3], "thorough"))
def test_both_sides_are_found_by_name(tmp_path, left, right):
    found = proposed(tmp_path, **{left: "left", right: "right"})
    assert (found.channels["command_left"]["name"], found.channels["command_right"]["name"]) == (left, right)
    assert told(found, "series")["command_left"].reason.startswith("by name")


def test_sides_that_the_boat_contradicts_are_swapped_against_their_names(tmp_path):
    found = proposed(tmp_path, swap=True, left="left", right="right")
    assert found.channels["command_left"]["name"] == "right"
    series = told(found, "series")["command_left"]
    assert (series.certainty, series.reason.partition(":")[0]) == ("unsure", "swapped against the names")


def test_a_thruster_in_the_middle_is_told(tmp_path):
    found = proposed(tmp_path, thr_left="left", thr_mid="left right", thr_right="right")
    series = told(found, "series")["command_left"]
    assert series.certainty == "unsure"
    assert "thr_mid is on neither side" in series.reason
    assert series.alternatives[0] == "[thr_left, thr_mid]"
