"""A run from somebody else is opened without running code that it names; what is ours, or trusted, works as before."""

import ast
import json
import shutil
import sys
import types
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tests.support import ROOT
from tests.support.commands import run
from tests.support.runs import forge, tools
from usvlearn import Persistence
from usvlearn.cli.fit import work as fit
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.report.build import read
from usvlearn.runs.saved import configuration
from usvlearn.runs.trust import PACKAGES, check_setting, check_settings

DATA = ("data", "experiment", "estimator", "combiner")
CODE = "__import__('pathlib').Path({!r}).touch()"


def forged(saved: Path, folder: Path, change) -> Path:
    """A copy of a run with other settings in all of its checkpoints."""
    shutil.copytree(saved, folder)
    forge(folder, change)
    return folder


HARM = {  # what a foreign configuration may ask for, `touched` being a file that must not appear
    "sympy": {"_target_": "sympy.sympify", "a": CODE},
    "eval": {"_target_": "builtins.eval", "_args_": [CODE]},
    "exec": {"_target_": "builtins.exec", "_args_": [CODE], "_partial_": False, "_recursive_": False},
    "system": {"_target_": "os.system", "command": "touch {}"},
    "posix": {"_target_": "posix.system", "_args_": ["touch {}"]},
    "numpy": {"_target_": "numpy.load", "file": "{}", "allow_pickle": True},
    "hydra": {"_target_": "hydra.utils.get_class", "path": "antigravity.fly"},
    "get_method": {"_target_": "hydra.utils.get_method", "path": "os.system"},
    "re-export": {"_target_": "usvlearn.estimators.rnn.layer.torch.load", "f": "{}", "weights_only": False},
    "module": {"_target_": "usvlearn.estimators.rnn.layer.torch.serialization.load", "f": "{}"},
    "class of elsewhere": {"_target_": "usvlearn.logs.read.Path", "_args_": ["{}"]},
    "attribute": {"_target_": "usvlearn.logs.read.Path.touch", "self": {"_target_": "usvlearn.logs.read.Path"}},
    "method": {"_target_": "usvlearn.estimators.aid.layer.AID.save", "_args_": ["{}"]},
    "private": {"_target_": "usvlearn.logs.read._find", "path": "{}", "suffixes": []},
    "dunder": {"_target_": "usvlearn.logs.read.__builtins__.eval", "_args_": [CODE]},
    "function": {"_target_": "usvlearn.estimators.rnn.initial.pretrained_weights", "given": "{}", "n": 20},
    "ours elsewhere": {"_target_": "usvlearn.core.checkpoint.write_atomically", "path": "{}", "content": "x"},
    "lookalike": {"_target_": "usvlearn.estimators_of_mine.AID"},
    "relative": {"_target_": ".os.system", "command": "touch {}"},
    "no name": {"_target_": ["os.system"]},
    "nothing": {"_target_": None},
    "interpolated": {"_target_": "${oc.decode:'os.system'}", "command": "touch {}"},
}


def filled(node, touched: Path):
    return json.loads(json.dumps(node).replace("{!r}", repr(str(touched))).replace("{}", str(touched)))


def beneath(node) -> dict:
    """The same harm where nobody looks: in lists, in arguments, under other keys, deep down."""
    return {
        "as a member": lambda cfg: cfg["estimators"].update(bad=node),
        "as all members": lambda cfg: cfg.update(estimators=node),
        "as the data": lambda cfg: cfg.update(data=node),
        "as a rule": lambda cfg: cfg["combiners"].update(bad=node),
        "in a list": lambda cfg: cfg["estimators"]["sift_map"].update(_args_=[[node]]),
        "as an argument": lambda cfg: cfg["data"]["sensors"].update(surge_hz={"x": node}),
        "unused": lambda cfg: cfg.update(other={"_partial_": True, "list": [1, {"deep": [node]}]}),
        "within a target": lambda cfg: cfg["estimators"]["aid"].update(_target_={"_target_": node}),
    }


@pytest.mark.parametrize("name", HARM)
def test_no_code_that_a_foreign_run_names_is_called(saved, tmp_path, name):
    touched = tmp_path / "touched"
    changes = beneath(filled(HARM[name], touched))
    folder = forged(saved, tmp_path / "run", changes["as a member"])
    with pytest.raises(CheckpointError, match="expected a class below"):
        read([folder], tools())
    for change in changes.values():
        settings = json.loads(json.dumps(configuration(saved)))
        change(settings)
        with pytest.raises(CheckpointError, match=r"expected a class below usvlearn.* add trust=MODULE$") as caught:
            check_settings("run", settings)
        assert "_target_: found" in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 600
    assert not touched.exists() and "antigravity" not in sys.modules


@pytest.mark.parametrize("key", ["experiment", "data", "align", "vehicle", "estimators"])
def test_no_value_of_a_foreign_run_is_interpolated(saved, tmp_path, key):
    folder = forged(saved, tmp_path / "run", lambda cfg: cfg.setdefault(key, {}).update(x=["${oc.env:HOME}"]))
    with pytest.raises(CheckpointError, match=rf"{key}\.x\.0: found '\$\{{oc\.env:HOME\}}', expected plain data"):
        read([folder], tools())


def test_a_nest_of_settings_is_refused(saved, tmp_path):
    nest: dict = {}
    for _ in range(200):
        nest = {"x": nest}
    folder = forged(saved, tmp_path / "run", lambda cfg: cfg["data"].update(x=nest))
    with pytest.raises(CheckpointError, match="more than 50 levels"):
        read([folder], tools())


@pytest.mark.parametrize("broken", ["data", "estimators", "align", "vehicle"])
def test_a_configuration_that_lacks_a_part_is_told(saved, tmp_path, broken):
    folder = forged(saved, tmp_path / "run", lambda cfg: cfg.update({broken: [1]}))
    with pytest.raises(CheckpointError, match=r"none of its .* checkpoints can be read"):
        read([folder], tools())


def test_the_program_ends_with_one_sentence_and_code_2(saved, tmp_path):
    touched = tmp_path / "touched"
    harm = filled(HARM["sympy"], touched)
    folder = forged(saved, tmp_path / "run", lambda cfg: cfg["estimators"].update(bad=harm))
    done = run(f"runs={folder}", folder=tmp_path, script="evaluate.py")
    assert done.returncode == 2 and not touched.exists() and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ") and "estimators.bad._target_: found 'sympy.sympify'" in line


def test_an_estimator_of_the_users_own_is_opened_by_trust_alone(saved, tmp_path, monkeypatch):
    package, module = types.ModuleType("boats"), types.ModuleType("boats.own")
    module.Mine = type("Mine", (Persistence,), {"__module__": "boats.own"})
    module.torch = types.ModuleType("torch")
    for each in (package, module):
        monkeypatch.setitem(sys.modules, each.__name__, each)
    package.own = module
    mine = {"_target_": "boats.own.Mine"}
    folder = forged(saved, tmp_path / "run", lambda cfg: cfg["estimators"].update(persistence=mine))
    with pytest.raises(CheckpointError, match=r"estimators\.persistence\._target_: found 'boats\.own\.Mine'"):
        read([folder], tools())
    assert configuration(folder, unused=["estimators"])["estimators"]["persistence"] == mine  # a fit makes none of them
    data = forged(saved, tmp_path / "read", lambda cfg: cfg["data"].update(_target_="boats.own.Mine"))
    with pytest.raises(CheckpointError, match=r"data\._target_: found 'boats\.own\.Mine'.*add trust=MODULE"):
        fit([str(data)])
    with pytest.raises(ConfigError, match=r"found 'b c', expected the name of a module"):
        fit([str(data), "trust=b c"])
    for trust in ("boats", "boats.own", ["elsewhere", "boats.own"], OmegaConf.create(["boats"])):
        ensemble, _ = read([folder], tools(trust))
        assert type(ensemble.members["persistence"]) is module.Mine
    for trust in ("boat", "boats.own.Mine", ["boats.other"]):
        with pytest.raises(CheckpointError, match="add trust=MODULE"):
            read([folder], tools(trust))
    for trust in ("", "a b", [3], ["boats."]):
        with pytest.raises(ConfigError, match=r"trust: found .*expected the name of a module"):
            read([folder], tools(trust))
    system = {"_target_": "boats.own.os.system", "command": "true"}
    with pytest.raises(ConfigError, match=r"trust: boats\.own\.os cannot be imported"):
        check_settings("a", system, "boats")
    module.loads = json.loads  # what a trusted module imports is not its own
    with pytest.raises(CheckpointError, match="add trust=MODULE"):
        check_settings("a", {"_target_": "boats.own.loads", "s": "1"}, "boats")


@pytest.mark.slow
def test_trust_is_a_key_of_evaluate(saved, tmp_path):
    (tmp_path / "my_boats.py").write_text(
        "from usvlearn import Persistence\nclass Mine(Persistence):\n    '''Another name.'''\nprint('imported')\n"
    )
    mine = {"_target_": "my_boats.Mine"}
    folder = forged(saved, tmp_path / "run", lambda cfg: cfg["estimators"].update(persistence=mine))
    refused = run(f"runs={folder}", folder=tmp_path, script="evaluate.py")
    assert refused.returncode == 2 and "my_boats.Mine" in refused.stderr and "imported" not in refused.stdout
    done = run(f"runs={folder}", "trust=my_boats", folder=tmp_path, script="evaluate.py", PYTHONPATH=str(tmp_path))
    assert done.returncode == 0 and done.stdout.startswith("imported"), done.stderr


def test_everything_that_the_shipped_configuration_names_is_allowed():
    files = sorted((ROOT / "configs").rglob("*.yaml"))
    targets = [node for file in files if file.parent.name in DATA for node in _nodes(OmegaConf.load(file))]
    assert len(targets) > 40
    for target in targets:
        check_settings("configs", {"_target_": target})
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        check_settings("train", OmegaConf.to_container(compose("train"), resolve=True))


def _nodes(config) -> list[str]:
    config = OmegaConf.to_container(config) if OmegaConf.is_config(config) else config
    if isinstance(config, dict):
        targets = [config["_target_"]] if "_target_" in config else []
        return targets + [each for value in config.values() for each in _nodes(value)]
    return [each for value in config for each in _nodes(value)] if isinstance(config, list) else []


def test_what_is_allowed_neither_writes_nor_calls_what_it_is_given():
    """Of the packages whose classes a foreign run may make: nothing in them writes files or runs foreign code."""
    builtins = {"eval", "exec", "compile", "__import__"}
    methods = {
        "import_module", "system", "popen", "Popen", "run", "unlink", "rmdir", "rmtree", "rename",
        "write_text", "write_bytes", "write_atomically", "save", "mkdir", "touch", "symlink_to", "chmod", "loads",
        "instantiate",
    }  # fmt: skip
    for package in PACKAGES:
        for path in (ROOT / package.replace(".", "/")).glob("*.py"):
            for node in filter(lambda node: isinstance(node, ast.Call), ast.walk(ast.parse(path.read_text()))):
                name, attribute = getattr(node.func, "id", ""), getattr(node.func, "attr", "")
                assert name not in builtins | methods and attribute not in methods, f"{path.name}:{node.lineno}"
                if (called := ast.unparse(node.func)).startswith(("os.", "shutil.")):
                    assert called in ("os.fspath", "os.fstat", "os.listdir") or called.startswith("os.path."), called
                if "open" in (name, attribute):
                    modes = {each.value for each in node.args if isinstance(each, ast.Constant)}
                    assert modes <= {"rb"}, f"{path.name}:{node.lineno}"


@pytest.mark.parametrize(
    "setting",
    [
        [1.0], {"_target_": 1.0}, {"model._target_": 1.0}, {"gain": "os.system"}, {"gain": True}, {"gain": None},
        {"gain": float("nan")}, {"gain=1 estimators.aid._target_": 2.0}, {"a\nb": 1.0}, {"": 1.0},
        {"gain": {"_target_": "os.system"}},
    ],
)  # fmt: skip
def test_a_tuned_setting_is_numbers_alone(setting):
    with pytest.raises(ConfigError, match="found the setting") as caught:
        check_setting("tuning.json", setting)
    assert "\n" not in str(caught.value)
