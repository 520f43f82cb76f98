"""`usvlearn check`: the verdict on logs and on a configuration; nothing is written."""

import sys

import pytest

from tests.support.commands import sentence
from tests.support.exported import knots_table
from tests.support.voyages import voyage
from usvlearn.cli import check, inspect, train
from usvlearn.cli.main import main


@pytest.mark.thorough
def test_logs_and_their_configuration_get_the_same_verdict(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    log = str(knots_table(tmp_path, voyage(minutes=6.0)))
    before = sorted(tmp_path.iterdir())
    check.work([log, "--name", "heron"])
    first = capsys.readouterr().out.splitlines()
    assert sorted(tmp_path.iterdir()) == before and first[0].startswith("heron: 0.10 h in 1 run; data check: ")
    assert first[1].startswith("good for  ") and len(first) <= 5
    inspect.work([log, "--name", "heron"])
    assert "\n".join(first) in capsys.readouterr().out
    check.work(["my_boat.yaml"])
    assert capsys.readouterr().out.splitlines()[1].startswith("good for  ")


@pytest.mark.parametrize("name", ["fit", "check", "plan", "controller", "inspect"])
def test_without_arguments_its_usage_is_an_error(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    assert main([name]) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"usage: usvlearn {name} ") and said.out == ""


def test_the_keys_of_a_section_are_listed(monkeypatch, capsys):
    said = sentence(train.main, ["estimators.rnn.lr=0.1"], monkeypatch, capsys)
    assert "did you mean estimators.rnn.rate? estimators.rnn has neurons, surge_max," in said
    assert "momentum" in said and "_target_" not in said
