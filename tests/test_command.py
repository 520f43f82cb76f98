"""The command `usvlearn`: it hands its arguments on, and says which commands there are."""

import shlex
import sys

import pytest

import usvlearn
from tests.support.commands import run
from usvlearn.__main__ import main
from usvlearn.cli.main import COMMANDS
from usvlearn.cli.sweep import again


def test_the_version_is_the_packages(capsys):
    assert main(["--version"]) == 0 and capsys.readouterr().out == f"usvlearn {usvlearn.__version__}\n"


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_help_names_every_command(arguments, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    assert main(arguments) == 0
    assert all(f"\n  {name} " in capsys_text for capsys_text in [capsys.readouterr().out] for name in COMMANDS)


def test_an_unknown_command_is_told_in_one_sentence(capsys):
    assert main(["trian"]) == 2
    assert capsys.readouterr().err == (
        f"error: found the command 'trian', expected one of {', '.join(COMMANDS)}: did you mean train?\n"
    )


def test_every_command_gets_its_arguments(tmp_path):
    for arguments, words in (
        (["train", "data=csv", "data.path=none.csv"], "data.path: found 'none.csv'"),
        (["evaluate", "runs=none"], "runs: found no run below 'none'"),
        (["certify", "none"], "none"),
    ):
        done = run(*arguments, folder=tmp_path, script="usvlearn/__main__.py")
        assert done.returncode == 2 and words in done.stderr, done.stderr


@pytest.mark.parametrize(
    ("program", "said"), [("usvlearn train", "usvlearn train"), ("./train.py", "python ./train.py")]
)
def test_the_command_that_goes_on_is_the_one_that_was_given(program, said, tmp_path, monkeypatch):
    (tmp_path / "runs.json").write_text("{}")
    monkeypatch.setattr(sys, "argv", [program, "--config-dir", "mine", "data=my_boat"])
    command = again(None, tmp_path)
    assert command.startswith(f"{said} --config-dir mine data=my_boat hydra.run.dir=")
    assert shlex.split(command)[-1] == "resume=latest"
