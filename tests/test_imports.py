"""Which package may import which, by layers, and that no two modules need each other, read from the sources."""

import ast
import functools
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.support import ROOT

# Layers from the ground: a package imports only from its own and from those before it.
LAYERS = (
    "certify.errors", "certify.networks", "certify.proofs", "certify.search", "certify.training", "certify.analysis",
    "certify.display", "certify.command", "certify.__main__",
    "usvlearn.errors", "usvlearn.core", "usvlearn.display", "usvlearn.logs", "usvlearn.simulate", "usvlearn.estimators",
    "usvlearn.engine", "usvlearn.evaluation", "usvlearn.live", "usvlearn.runs", "usvlearn.model", "usvlearn.report",
    "usvlearn.sweeps", "usvlearn.learned", "usvlearn.composition", "usvlearn.cli", "usvlearn.api",
    "usvlearn.testing", "usvlearn.__main__",
)  # fmt: skip
# package -> the modules of certify that may import it, at their top or where they use it
CERTIFY = {
    "torch": {"certify.training", "certify.networks.shallow"},
    "scipy": {"certify.search", "certify.command.compare"},
    "cvxpy": {"certify.search.vector_lmi"},
    "clarabel": {"certify.search.vector_lmi"},
    "matplotlib": {"certify.display.figures"},
    "rich": {"certify.display"},
}
THIRD_PARTY = {"numpy", "safetensors", *CERTIFY}
NO_TORCH = ("usvlearn.errors", "usvlearn.core", "usvlearn.display", "usvlearn.engine", "usvlearn.logs", "usvlearn.live",
            "usvlearn.evaluation", "usvlearn.model", "usvlearn.composition", "usvlearn.cli", "usvlearn.api",
            "usvlearn.learned")  # fmt: skip
TORCH = ("usvlearn.core.protocol", "usvlearn.core.hyperparameters", "usvlearn.engine.rollouts",
         "usvlearn.engine.backend", "usvlearn.engine.external", "usvlearn.engine.torch_steps",
         "usvlearn.evaluation.crossval", "usvlearn.testing")  # fmt: skip
BENCHMARKS = ROOT / "benchmarks"
MODULES = sorted(p for folder in ("usvlearn", "certify") for p in (ROOT / folder).rglob("*.py"))
ROOTS = {"usvlearn", "certify"}  # their own imports are lazy, and tested below


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def imports(path: Path, top_level: bool = False) -> set[str]:
    tree = ast.parse(path.read_text())
    names = set()
    for node in tree.body if top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def within(name: str, allowed) -> bool:
    return any(name == prefix or name.startswith(prefix + ".") for prefix in allowed)


def refused(path: Path) -> Iterator[str]:
    """What a module imports from a layer above its own, or from a package that its layer may not."""
    name = name_of(path)
    level = next((place for place, layer in enumerate(LAYERS) if within(name, [layer])), -1)
    for target in imports(path) - ROOTS if name not in ROOTS else ():
        if within(target, ROOTS) and not within(target, LAYERS[: level + 1]):
            yield target
        elif within(target, ["hydra", "omegaconf"]) and not within(name, ["usvlearn.composition", "usvlearn.cli"]):
            yield target
    if within(name, NO_TORCH) and not within(name, TORCH):
        yield from (target for target in imports(path, top_level=True) if within(target, ["torch"]))


def refused_in_certify(path: Path) -> Iterator[str]:
    """What a module of certify imports that is no package of its own, or imports before it is used."""
    for target in {name.split(".")[0] for name in imports(path)} - set(sys.stdlib_module_names) - {"certify"}:
        if target not in THIRD_PARTY or not within(name_of(path), CERTIFY.get(target, {name_of(path)})):
            yield target
    yield from {name.split(".")[0] for name in imports(path, top_level=True)} & (HEAVY - {"torch"})


def test_packages_import_only_from_layers_below():
    assert [f"{name_of(path)} imports {target}" for path in MODULES for target in refused(path)] == []


def test_no_circle_among_modules():
    """Not even of imports within functions, or for types alone."""
    paths = {name: path for path in MODULES if (name := name_of(path)) not in ROOTS}
    needs = {name: imports(path) & paths.keys() - {name} for name, path in paths.items()}
    assert len(tuple(TopologicalSorter(needs).static_order())) == len(paths)


def test_certify_is_a_leaf_of_few_packages():
    modules = [path for path in MODULES if within(name_of(path), ["certify"])]
    assert [f"{name_of(path)} imports {target}" for path in modules for target in refused_in_certify(path)] == []


@pytest.mark.thorough
def test_no_test_module_imports_another():
    """What two of them need lies in tests/support. The gates compare what the estimators and logs there give."""
    files = [path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    shared = {"tests", "tests.support"}
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in files
        for name in imports(path)
        if (within(name, ["tests"]) and not within(name, ["tests.support"]) and name not in shared)
        or any(part.startswith(("test_", "conftest")) for part in name.split("."))
        or (path.is_relative_to(BENCHMARKS) and within(name, ["tests"]) and path != BENCHMARKS / "gate_cases.py")
    ]
    assert wrong == []


SAME_EVERYWHERE = {"__init__", "__main__", "state", "layer", "kernel"}


def test_no_two_modules_of_one_name_mean_different_things_in_a_room():
    """The names that mean the same in each folder may repeat. In `logs` and `live` a room is a folder of theirs."""
    depth = {"logs": 3, "live": 3}
    names = Counter(
        (path.relative_to(ROOT).parts[: depth.get(path.relative_to(ROOT).parts[1], 2)], path.stem)
        for path in MODULES
        if path.stem not in SAME_EVERYWHERE
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_tests_lie_where_the_package_has_their_module():
    folders = {path.parent.relative_to(ROOT / "tests").as_posix() for path in (ROOT / "tests").rglob("test_*.py")}
    apart = {".", "fuzz", "benchmarks"}
    assert [folder for folder in folders - apart
            if not ((ROOT / "usvlearn" / folder).is_dir() or (ROOT / folder).is_dir())] == []  # fmt: skip


def loaded(code: str) -> set[str]:
    """The packages that a fresh Python has imported at the end of some code."""
    show = "import atexit, sys; atexit.register(lambda: print(*{name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run(
        [sys.executable, "-c", f"{show}\n{code}"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].split())


HEAVY = {"torch", "scipy", "matplotlib", "tensorboard", "numba", "rosbags", "cvxpy", "clarabel",
         "optuna"}  # fmt: skip


def test_the_package_is_imported_at_no_cost():
    assert not loaded("import usvlearn") & {*HEAVY, "numpy", "hydra", "rich"}


def test_package_logs_and_checkpoints_import_without_torch():
    code = (
        "import usvlearn, usvlearn.core.checkpoint, usvlearn.logs.recordings, usvlearn.logs.read\n"
        "from usvlearn.logs.formats.csv import table\n"
        "from usvlearn.logs.formats.moos import alog\n"
        "from usvlearn.logs.formats.ros import rosbag\n"
        "from usvlearn.logs.formats.ardupilot import dataflash, tlog\n"
        "usvlearn.Sample, usvlearn.Aligner"
    )
    assert not loaded(code) & {*HEAVY, "hydra", "rich"}


@pytest.mark.thorough
def test_a_log_is_read_and_shown_without_torch(tmp_path):
    rows = [f"{k / 10},0.5,0.5,90,1.0" for k in range(50)]
    (tmp_path / "log.csv").write_text("\n".join(["time,command_left,command_right,heading,surge", *rows]))
    assert "torch" not in loaded(f"import usvlearn\nprint(usvlearn.read({str(tmp_path)!r}))")


@pytest.mark.thorough
def test_kernels_run_without_torch():
    """Nor does any part of them import it, at any depth."""
    code = "from usvlearn.engine import open_loop_scores, single_steps, run, online"
    assert not loaded(code) & {*HEAVY, "hydra", "rich"} - {"numba", "scipy"}  # which numba imports where it is there
    for path in MODULES:
        if within(name_of(path), ["usvlearn.engine"]) and name_of(path) not in TORCH:
            packages = {name.partition(".")[0] for name in imports(path)}
            assert packages <= {"numpy", "numba", "usvlearn", *sys.stdlib_module_names}, path


def test_the_command_waits_for_nothing():
    for arguments in (["--version"], ["--help"]):
        packages = loaded(f"import usvlearn.__main__\nusvlearn.__main__.main({arguments})")
        assert not packages & {*HEAVY, "numpy", "hydra", "rich"}


@pytest.mark.thorough
@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_help_waits_for_nothing_heavy(script):
    for flag, needed in (("--help", set()), ("--help=all", {"hydra"})):
        code = f"import runpy, sys\nsys.argv = [{script!r}, {flag!r}]\nrunpy.run_path({script!r}, run_name='__main__')"
        packages = loaded(code)
        assert not packages & HEAVY and packages & {"hydra", "numpy", "rich"} >= needed
        assert needed or "hydra" not in packages


def test_help_of_certify_waits_for_nothing_heavy():
    code = "import runpy, sys\nsys.argv = ['certify', '--help']\nrunpy.run_module('certify', run_name='__main__')"
    assert not loaded(code) & HEAVY


def test_type_checkers_see_the_names_that_are_imported_lazily():
    import usvlearn

    block, _ = [node for node in ast.parse(Path(usvlearn.__file__).read_text()).body if isinstance(node, ast.If)]
    seen = {(alias.name, alias.asname, node.module) for node in block.body for alias in node.names}
    assert seen == {(name, name, f"usvlearn.{home}") for name, home in usvlearn._HOME.items()}


def test_public_names_are_there():
    import usvlearn

    for name in usvlearn.__all__:
        assert getattr(usvlearn, name).__name__ == name
    with pytest.raises(AttributeError, match="nothing"):
        usvlearn.nothing  # noqa: B018
