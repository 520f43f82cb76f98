"""Names of columns: sides alone, revolutions, abbreviations, a third thruster, and words of European languages."""

import numpy as np
import pytest

from tests.support import few
from tests.support.exported import rows, write_table
from tests.support.traps import columns
from tests.support.voyages import voyage
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.inspection.vocabulary import WORDS, fit, side, unit_word


def proposed(folder, swap=False, **names):
    """What is proposed for a log whose commands have these names."""
    log, named = voyage(0, minutes=4.0), {"thrust_left": None, "thrust_right": None}
    for name, told_of in names.items():
        sides = [each if not swap else "right" if each == "left" else "left" for each in told_of.split()]
        named[name] = sum(log.at(f"command_{each}", rows(log)) for each in sides) / len(sides)
    return inspect_logs([str(write_table(folder / "a.csv", columns(log, **named)))]).proposal


def told(proposal, what):
    return {each.channel: each for each in proposal.decisions if each.what == what}


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
    proposal = proposed(tmp_path, **{left: "left", right: "right"})
    assert (proposal.channels["command_left"]["name"], proposal.channels["command_right"]["name"]) == (left, right)
    assert told(proposal, "series")["command_left"].reason.startswith("by name")


def test_sides_that_the_boat_contradicts_are_swapped_against_their_names(tmp_path):
    proposal = proposed(tmp_path, swap=True, left="left", right="right")
    assert proposal.channels["command_left"]["name"] == "right"
    series = told(proposal, "series")["command_left"]
    assert (series.certainty, series.reason.partition(":")[0]) == ("unsure", "swapped against the names")


def test_a_thruster_in_the_middle_is_told(tmp_path):
    proposal = proposed(tmp_path, thr_left="left", thr_mid="left right", thr_right="right")
    series = told(proposal, "series")["command_left"]
    assert series.certainty == "unsure"
    assert "thr_mid is on neither side" in series.reason
    assert series.alternatives[0] == "[thr_left, thr_mid]"


TABLES = {  # left, right, heading, speed and its unit
    "Danish": ("Motor bagbord [%]", "Motor styrbord [%]", "Kurs [grader]", "Fart [knob]", "knots"),
    "Dutch": ("Schroef bakboord", "Schroef stuurboord", "Koers (graden)", "Snelheid km/u", "km/h"),
    "Finnish": ("potkuri vasen", "potkuri oikea", "suunta", "nopeus (m/s)", "m/s"),
    "French": ("Poussée bâbord (%)", "Poussée tribord (%)", "Cap (degrés)", "Vitesse (nœuds)", "knots"),
    "German": ("Schub Backbord", "Schub Steuerbord", "Kurs (Grad)", "Geschwindigkeit (Knoten)", "knots"),
    "Italian": ("motore_sx", "motore_dx", "prua_gradi", "velocita_nodi", "knots"),
    "Norwegian": ("pådrag babord", "pådrag styrbord", "kurs", "hastighet (m/s)", "m/s"),
    "Polish": ("silnik lewy", "silnik prawy", "kurs", "prędkość węzły", "knots"),
    "Portuguese": ("Motor bombordo", "Motor estibordo", "Rumo (graus)", "Velocidade (nós)", "knots"),
    "Spanish": ("empuje_babor", "empuje_estribor", "rumbo_grados", "velocidad_nudos", "knots"),
    "Swedish": ("varvtal vänster", "varvtal höger", "kurs", "fart (knop)", "knots"),
}
PER_SECOND = {"knots": 3600 / 1852, "km/h": 3.6, "m/s": 1.0}


@pytest.mark.parametrize("language", few(TABLES, list(TABLES)[::2], "thorough"))
def test_a_table_in_a_language_is_understood(tmp_path, language):
    left, right, heading, speed, unit = TABLES[language]
    sailed = voyage(0, minutes=4.0)
    time = np.arange(0.5, 238, 0.2)
    path = write_table(tmp_path / "a.csv", {
        "time": time, left: 100 * sailed.at("command_left", time), right: 100 * sailed.at("command_right", time),
        heading: np.degrees(sailed.at("heading", time)), speed: PER_SECOND[unit] * sailed.at("surge", time),
        "vind": np.sin(time), "batteri": 24 - time / 1e3,
    })  # fmt: skip
    result = inspect_logs([str(path)])
    channels = result.proposal.channels
    named = {name: channels[name]["name"] for name in ("command_left", "command_right", "heading", "surge")}
    assert named == {"command_left": left, "command_right": right, "heading": heading, "surge": speed}
    assert (channels["surge"]["unit"], channels["heading"]["unit"]) == (unit, "deg")
    assert max(abs(channels[name]["span"]) for name in ("command_left", "command_right")) == 100


def test_words_of_several_languages():
    left = "port babord Backbord bâbord babor babordo bombordo bakboord bagbord vänster venstre lewy vasen"
    right = (
        "starboard styrbord Steuerbord tribord estribor tribordo estibordo stuurboord styrbord höger høyre prawy oikea"
    )
    assert {side(f"Motor {name}") for name in left.split()} == {"left"}
    assert {side(f"Motor {name}") for name in right.split()} == {"right"}
    assert (side("dx"), side("motore_dx"), side("motore_sx")) == ("", "right", "left")
    for name in ("vitesse de lacet", "velocidad de guiñada", "Giergeschwindigkeit", "girhastighet", "giersnelheid"):
        assert fit("yaw_rate", name) >= 3 and fit("surge", name) < 1, name
    for name in ("Windgeschwindigkeit", "vitesse du vent", "velocidad del viento", "vindhastighet"):
        assert fit("surge", name) < 1, name
    assert [unit_word(name) for name in ("fart_knop", "cap_degrés", "vitesse nœuds", "Schub Prozent")] == [
        "knots", "deg", "knots", "percent"]  # fmt: skip


def test_every_word_is_one_that_names_are_split_into():
    for role, spoken in WORDS.items():
        assert all(word.isascii() and word == word.lower() and " " not in word for word in spoken), role
