"""The examples of README and CONTRIBUTING run; every YAML composes and instantiates."""

import math
import re
import sys
import types
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from tests import estimators, test_contracts
from usvlearn import Ensemble, Estimator

ROOT = Path(__file__).parents[1]
DATA = sorted(p.stem for p in (ROOT / "configs" / "data").glob("*.yaml"))


def code(name: str) -> str:
    return re.search(r"```python\n(.*?)```", (ROOT / name).read_text(), re.DOTALL).group(1)


def test_readme_example_runs_and_is_short():
    names: dict = {}
    exec(compile(code("README.md"), "README.md", "exec"), names)
    assert names["predicted"].shape == () and names["surge"].shape == (50, 3, 8)
    assert names["aid"].gain.log.grad.abs().min() > 0
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100


def test_the_example_of_certify_runs():
    names: dict = {}
    exec(compile(code("certify/README.md"), "certify/README.md", "exec"), names)
    assert names["certificate"]["condition"] == "tight"


def test_a_new_estimator_passes_every_contract(monkeypatch):
    """CONTRIBUTING's example, put on the list, has all the properties."""
    text = code("CONTRIBUTING.md")
    assert len(text.splitlines()) <= 40
    module = types.ModuleType("smoothing")
    monkeypatch.setitem(sys.modules, "smoothing", module)
    exec(compile(text, "smoothing.py", "exec"), module.__dict__)
    monkeypatch.setitem(estimators.ESTIMATORS, "smoothing", module.Smoothing)
    ran = 0
    for name, test in vars(test_contracts).items():
        if not name.startswith("test_") or "tmp_path" in test.__code__.co_varnames[: test.__code__.co_argcount]:
            continue
        arguments = test.__code__.co_varnames[: test.__code__.co_argcount]
        every = {"name": "smoothing", "batch": (2, 3), "dtype": torch.float64, "field": "heading", "value": math.nan}
        test(**{argument: every[argument] for argument in arguments})
        ran += 1
    assert ran >= 12


@pytest.mark.parametrize("data", DATA)
def test_every_configuration_composes_and_its_ensemble_runs(data):
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"data={data}"])
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    state = ensemble.init((2,))
    assert state.predictions.shape == (2, len(ensemble.names))
    assert cfg.vehicle.mass > 0 and cfg.data._target_.startswith("usvlearn.")


def test_every_estimator_and_combiner_file_instantiates():
    folder = ROOT / "configs" / "estimator"
    names = sorted(p.stem for p in folder.glob("*.yaml"))
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"+estimator@more.{name}={name}" for name in names])
        assert compose("evaluate").runs is None
    built = instantiate(cfg.more)
    assert sorted(built) == names and all(isinstance(e, Estimator) for e in built.values())


def test_yaml_defaults_are_the_signatures():
    """A default lives in the signature; the YAML shows it and must not drift from it."""
    import inspect

    from hydra.utils import get_class

    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train")
    boats = {"mass", "surge_max"}  # known of the vehicle
    for group in (cfg.estimators, cfg.combiners):
        for name, node in group.items():
            parameters = inspect.signature(get_class(node._target_).__init__).parameters
            for key, value in node.items():
                if key in ("_target_", "model", "members") or key in boats:
                    continue
                default = parameters[key].default
                default = list(default) if isinstance(default, tuple) else default
                assert value == default, f"{name}.{key}: {value} in the YAML, {default} in the signature"


def test_real_logs_replay_to_the_figures_of_the_readme(real_logs, tmp_path):
    """Skill on the BlueBoat, untuned; the files are not part of the repository."""
    import json
    import subprocess

    floors = {"blueboat": {"aid": 0.35, "dynamic_rls": 0.31}, "vtec": {"aid": 0.28}, "dalian": {}, "pearl": {}}
    for data, least in floors.items():
        folder = tmp_path / data
        command = [
            sys.executable,
            "train.py",
            f"data={data}",
            f"data.path={real_logs / data}",
            f"hydra.run.dir={folder}",
        ]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        (rows,) = json.loads((folder / "results.json").read_text())["boats"].values()
        for name, floor in least.items():
            assert rows[name]["skill"] >= floor, (data, name, rows[name])
