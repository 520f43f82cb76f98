"""Mission files: what a mission says to the node, and sentences that name the line of a mistake."""

import pytest

from usvlearn.errors import ConfigError
from usvlearn.live.moos.block import EXAMPLE, LARGEST, MIDDLEWARE, Mission, interface, parser, settings_of
from usvlearn.live.start import Options
from usvlearn.live.status import TABLE

TEXT = """\
ServerHost = 10.0.0.7   // of the boat
SERVERPORT = 9100
ServerPort = 9200
MOOSTimeWarp = 5
Community = heron // name
#ifdef SIMULATION
define: ROOT = /data/boat

ProcessConfig = ANTLER
{
  Run = MOOSDB @ NewConsole = false
  Run = pUSVLearn @ NewConsole = false
}

processconfig=pUSVLearn
{
  AppTick = 8
  CommsTick = 8   // has no effect
  Folder = "${ROOT}/a b"
  start = ${START}/set
  mass = 36
  save_period = 60 // s
  record = TRUE
  refit = false
  prefix = "A//B" // not a comment, and one
  members = true
  surge = NAV_SPEED@pNav
  surge.unit = knots
  Command_Left = A, B
  #include something
}
"""


def settings(text, *arguments, tmp_path):
    path = tmp_path / "mission.moos"
    path.write_text(text)
    arguments = [str(path), *arguments]
    return settings_of(arguments, parser().parse_args(arguments))


def block(*lines: str) -> str:
    return "\n".join(["ProcessConfig = pUSVLearn", "{", *lines, "}"])


def test_a_mission_says_all(tmp_path, monkeypatch):
    monkeypatch.setenv("START", "/home")
    given = settings(TEXT, "--keep=7", tmp_path=tmp_path)
    assert (given.name, given.host, given.port, given.warp) == ("pUSVLearn", "10.0.0.7", 9100, 5.0)
    assert (given.community, given.tick, given.prefix, given.members) == ("heron", 8.0, "A//B", True)
    options = given.options
    assert (str(options.folder), str(options.start)) == ("/data/boat/a b", "/home/set")
    assert (options.mass, options.save_period, options.record, options.keep, options.warp) == (36, 60, True, 7, 5)
    assert not options.refit and Options(tmp_path).refit
    assert options.channels == {
        "surge": {"name": "NAV_SPEED@pNav", "unit": "knots"},
        "command_left": {"name": ["A", "B"]},
    }


def test_a_plain_community_has_throttle_and_steering(tmp_path):
    """pMarinePID posts DESIRED_THRUST and DESIRED_RUDDER, and no command of a side."""
    both = settings(block("throttle = DESIRED_THRUST"), tmp_path=tmp_path).options.channels
    assert both == {"throttle": {"name": "DESIRED_THRUST"}}
    lines = "throttle = DESIRED_THRUST", "steering = DESIRED_RUDDER", "steering.span = -1"
    mixed = settings(block(*lines), tmp_path=tmp_path).options.channels
    assert mixed["steering"] == {"name": "DESIRED_RUDDER", "span": -1.0}


def test_the_command_line_overrides_the_mission(tmp_path):
    text = "ServerPort = 9100\n" + TEXT.replace("${START}", "x").replace("=pUSVLearn\n{", "=learner\n{")
    arguments = ["--moos_port=9300", "--moos_time_warp=2", "--moos_host=localhost", "--mass=20", "--channel=surge=V"]
    for name in (["learner"], ["--alias=learner"], ["--moos_name=learner"], ["other", "--moos_name=learner"]):
        given = settings(text, *name, *arguments, tmp_path=tmp_path)
        assert (given.name, given.host, given.port, given.warp) == ("learner", "localhost", 9300, 2.0)
        assert given.options.mass == 20 and given.options.channels["surge"] == {"name": "V", "unit": "knots"}


def test_what_pantler_gives_is_enough(tmp_path):
    given = settings(block(), "pUSVLearn", tmp_path=tmp_path)
    assert (given.host, given.port, given.warp, given.tick, given.prefix) == ("localhost", 9000, 1.0, 4.0, "USV_")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (block("a line"), "line 3: found 'a line', expected KEY = VALUE"),
        (block("foldr = x"), r"line 3: foldr: found no such key: did you mean folder\?"),
        (block("folder = x", "FOLDER = y"), "line 4: found FOLDER again, which line 3 has"),
        (block("mass = heavy"), "line 3: mass: argument --mass: invalid float value: 'heavy'"),
        (block("// one", "apptick = 0"), "line 4: apptick: found '0', expected a positive number"),
        (block("record = perhaps"), "line 3: record: found 'perhaps', expected true or false"),
        (block("prefix = A B"), "line 3: prefix: found 'A B', expected one without blanks"),
        (block("surge.unt = knots"), "line 3: surge.unt: found no such option of a channel"),
        (block("throtle = T"), r"line 3: throtle: found no such key: did you mean throttle\?"),
        (block("steering.spam = 2"), r"line 3: steering.spam: found no such option of a channel.*steering.span\?"),
        (block("surge.span = wide"), "line 3: surge.span: found 'wide', expected a number"),
        (block("folder = ${NOWHERE}"), r"line 3: found \$\{NOWHERE\}, which neither"),
        ("ServerHost = the boat\n" + block(), "ServerHost: found 'the boat', expected a name or an address"),
        ("ServerPort = 9.5\n" + block(), "ServerPort: found 9.5, expected a whole number"),
        ("ServerPort = x\n" + block(), "line 1: ServerPort: found 'x', expected a positive number"),
        ("ProcessConfig = pUSVLearn\n{\n", "line 1: ProcessConfig = pUSVLearn has no end"),
        ("ProcessConfig = pUSVLearn\nmass = 3\n", "line 1: found no { after ProcessConfig = pUSVLearn"),
        ("ProcessConfig = pUSVLearn\n", "line 1: found no { after"),
        (
            "ProcessConfig = pUSVlern\n{\n}",
            r"no ProcessConfig = pUSVLearn: did you mean pUSVlern\?; there are pUSVlern",
        ),
        ("", "there are none: add the block"),
    ],
)
def test_a_mistake_is_one_sentence_with_its_line(text, sentence, tmp_path):
    with pytest.raises(ConfigError, match=sentence) as error:
        settings(text, tmp_path=tmp_path)
    assert "mission.moos" in str(error.value) or "Server" in str(error.value)
    assert "\n" not in str(error.value)


def test_blocks_of_other_apps_may_hold_anything(tmp_path):
    others = "ProcessConfig = uOther {\n${NOWHERE} !? \x1b[2J\n  a = {b}\n a = 1\n a = 2\n}\n  junk \n"
    assert settings(others + block(), tmp_path=tmp_path).name == "pUSVLearn"


@pytest.mark.parametrize("arguments", [["--frequency=3"], ["a.moos", "b", "c"], ["--moos_port=x"]])
def test_a_wrong_argument_is_one_sentence(arguments):
    with pytest.raises(ConfigError, match="see --help"):
        parser().parse_args(arguments)


def test_files_that_are_no_mission(tmp_path):
    with pytest.raises(ConfigError, match="found none, expected usvlearn live moos"):
        settings_of([], parser().parse_args([]))
    with pytest.raises(ConfigError, match="found no mission file"):
        Mission.read(tmp_path / "missing.moos")
    with pytest.raises(ConfigError, match="found no mission file"):
        Mission.read(tmp_path)
    (tmp_path / "large.moos").write_bytes(b"x" * (LARGEST + 1))
    with pytest.raises(ConfigError, match="more than 1000 kB"):
        Mission.read(tmp_path / "large.moos")


def test_lines_end_as_anywhere(tmp_path):
    path = tmp_path / "windows.moos"
    path.write_bytes(b"\xef\xbb\xbfServerPort = 9100\r\nProcessConfig = pA\r\n{\r\n  key = \xff\r\n}\r\n")
    mission = Mission.read(path)
    assert (entry := mission.get("ServerPort")) is not None and entry.value == "9100"
    assert mission.block("pA")["key"].value == "\udcff"


def test_the_example_is_a_legal_block(tmp_path):
    given = settings(EXAMPLE, tmp_path=tmp_path)
    assert str(given.options.folder) == "/home/boat/usvlearn" and given.options.mass is None
    for line in EXAMPLE.splitlines():  # what it has as a comment is legal, too
        key, equals, value = line.strip().removeprefix("//").partition("=")
        if line.strip().startswith("// ") and equals and "." not in value.split("//")[0].strip()[-1:]:
            if "Run" not in key and len(key.split()) == 1:
                settings(block(f"{key} = {value}"), tmp_path=tmp_path)


def test_the_interface_names_all_variables():
    text = interface()
    assert all(f"USV_{each.name} " in text for each in TABLE)
    assert all(each["name"] in text for each in MIDDLEWARE.channels.values())
