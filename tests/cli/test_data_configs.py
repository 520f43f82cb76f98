"""`data=FILE.yaml`: a configuration of one's own boat, wherever it lies."""

import pytest

import usvlearn
from tests.support.commands import GOOD, QUICK, ran, results, sentence
from usvlearn.cli import train

BOAT = """\
# @package _global_
vehicle: {mass: 20.0, surge_max: 3.0}
data:
  _target_: usvlearn.logs.read.read_recordings
  _convert_: all
  path: log.csv
  boat: null
  reader: {_target_: usvlearn.logs.formats.csv.table.Table, time: time}
  channels:
    command_left: {name: L}
    command_right: {name: R}
    heading: {name: heading, unit: deg}
    surge: {name: speed, unit: m/s}
"""


@pytest.fixture
def mine(tmp_path):
    (tmp_path / "log.csv").write_text(GOOD)
    (tmp_path / "boats" / "of mine").mkdir(parents=True)
    for name in ("my_boat.yaml", "csv.yaml", "boats/of mine/my_boat.yaml"):  # csv: as one of configs/data
        (tmp_path / name).write_text(BOAT)
    return tmp_path


@pytest.mark.parametrize("place", ["my_boat.yaml", "./csv.yaml", "{}/my_boat.yaml", "'boats/of mine/my_boat.yaml'"])
def test_a_file_anywhere_configures_the_data(mine, monkeypatch, place):
    monkeypatch.chdir(mine)
    logs = usvlearn.read(data=place.format(mine))
    assert logs.boats == ("log",) and logs.settings["vehicle"]["mass"] == 20.0


@pytest.mark.thorough
def test_the_jobs_of_a_sweep_use_it(mine):
    ran("-m", "data=my_boat.yaml", *QUICK[1:], "estimators.aid.gain=1,2", "hydra.sweep.dir=sweep", folder=mine)
    assert "log" in results(mine / "sweep" / "1")["boats"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, ["data: found 'here/other.yaml', but there is no such file"]),
        ("data: [\n", ["other.yaml, line 2: is not legal YAML"]),
        *(
            (text, ["other.yaml: has no section data"])
            for text in ("- 1\n", "", "3", "a,b\n1,2\n", "vehicle: {mass: 3}")
        ),
        (
            "data: {}\nhydra: {job: {env_set: {A: b}}}",
            ["other.yaml: found 'hydra', expected only data, vehicle, align"],
        ),
        (
            "data: {}\nvehicel: {mass: 3}",
            ["found 'vehicel', expected only data, vehicle, align: did you mean vehicle?"],
        ),
        ("data: {a: &a [1], b: *a}", ["other.yaml: has a YAML alias"]),
        ("data: " + 900_000 * "[", ["other.yaml: is nested too deeply"]),
        ("data: {path: " + 1_000_000 * "a" + "}", ["other.yaml has more than 1000 kB"]),
        ("\x80", ["other.yaml", "is no text in UTF-8"]),
        ("data: {_target_: os.system, command: ls}", ["data._target_: found 'os.system'", "--config-dir"]),
        ("data: {path: '${oc.env:HOME}'}", ["data.path: found '${oc.env:HOME}'", "--config-dir"]),
    ],
)
def test_a_bad_file_is_told_in_one_sentence(tmp_path, monkeypatch, capsys, text, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    if text is not None:
        (tmp_path / "here" / "other.yaml").write_text(text, encoding="latin-1")
    said = sentence(train.main, ["data=here/other.yaml"], monkeypatch, capsys)
    assert all(word in said for word in words), said
