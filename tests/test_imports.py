"""Who may import whom: the layers of the house, read from the sources."""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support import ROOT

# module prefix -> what of ours, and which heavy packages, it may import (anywhere, or at its top level)
LIGHT = {"usvlearn.signals", "usvlearn.errors", "usvlearn.activity"}
KERNELS = {"usvlearn.jit", "usvlearn.family", "usvlearn.arrays", "usvlearn.rows"}
LEARNS = LIGHT | {"usvlearn.estimator", "usvlearn.estimators", "usvlearn.hyper", "usvlearn.rollouts",
                  "usvlearn.checkpoint", "usvlearn.figures"}  # fmt: skip
OURS = {
    "certify": {"certify"},
    "usvlearn.errors": set(),
    "usvlearn.activity": set(),
    "usvlearn.signals": {"usvlearn.errors"},
    "usvlearn.checkpoint": LIGHT,
    "usvlearn.lock": LIGHT,
    "usvlearn.tensorboard": {"usvlearn.crc", "usvlearn.jit"},
    "usvlearn.crc": {"usvlearn.jit"},
    "usvlearn.foreign_yaml": LIGHT,
    "usvlearn.parts": set(),
    "usvlearn.jit": {"usvlearn.parts"},
    "usvlearn.family": LIGHT,
    "usvlearn.arrays": {"usvlearn.jit"},
    "usvlearn.rows": LIGHT | {"usvlearn.jit", "usvlearn.arrays"},
    "usvlearn.logs": LIGHT | {"usvlearn.jit", "usvlearn.logs"},
    "usvlearn.inspection": LIGHT | {"usvlearn.inspection", "usvlearn.logs", "usvlearn.report.terminal",
                                    "usvlearn.figures"},
    "usvlearn.simulate": LIGHT | {"usvlearn.jit", "usvlearn.simulate", "usvlearn.logs.channel"},
    "usvlearn.hyper": LIGHT,
    "usvlearn.figures": LIGHT,
    "usvlearn.plans": LIGHT,
    "usvlearn.estimator": LIGHT | {"usvlearn.family", "usvlearn.hyper"},
    "usvlearn.estimators": LIGHT | {"usvlearn.estimator", "usvlearn.estimators", "usvlearn.hyper", "usvlearn.plans",
                                    "certify", *KERNELS},
    "usvlearn.engine": LIGHT | {"usvlearn.engine", "usvlearn.estimators", "usvlearn.plans", *KERNELS},
    "usvlearn.rollouts": LIGHT | {"usvlearn.engine", "usvlearn.estimator", "usvlearn.plans"},
    "usvlearn.identified": LIGHT | {"usvlearn.engine", "usvlearn.estimators"},
    "usvlearn.planning": LIGHT | {"usvlearn.planning", "usvlearn.engine", "usvlearn.estimators", "usvlearn.figures",
                                  "usvlearn.identified", "usvlearn.logs", *KERNELS},
    "usvlearn.online": LIGHT | {"usvlearn.rollouts", "usvlearn.estimator", "usvlearn.estimators", "usvlearn.checkpoint",
                                "usvlearn.engine", "usvlearn.identified", "usvlearn.plans"},
    "usvlearn.model": LIGHT | {"usvlearn.model", "usvlearn.checkpoint", "usvlearn.estimators", "usvlearn.identified",
                               "usvlearn.jit", "usvlearn.logs.setup", "usvlearn.online", "usvlearn.rows",
                               "usvlearn.runs.layout"},
    "usvlearn.controller": LIGHT | {"usvlearn.controller", "usvlearn.model", "usvlearn.estimators.joint",
                                    "usvlearn.figures", "usvlearn.logs.setup", "usvlearn.report.terminal"},
    "usvlearn.live": LIGHT | {"usvlearn.live", "usvlearn.logs", "usvlearn.online", "usvlearn.checkpoint",
                              "usvlearn.lock", "usvlearn.identified", "usvlearn.estimators", "usvlearn.plans",
                              "usvlearn.tensorboard", "usvlearn.foreign_yaml", "certify"},
    "usvlearn.export": LIGHT | {"usvlearn.export", "usvlearn.model", "usvlearn.estimators", "usvlearn.logs",
                                "usvlearn.runs.layout", "usvlearn.runs.published"},
    "usvlearn.evaluation": LEARNS | {"usvlearn.evaluation", "usvlearn.identified", "certify"},
    "usvlearn.runs": LEARNS | {"usvlearn.evaluation", "usvlearn.runs", "usvlearn.lock", "usvlearn.tensorboard",
                               "usvlearn.engine"},
    "usvlearn.tuning": LEARNS | {"usvlearn.evaluation", "usvlearn.runs", "usvlearn.tuning", "usvlearn.sweeps",
                                 "usvlearn.tensorboard", "usvlearn.report", "usvlearn.lock"},
    "usvlearn.sweeps": LIGHT | {"usvlearn.checkpoint", "usvlearn.evaluation", "usvlearn.figures", "usvlearn.lock",
                                "usvlearn.report", "usvlearn.runs", "usvlearn.sweeps", "usvlearn.tensorboard",
                                "certify"},
    "usvlearn.report": LEARNS | {"usvlearn.evaluation", "usvlearn.identified", "usvlearn.lock", "usvlearn.online",
                                 "usvlearn.report", "usvlearn.runs", "usvlearn.tensorboard", "certify"},
    "usvlearn.cli": {"usvlearn"},  # everything
    "usvlearn.learned": LEARNS | {"usvlearn.engine", "usvlearn.evaluation", "usvlearn.logs", "usvlearn.report",
                                  "usvlearn.runs"},
    "usvlearn.api": {"usvlearn"},  # everything, and nothing imports it
    "usvlearn.__main__": {"usvlearn.cli.beginning", "usvlearn.errors"},
}  # fmt: skip
# package -> the modules of certify that may import it, at their top or where they use it
CERTIFY = {
    "torch": {
        "certify.conditions",
        "certify.projections",
        "certify.compare",
        "certify.families",
        "certify.weights",
        "certify.vector_rates",
        "certify.vector_projections",
    },
    "scipy": {"certify.box_cells", "certify.vector_lmi", "certify.vector_scaling"},
    "highspy": {"certify.box_duals"},
    "cvxpy": {"certify.lmi"},
    "clarabel": {"certify.vector_lmi"},
    "matplotlib": {"certify.figures"},
    "rich": {"certify.printed", "certify.vector_printed"},
}
THIRD_PARTY = {"numpy", "safetensors", *CERTIFY}
NO_TORCH = ("usvlearn.errors", "usvlearn.signals", "usvlearn.checkpoint", "usvlearn.jit", "usvlearn.parts",
            "usvlearn.engine", "usvlearn.online", "usvlearn.identified", "usvlearn.logs", "usvlearn.evaluation",
            "usvlearn.lock", "usvlearn.plans", "usvlearn.inspection", "usvlearn.live", "usvlearn.model",
            "usvlearn.export", "usvlearn.controller",
            "usvlearn.planning",
            "usvlearn.cli.stopping", "usvlearn.cli", "usvlearn.api", "usvlearn.learned")  # fmt: skip
TORCH = ("usvlearn.evaluation.crossval", "usvlearn.report.assembly", "usvlearn.report.sections")  # they simulate
CONFIGURATION = {"hydra", "omegaconf"}
MODULES = sorted(p for folder in ("usvlearn", "certify") for p in (ROOT / folder).rglob("*.py"))


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path: Path, top_level: bool = False) -> set[str]:
    tree = ast.parse(path.read_text())
    found = set()
    for node in tree.body if top_level else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def within(name: str, allowed) -> bool:
    return any(name == prefix or name.startswith(prefix + ".") for prefix in allowed)


def refused(path: Path) -> Iterator[str]:
    """What a module imports that its layer may not."""
    name = name_of(path)
    if name == "usvlearn":
        return  # its lazy imports are tested below
    layer = max((prefix for prefix in OURS if within(name, [prefix])), key=len)
    for found in imports(path):
        package = found.split(".")[0]
        if package in ("usvlearn", "certify"):
            # "from usvlearn import checkpoint" names the package too
            if found != "usvlearn" and not within(found, OURS[layer] | {layer}):
                yield found
            if found == "usvlearn.api":
                yield found
        elif package in CONFIGURATION and not within(name, ["usvlearn.cli"]):
            yield found
    if within(name, NO_TORCH) and not within(name, TORCH):
        yield from (found for found in imports(path, top_level=True) if within(found, ["torch"]))


def refused_in_certify(path: Path) -> Iterator[str]:
    """What a module of certify imports that is no package of its own, or imports before it is used."""
    for found in {name.split(".")[0] for name in imports(path)} - set(sys.stdlib_module_names) - {"certify"}:
        if found not in THIRD_PARTY or name_of(path) not in CERTIFY.get(found, {name_of(path)}):
            yield found
    yield from {name.split(".")[0] for name in imports(path, top_level=True)} & (HEAVY - {"torch"})


def test_modules_import_only_what_their_layer_may():
    assert [f"{name_of(path)} imports {found}" for path in MODULES for found in refused(path)] == []


def test_certify_is_a_leaf_of_few_packages():
    modules = [path for path in MODULES if within(name_of(path), ["certify"])]
    assert [f"{name_of(path)} imports {found}" for path in modules for found in refused_in_certify(path)] == []


def test_no_test_module_imports_another():
    """What two of them need lies in tests/support."""
    files = [path for folder in ("tests", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    shared = {"tests", "tests.support"}
    found = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in files
        for name in imports(path)
        if (within(name, ["tests"]) and not within(name, ["tests.support"]) and name not in shared)
        or any(part.startswith(("test_", "conftest")) for part in name.split("."))
        or (path.parts[-2] == "benchmarks" and within(name, ["tests"]))
    ]
    assert found == []


SAME_EVERYWHERE = {"__init__", "__main__", "state", "layer", "kernel", "errors", "figures", "live"}


def test_no_two_modules_of_one_name_mean_different_things():
    """The names that mean the same in each folder may repeat."""
    names = Counter(path.stem for path in MODULES if path.stem not in SAME_EVERYWHERE)
    names.update(path.name for path in {path.parent for path in MODULES} if path.name not in ("usvlearn", "certify"))
    assert [name for name, count in names.items() if count > 1] == []


def test_tests_lie_where_the_package_has_their_module():
    folders = {path.parent.relative_to(ROOT / "tests").as_posix() for path in (ROOT / "tests").rglob("test_*.py")}
    assert [folder for folder in folders - {".", "fuzz", "benchmarks", "certify"}
            if not (ROOT / "usvlearn" / folder).is_dir()] == []  # fmt: skip


def test_every_module_has_a_layer():
    for path in MODULES:
        name = name_of(path)
        assert name == "usvlearn" or any(within(name, [prefix]) for prefix in OURS), name


def loaded(code: str) -> set[str]:
    """The packages that a fresh Python has imported at the end of some code."""
    show = "import atexit, sys; atexit.register(lambda: print(*{name.partition('.')[0] for name in sys.modules}))"
    done = subprocess.run(
        [sys.executable, "-c", f"{show}\n{code}"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].split())


HEAVY = {"torch", "scipy", "matplotlib", "tensorboard", "numba", "rosbags", "cvxpy", "clarabel", "highspy",
         "optuna"}  # fmt: skip


def test_the_package_is_imported_at_no_cost():
    assert not loaded("import usvlearn") & {*HEAVY, "numpy", "hydra", "rich"}


def test_package_logs_and_checkpoints_import_without_torch():
    code = (
        "import usvlearn, usvlearn.checkpoint, usvlearn.logs.recordings, usvlearn.logs.read, usvlearn.logs.alog\n"
        "import usvlearn.logs.csv_table, usvlearn.logs.rosbag, usvlearn.logs.dataflash, usvlearn.logs.tlog\n"
        "usvlearn.Sample, usvlearn.Aligner"
    )
    assert not loaded(code) & {*HEAVY, "hydra", "rich"}


def test_a_log_is_read_and_shown_without_torch(tmp_path):
    rows = [f"{k / 10},0.5,0.5,90,1.0" for k in range(50)]
    (tmp_path / "log.csv").write_text("\n".join(["time,command_left,command_right,heading,surge", *rows]))
    assert "torch" not in loaded(f"import usvlearn\nprint(usvlearn.read({str(tmp_path)!r}))")


def test_kernels_run_without_torch():
    """Nor does any part of them import it, at any depth."""
    code = "import usvlearn.engine.free_runs, usvlearn.engine.single_steps, usvlearn.engine.run, usvlearn.online"
    assert not loaded(code) & {*HEAVY, "hydra", "rich"} - {"numba", "scipy"}  # which numba imports where it is there
    for path in MODULES:
        if within(name_of(path), ["usvlearn.engine"]):
            packages = {found.partition(".")[0] for found in imports(path)}
            assert packages <= {"numpy", "numba", "usvlearn", *sys.stdlib_module_names}, path


def test_the_command_waits_for_nothing():
    for arguments in (["--version"], ["--help"]):
        found = loaded(f"import usvlearn.__main__\nusvlearn.__main__.main({arguments})")
        assert not found & {*HEAVY, "numpy", "hydra", "rich"}


@pytest.mark.parametrize("script", ["train.py", "evaluate.py"])
def test_help_waits_for_nothing_heavy(script):
    for flag, needed in (("--help", set()), ("--help=all", {"hydra"})):
        code = f"import runpy, sys\nsys.argv = [{script!r}, {flag!r}]\nrunpy.run_path({script!r}, run_name='__main__')"
        found = loaded(code)
        assert not found & HEAVY and found & {"hydra", "numpy", "rich"} >= needed
        assert needed or "hydra" not in found


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
