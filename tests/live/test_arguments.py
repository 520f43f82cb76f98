"""What a user gives a node: arguments, options of channels and mistakes in them; and the documented systemd unit."""

import argparse
import shutil
import subprocess
import sys

import pytest

from tests.support import ROOT
from usvlearn.cli import aboard
from usvlearn.errors import ConfigError
from usvlearn.live.start import add_arguments, options_of

GIVEN = ["--mass", "28", "--surge-max", "2.7"]


def parsed(*arguments: str):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    return options_of(parser.parse_args(arguments))


def test_options_of_channels_are_typed_and_change_those_of_a_file(tmp_path):
    file = tmp_path / "my_boat.yaml"
    file.write_text("data: {channels: {surge: {name: v, unit: knots}, heading: {name: psi}}}\nvehicle: {mass: 3}\n")
    assert parsed("--channels", str(file)).mass == 3
    options = parsed("--channels", str(file), "--channel", "surge=NAV_SPEED", "--channel", "command_left.span=-100",
                     "--channel", "command_left=a,b", "--channel", "command_left.weight=1,-1", *GIVEN)  # fmt: skip
    assert options.channels["surge"] == {"name": "NAV_SPEED", "unit": "knots"}
    assert options.channels["command_left"] == {"span": -100.0, "name": ["a", "b"], "weight": [1.0, -1.0]}
    assert options.mass == 28.0 and options.surge_max == 2.7


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--channel", "surge"], "--channel: found 'surge', expected KEY=VALUE"),
        (["--channel", "sruge=v"], "sruge: found no such option of a channel.*did you mean surge"),
        (["--channel", "surge.untis=m/s"], "surge.untis: found no such option"),
        (["--channel", "surge.span=much"], "surge.span: found 'much', expected a number"),
        (["--channel", "surge.window=often"], "surge.window: found 'often', expected a number, or auto"),
        (["--channel", "surge.span=inf"], "expected a finite number"),
        (["--channel", "surge.held=yes"], "expected true or false"),
        (["--save-period", "0"], "save_period: found 0.0, expected a positive number"),
        (["--patience", "-1"], "patience: found -1.0"),
        (["--keep", "1"], "keep: found 1, expected a number of checkpoints, 2 or more"),
        (["--channels", "nowhere.yaml"], "channels: nowhere.yaml cannot be read"),
    ],
)
def test_a_mistake_is_told_in_one_sentence(arguments, message):
    with pytest.raises(ConfigError, match=message):
        parsed(*arguments)


@pytest.mark.parametrize("text", ["[1", "data: 3", "data: {channels: [1]}", "\x00", "a: &a [*a]"])
def test_a_file_that_describes_no_channels_is_refused(tmp_path, text):
    file = tmp_path / "other.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"channels: .*other.yaml.*: (name|correct|write)"):
        parsed("--channels", str(file))


def run(monkeypatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["usvlearn live", *arguments])
    try:
        return aboard.main()
    except SystemExit as end:
        return int(end.code or 0)


def test_the_command_tells_what_it_can_do(monkeypatch, capsys, tmp_path):
    assert run(monkeypatch) == run(monkeypatch, "--help") == 0
    assert "usvlearn live moos MISSION.moos" in capsys.readouterr().out
    assert run(monkeypatch, "mos") == 2
    assert "did you mean moos?" in capsys.readouterr().err
    assert run(monkeypatch, "status", str(tmp_path / "none")) == 2
    assert "found no folder" in capsys.readouterr().err
    assert run(monkeypatch, "status", str(tmp_path)) == 0
    assert "no node has written here" in capsys.readouterr().out
    assert run(monkeypatch, "status", "--help") == 0


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path):
    page = (ROOT / "docs" / "live" / "node.md").read_text()
    unit = page[page.index("[Unit]") :].partition("```")[0].replace("/home/boat/aboard/bin/usvlearn", "/bin/true")
    path = tmp_path / "usvlearn.service"
    for text, known in ((unit, True), (unit.replace("ProtectSystem=strict", "NoSuchKey=1"), False)):
        path.write_text(text)
        done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True, timeout=60)
        lines = [line for line in (done.stdout + done.stderr).splitlines() if "usvlearn.service" in line]
        assert (lines == []) == known, lines
