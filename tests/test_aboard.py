"""The distribution usvlearn-aboard: the same files, command and requirements as usvlearn, but without torch."""

import re
import sys
import tomllib
from importlib import metadata

import pytest

from tests.support import ROOT
from tests.support.commands import python
from usvlearn.cli import main as command
from usvlearn.errors import MissingExtraError

LEFT_OUT = {"torch", "scipy", "hydra-core", "tensorboard", "rich"}


def project(path: str) -> dict:
    return tomllib.loads((ROOT / path).read_text())["project"]


def test_it_requires_what_usvlearn_requires_without_what_a_boat_does_not_need():
    whole, aboard = project("pyproject.toml"), project("aboard/pyproject.toml")
    needed = set(aboard["dependencies"]) - {"pyyaml>=6"}  # usvlearn has it with Hydra
    assert needed <= set(whole["dependencies"])
    assert {name.split(">")[0] for name in set(whole["dependencies"]) - needed} == LEFT_OUT
    for name, packages in aboard["optional-dependencies"].items():
        assert whole["optional-dependencies"].get(name, packages) == packages, name
    for key in ("scripts", "requires-python", "license", "license-files"):
        assert aboard[key] == whole[key]
    assert (ROOT / "aboard" / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


WITHOUT = """
import sys
sys.modules.update(dict.fromkeys(["torch", "scipy", "hydra", "omegaconf", "rich"]))
from usvlearn.__main__ import main
assert main(["{name}", "--help=all"]) == 2
"""


@pytest.mark.parametrize("name", ["train", "evaluate", "inspect"])
def test_a_command_that_needs_more_says_so(name):
    said = python(WITHOUT.format(name=name)).stderr
    assert re.fullmatch(
        rf"error: usvlearn {name} needs the package (hydra|omegaconf|rich), which is not installed \(usvlearn-aboard "
        r"leaves it out\): use an environment where all of usvlearn is installed, by `pip install \.`\n", said
    )  # fmt: skip


def test_a_module_of_our_own_that_is_missing_is_a_bug(monkeypatch):
    monkeypatch.setitem(command.COMMANDS, "warm", ("usvlearn.cli.nothing", ""))
    monkeypatch.setattr(sys, "argv", [])
    with pytest.raises(ModuleNotFoundError):
        command.main(["warm"])


class Installed(dict):
    """Metadata of an installed distribution."""

    def get_all(self, key):
        return self.get(key)


@pytest.mark.parametrize("extra, name", [("mavlink", "usvlearn-aboard"), ("plot", "usvlearn")])
def test_a_missing_extra_is_that_of_the_installed_distribution(extra, name, monkeypatch):
    monkeypatch.setattr(metadata, "metadata", {"usvlearn-aboard": Installed({"Provides-Extra": ["mavlink"]})}.get)
    assert f"pip install '{name}[{extra}]'" in str(MissingExtraError("a", extra, "it"))


def test_a_missing_extra_where_only_usvlearn_is_installed(monkeypatch):
    def none(name):
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "metadata", none)
    assert "pip install 'usvlearn[mavlink]'" in str(MissingExtraError("a", "mavlink", "it"))
