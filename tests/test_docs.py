"""The examples of README and CONTRIBUTING run; every YAML composes and instantiates."""

import inspect
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import get_class, instantiate
from omegaconf import OmegaConf

from tests.support import ROOT
from usvlearn import Ensemble, Estimator

SOURCES = {".py", ".yaml", ".md"}
DATA = sorted(p.stem for p in (ROOT / "configs" / "data").glob("*.yaml"))


@pytest.mark.parametrize("page", ["README.md", "docs/reference/index.md", "docs/certification.md"])
def test_the_first_example_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)[0], page, "exec"), names)
    if page == "README.md":
        assert (tmp_path / "heron.safetensors").exists() and names["free"].scores["heron"]["persistence"]["mae"] > 0
        assert isinstance(names["predicted"], float) and len((ROOT / page).read_text().splitlines()) <= 90
    elif "reference" in page:
        assert names["surge"].shape == (50, 3, 8) and names["aid"].gain.log.grad.abs().min() > 0
    else:
        assert names["proved"]["condition"] == "exact" and (tmp_path / "two.npz").exists()


def insert(path: Path, after: str, line: str) -> None:
    """Put a line behind the first that begins so."""
    head, place, tail = path.read_text().partition(after)
    assert place, f"{path}: has no {after!r}"
    path.write_text(f"{head}{place}\n{line}{tail}")


@pytest.fixture
def with_smoothing(tmp_path):
    """A copy of the repository with the files and the lines that CONTRIBUTING shows."""
    text = (ROOT / "CONTRIBUTING.md").read_text().partition("## Add an estimator")[2]
    for part in ("usvlearn", "certify", "configs", "tests", "benchmarks"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    files = re.findall(
        r"`((?:usvlearn|configs)/[^`]*smoothing[^`]*)`[^`]*(?:`[^`\n]*`[^`]*)*?```\w+\n(.*?)```", text, re.DOTALL
    )
    assert [Path(name).name for name, _ in files] == ["state.py", "layer.py", "kernel.py", "smoothing.yaml"]
    for name, content in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
    line, place = re.search(r"`([^`]+)` in `COMPILED` of `([^`]+)`", text).groups()
    # Machine code of the other families takes a minute to compile, and the example needs none of them.
    families = tmp_path / place
    families.write_text(
        re.sub(r"COMPILED = \(.*?\)", 'COMPILED = (\n    "baselines.persistence",\n)', families.read_text(), flags=re.S)
    )
    insert(families, "COMPILED = (", f"    {line}")
    line, place, imported = re.search(r"`([^`]+)` in\s+`FAMILIES` of `([^`]+)`,[^`]*`([^`]+)`", text).groups()
    insert(tmp_path / place, "FAMILIES = {", f"    {line}")
    insert(tmp_path / place, "from pathlib import Path\n", imported)
    return tmp_path


@pytest.mark.slow
def test_the_new_estimator_of_contributing_has_every_property(with_smoothing):
    """The contracts; and descriptions and checkpoints that are damaged are refused."""
    environment = os.environ | {"PYTHONPATH": str(with_smoothing), "NUMBA_CACHE_DIR": str(with_smoothing / "cache")}
    tests = ["tests/test_contracts.py", "tests/engine/test_descriptions.py"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "smoothing", *tests]
    done = subprocess.run(command, cwd=with_smoothing, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert int(re.search(r"(\d+) passed", done.stdout).group(1)) >= 14 and "skipped" not in done.stdout


def test_a_hyperparameter_is_in_the_files_that_contributing_names():
    text = (ROOT / "CONTRIBUTING.md").read_text().partition("**A hyperparameter more**")[2].partition("**A new")[0]
    named = set(re.findall(r"`((?:usvlearn|configs)/[^`]+)`", text))
    sources = [
        path
        for folder in ("usvlearn/estimators", "configs")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in SOURCES
    ]
    files = {path.relative_to(ROOT).as_posix() for path in sources if "dead_zone" in path.read_text().lower()}
    assert len(named) == 4 and named <= files
    assert files - named == {"usvlearn/estimators/axis/turning_quantities.py"}  # the quantity that a fit identifies


@pytest.mark.thorough
@pytest.mark.parametrize("data", DATA)
def test_every_configuration_composes_and_its_ensemble_runs(data):
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"data={data}"])
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    state = ensemble.init((2,))
    assert state.predictions.shape == (2, len(ensemble.names))
    assert cfg.vehicle.mass > 0 and cfg.data._target_.startswith("usvlearn.")


@pytest.mark.thorough
def test_every_estimator_and_combiner_file_instantiates():
    folder = ROOT / "configs" / "estimator"
    names = sorted(p.stem for p in folder.glob("*.yaml"))
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"+estimator@more.{name}={name}" for name in names])
        assert compose("evaluate").runs is None
    built = instantiate(cfg.more)
    assert sorted(built) == names and all(isinstance(e, Estimator) for e in built.values())


CHOSEN = {  # of a member of the ensemble, in place of the signature's default
    ("dynamic_rls", "memory"), ("ensemble", "memory"), ("dynamic_rls", "patience"), ("dynamic_rls", "inflation"),
    ("joint", "trial"), ("joint_averaged", "trial"), ("rnn_replay", "replay_size"), ("rnn_replay", "unroll"),
    *itertools.product(("joint_quick",), ("disturbance", "disturbance_time", "current", "drift_time", "outlier")),
    *itertools.product(
        ("joint_averaged",), ("disturbance", "disturbance_time", "drift_time", "current", "lag", "estimate_every")),
}  # fmt: skip
GIVEN = {"_target_", "model", "members", "estimator", "mass", "surge_max"}  # to whom, and of the vehicle


def constructors(node):
    """Every constructor call below a node of the configuration."""
    if isinstance(node, dict):
        if "_target_" in node:
            yield node
        for child in node.values():
            yield from constructors(child)


def test_yaml_defaults_are_the_signatures():
    """A default lives in the signature; the YAML shows all of them and must not drift."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        files = sorted(p.stem for p in (ROOT / "configs" / "estimator").glob("*.yaml"))
        cfg = compose("train", [f"+estimator@more.{name}={name}" for name in files])
    seen = set()
    for group in (cfg.more, cfg.combiners):
        for name, member in OmegaConf.to_container(group, resolve=True).items():
            for node in constructors(member):
                signature = inspect.signature(get_class(node["_target_"])).parameters
                parameters = {key: each for key, each in signature.items() if each.kind == each.POSITIONAL_OR_KEYWORD}
                assert set(node) - {"_target_"} == set(parameters), (name, node["_target_"])
                for key in set(node) - GIVEN:
                    default = parameters[key].default
                    default = list(default) if isinstance(default, tuple) else default
                    if node[key] != default:
                        seen.add((name, key))
                        assert (name, key) in CHOSEN, (
                            f"{name}.{key}: {node[key]} in the YAML, {default} in the signature"
                        )
    assert seen == CHOSEN


@pytest.mark.slow
def test_real_logs_replay_to_the_figures_of_the_readme(real_logs, tmp_path):
    """Skill on the BlueBoat, untuned; the files are not part of the repository."""
    floors = {"blueboat": {"aid": 0.35, "rnn": 0.30, "ensemble": 0.43}, "vtec": {"aid": 0.28, "ensemble": 0.35},
              "dalian": {"ensemble": 0.22}}  # fmt: skip
    for data, least in floors.items():
        folder = tmp_path / data
        arguments = [f"data={data}", f"data.path={real_logs / data}", f"hydra.run.dir={folder}"]
        command = [sys.executable, "train.py", *arguments]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        (rows,) = json.loads((folder / "results.json").read_text())["boats"].values()
        for name, floor in least.items():
            assert rows[name]["skill"] >= floor, (data, name, rows[name])
