"""The open questions in the file of `usvlearn inspect`, their confirmation, and a screen of at most 40 lines."""

import io

import numpy as np
import pytest
import yaml
from rich.console import Console

from tests.support.exported import write_table
from tests.support.strangers import sail
from tests.support.voyages import voyage
from usvlearn.cli import inspect as command
from usvlearn.core.unconfirmed import SECTION, open_questions, questions_in, questions_of, unconfirmed
from usvlearn.errors import ConfigError
from usvlearn.logs.inspection import table_view
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.inspection.questions import confirm, questions

CHANNELS = {"command_left": {"delay": 0.0, "name": "L"}, "command_right": {"delay": 0.0, "name": "R"},
            "yaw_rate": {"name": None}, "surge": {"name": "v", "unit": "m/s"}}  # fmt: skip
SETTINGS = {"vehicle": {"mass": 36.0}, "data": {"channels": CHANNELS}}


def crowd(folder):
    """The log of a boat with a hundred series, whose speed has no unit."""
    log = voyage(minutes=3.0)
    time = np.arange(0.0, 180.0, 0.2)
    columns = {"time": time} | {each: log.at(each, time) for each in ("command_left", "command_right")}
    columns |= {"heading": np.degrees(log.at("heading", time)), "speed": log.at("surge", time)}
    rng = np.random.default_rng(0)
    columns |= {f"a rather long name of a temperature {k} of the hull": 20 + rng.normal(size=len(time)).cumsum() / 99
                for k in range(96)}  # fmt: skip
    return write_table(folder / "crowd.csv", columns)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return inspect_logs([str(crowd(tmp_path_factory.mktemp("crowd")))])


def decided(channel, what, certainty=PROBABLE, value="x"):
    return Decision(channel, what, value, certainty, "a reason")


def test_what_is_asked_follows_a_rule_also_for_words_that_are_new():
    asked = questions(
        [
            *(decided(side, what) for side in ("command_left", "command_right") for what in ("delay", "series")),
            decided("surge", "unit", CERTAIN), decided("surge", "series", UNSURE), decided("surge", "period"),
            decided("command_left", "messages"), decided("yaw_rate", "series"), decided("yaw_rate", "rejected"),
            decided("reader", "calendar", UNSURE), decided("tide", "datum"), decided("vehicle", "mass", UNSURE),
        ],
        SETTINGS,
    )  # fmt: skip
    assert list(asked) == ["surge", "calendar", "mass", "delay", "sides", "tide.datum"], "the unsure ones come first"
    both = {f"data.channels.command_{side}.delay": 0.0 for side in ("left", "right")}
    assert asked["delay"] == {"certainty": PROBABLE, "found": "x", "why": "a reason", "written": both}


def test_a_question_is_closed_by_other_values_and_by_overrides_of_all_its_settings():
    both = {f"data.channels.command_{side}.delay": 0.0 for side in ("left", "right")}
    settings = {**SETTINGS, SECTION: {"delay": {"written": both}, "tide": None}}
    left, right = (f"{path}=0.0" for path in both)

    def is_open(*given, **changed):
        return "delay" in open_questions({**settings, **changed}, given)

    assert is_open() and is_open(left) and is_open("data=my_boat.yaml") and not is_open(f"++{left}", right)
    assert not is_open("data.channels.command_left={}", right)
    assert is_open("data.channels.command_left.delayed=1", right)
    late = {each: {**CHANNELS[each], "delay": 0.5} for each in ("command_left", "command_right")}
    assert not is_open(data={"channels": {**CHANNELS, **late}})
    assert list(open_questions({**settings, "data": {}})) == ["tide"], "what is not understood stays open"
    with pytest.raises(ConfigError, match=r"unconfirmed: found \[1\], expected KEY"):
        open_questions({SECTION: [1]})


def test_the_file_has_the_questions_as_data(found):
    asked = yaml.safe_load(found.text)[SECTION]
    assert asked == found.settings[SECTION] and {"mass", "surge.unit"} <= set(asked)
    assert {each.certainty for each in found.decisions} > {CERTAIN}, "the log is doubtful"
    assert open_questions(found.settings) == questions_of(asked)
    assert f"{len(asked)} guesses unconfirmed: " in unconfirmed(asked)[0]


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_confirmed_file_is_the_same_elsewhere(found, tmp_path, end):
    path = tmp_path / "it's.yaml"
    lines = [*found.text.splitlines(), "  # mine", ""]
    path.write_bytes(end.join(lines).encode())
    first, second, *rest = found.settings[SECTION]
    said = list(confirm([str(path)], [f"{first}, {second}"]))
    expected = [each for each in lines if not each.startswith((f"  {first}: {{", f"  {second}: {{"))]
    assert path.read_bytes() == end.join(expected).encode() and len(expected) == len(lines) - 2
    assert f"{len(rest)} guess" in said[1] and "--confirm KEY" in said[1] and "it'\"'\"'s.yaml" in said[1]
    with pytest.raises(ConfigError, match=f"found '{first}', expected one of {', '.join(rest)}, all"):
        list(confirm([str(path)], [first]))
    assert list(confirm([str(path)], ["all"]))[1] == "Nothing is open any more."
    assert yaml.safe_load(path.read_bytes())[SECTION] == {} == questions_in(yaml.safe_load(path.read_bytes()), path)
    with pytest.raises(ConfigError, match="found no open question"):
        list(confirm([str(path)], ["mass"]))


def test_a_file_of_an_older_inspect_asks_for_a_new_one_and_one_of_a_person_nothing(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(
        "# @package _global_\n# boat: written by usvlearn inspect from 1 log (tables).\nvehicle: {mass: 3}\n"
    )
    assert (
        "all (unsure). An older version"
        in unconfirmed(asked := questions_in(yaml.safe_load(path.read_text()), path))[0]
    )
    assert (
        "run it again" in unconfirmed(open_questions({"vehicle": {"mass": 3}, SECTION: asked}, ["vehicle.mass=3"]))[0]
    )
    with pytest.raises(ConfigError, match=r"expected all, since it has no questions\. An older .* run it again"):
        list(confirm([str(path)], ["mass"]))
    assert list(confirm([str(path)], ["all"]))[1] == "Nothing is open any more."
    assert questions_in(yaml.safe_load(path.read_text()), path) == {} and path.read_text().endswith(
        "3}\nunconfirmed: {}\n"
    )
    path.write_text("# as usvlearn inspect would write it\nvehicle: {mass: 3}  # written by usvlearn inspect\n")
    assert questions_in(yaml.safe_load(path.read_text()), path) == {}


def test_what_cannot_be_removed_by_line_is_left_as_it_is(tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(text := "data: {}\nunconfirmed: {mass: {certainty: unsure}, delay: {}}\n")
    with pytest.raises(ConfigError, match="remove them by hand"):
        list(confirm([str(path)], ["mass"]))
    assert path.read_text() == text
    for files in (["a.csv"], ["a.yaml", "b.yaml"]):
        with pytest.raises(ConfigError, match="expected the one file"):
            list(confirm(files, ["mass"]))


def shown(result, width, whole=False):
    console = Console(file=io.StringIO(), width=width, markup=False)
    table_view.show(result, "my_boat.yaml", console, whole)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 100, 120, 100_000])
def test_a_hundred_series_take_one_screen(found, width):
    noisy = found._replace(notes=[f"note {k}: {'a long story ' * 20}" for k in range(30)])
    doubtful = [Decision("surge", f"trait_{k}", "m/s", UNSURE, "no evidence " * 12) for k in range(12)]
    asked = questions([*found.decisions, *doubtful], found.settings)
    worse = noisy._replace(decisions=[*found.decisions, *doubtful], settings={**found.settings, SECTION: asked})
    for each in (found, noisy, worse):
        lines = shown(each, width)
        assert len(lines) + table_view.END <= table_view.LINES == 45  # of which five are the verdict
        order = [next(k for k, line in enumerate(lines) if word in line) for word in ("What was found", "Please check")]
        assert order == sorted(order) and not any("temperature 7 " in line for line in lines)
        assert "--all" in lines[order[0]] and "--confirm KEY my_boat.yaml" in " ".join(" ".join(lines).split())
    assert any("more of the data check and the readers: add --all" in line for line in shown(noisy, width))
    assert sum("temperature" in line for line in shown(found, width, whole=True)) == 96


def test_the_command_lists_all_and_confirms(found, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "my_boat.yaml"
    path.write_text(found.text)
    command.work(["--confirm", "mass", "--confirm", "surge.unit", "my_boat.yaml"])
    assert "Confirmed in my_boat.yaml: mass, surge.unit." in capsys.readouterr().out
    assert not {"mass", "surge.unit"} & set(yaml.safe_load(path.read_text())[SECTION])


def test_the_delay_that_is_written_is_checked(tmp_path):
    boat = sail(4, seed=2)
    after = {name: np.interp(boat["time"] - 2.5, boat["time"], boat[name]) for name in ("u", "lat", "lon")}
    columns = {"time": boat["time"], "left": boat["l"], "right": boat["r"], "heading": boat["hdg"], "speed": after["u"]}
    path = write_table(tmp_path / "a.csv", columns | {"lat": after["lat"], "lon": after["lon"]})
    result = inspect_logs([str(path)])
    assert abs(result.lag.delay - 2.5) <= 0.5
    assert {one.channels["command_left"].delay for one in result.recordings} == {result.lag.delay}
    (finding,) = (each for each in result.findings if each.kind == "delay")
    assert f"take {result.lag.delay:g} s from the stamps of the speed" in finding.sentence()
    (asked,) = {each for each in result.decisions if each.what == "delay" and each.channel == "command_left"}
    assert asked.certainty == "unsure" and "Clocks that differ look the same" in asked.reason
