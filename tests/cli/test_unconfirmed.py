"""What inspect guessed is said by training, fit, report, export and controller, until a person has confirmed it."""

import json

import pytest
import yaml

import usvlearn
from tests.support.commands import GOOD, ran, results, run, sentence
from tests.support.exported import knots_table
from tests.support.voyages import voyage
from usvlearn.cli import controller, export, fit, inspect, train
from usvlearn.core.unconfirmed import SECTION, open_questions
from usvlearn.logs.setup import Setup

SENTENCE, GREEN = "unconfirmed: ", 'class="good"'
BOAT = {
    "vehicle": {"mass": 20.0, "surge_max": 3.0},
    "data": {
        "_target_": "usvlearn.logs.read.read_recordings", "_convert_": "all", "path": "log.csv", "boat": None,
        "reader": {"_target_": "usvlearn.logs.formats.csv.table.Table", "time": "time"},
        "channels": {"command_left": {"name": "L"}, "command_right": {"name": "R"},
                     "heading": {"name": "heading", "unit": "deg"}, "surge": {"name": "speed", "unit": "m/s"}},
    },
    SECTION: {"surge.unit": {"written": {"data.channels.surge.unit": "m/s"}},
              "mass": {"certainty": "unsure", "why": "not in the logs", "written": {"vehicle.mass": 20.0}},
              "sides": {"certainty": "probable", "written": {"data.channels.command_left.name": "L"}}},
}  # fmt: skip


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text(GOOD)
    (tmp_path / "my_boat.yaml").write_text(f"# @package _global_\n{yaml.safe_dump(BOAT)}")
    return tmp_path


def test_the_setup_of_a_boat_has_them_with_their_file_and_old_ones_have_none(here):
    setup = usvlearn.read(data="my_boat.yaml").setups["log"]
    assert setup.unconfirmed == open_questions(BOAT) | {
        key: {**each, "file": str(here / "my_boat.yaml")} for key, each in setup.unconfirmed.items()
    }
    saved = setup.json()
    assert Setup.of(saved) == setup and Setup.of({**saved, SECTION: {}}).json().get(SECTION) is None
    assert set(usvlearn.read(data="my_boat.yaml", mass=28.0).setups["log"].unconfirmed) == {"surge.unit", "sides"}
    assert usvlearn.read(here / "log.csv", channels=BOAT["data"]["channels"]).setups["log"].unconfirmed == {}


def test_no_question_is_taken_for_a_setting(here, monkeypatch, capsys):
    said = sentence(train.main, ["data=my_boat.yaml", "surge.unit=knots"], monkeypatch, capsys)
    assert said.endswith("did you mean data.channels.surge.unit?\n")


@pytest.mark.thorough
@pytest.mark.usefixtures("drawn_once")
def test_it_is_said_everywhere_until_it_is_confirmed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    inspect.work([str(knots_table(tmp_path, voyage(minutes=6.0)))])
    asked = yaml.safe_load((tmp_path / "my_boat.yaml").read_text())[SECTION]
    for name in ("open", "given", "closed"):
        if name == "closed":
            inspect.work(["--confirm", "all", "my_boat.yaml"])
        left = {"open": [*asked], "given": [key for key in asked if key != "mass"], "closed": []}[name]
        said = f"{len(left)} guess"
        mass = ["vehicle.mass=36"] * (name == "given")
        trained = ran("my_boat.yaml", f"hydra.run.dir={name}", *mass, folder=tmp_path)
        assert trained.stdout.count(SENTENCE) == bool(left) == (said in trained.stdout)
        assert [each["key"] for each in results(tmp_path / name)[SECTION]] == left
        capsys.readouterr()
        if name == "given":
            continue
        fit.work([name])
        export.work([name, "--to", "json,c", "--force"])
        export.work([f"{name}/fit", "--to", "json", "--out", f"{name}/export/fit", "--force"])
        controller.work([f"{name}/fit", "--boats", "5", "--out", f"{name}/gains"])
        printed = capsys.readouterr()
        shows = [(SENTENCE in each) for each in (printed.out, printed.err)]
        assert shows == [bool(left)] * 2
        judged = run(f"runs={name}", folder=tmp_path, script="evaluate.py")
        page = (tmp_path / name / "report" / "index.html").read_text()
        assert (SENTENCE in judged.stdout) == (SENTENCE in page) == bool(left), judged.stderr
        assert (GREEN in page) == (not left and "found in the log.</p>" in page)
        files = [*(tmp_path / name / "export").rglob("*.[jh]*"), *(tmp_path / name / "gains").glob("*.[pmj]*")]
        texts = [each for each in files if each.suffix != ".png"]
        assert len(texts) >= 8 and all((SENTENCE in each.read_text()) == bool(left) for each in texts)
    facts = json.loads((tmp_path / "open" / "results.json").read_text())[SECTION]
    assert all(each["why"] and each["written"] and each["file"].endswith("my_boat.yaml") for each in facts)
