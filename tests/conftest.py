"""Settings of all tests, and the place of the real logs."""

import copy
import gc
import os
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

os.environ["COLUMNS"] = "160"  # of tables, wherever the tests run

TIERS = ("thorough", "slow", "slurm", "docs")
WITHOUT_KERNELS = ("tests/certify", "tests/logs", "tests/core", "tests/display", "tests/simulate")
BUT_WITH_KERNELS = "tests/core/test_lock.py", "tests/core/test_checkpoint.py"
FIRST = "tests/report/test_build.py"  # of the thorough tests: several modules wait for the report that it makes


def pytest_configure(config: pytest.Config) -> None:
    """Let pytest-xdist keep the order below. The process that only hands out the tests does not wait for torch."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False
    if getattr(config.option, "numprocesses", None):
        return
    import torch
    from hypothesis import HealthCheck, settings

    torch.set_num_threads(1)
    settings.register_profile("loaded", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("loaded")  # drawing cases may take long on a loaded machine


def tier(item: pytest.Item) -> str:
    """The tier of a test: of its markers the one that stands last in TIERS; without one, it runs by default."""
    return next((name for name in reversed(TIERS) if item.get_closest_marker(name)), "default")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tiers that `-m` does not name, unless a test is named itself, and sort the rest.

    From an empty cache, one process compiles the kernels while the others run what needs none.
    """
    wanted = {"default", *re.findall(r"\w+", config.option.markexpr)}
    named = tuple(each for each in config.args if "::" in each)
    left_out = {item for item in items if tier(item) not in wanted and not item.nodeid.startswith(named)}
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=list(left_out))

    def turn(item: pytest.Item) -> int:
        if item.nodeid.startswith("tests/engine/test_kernels.py"):
            return 0
        if item.nodeid.startswith(WITHOUT_KERNELS) and not item.nodeid.startswith(BUT_WITH_KERNELS):
            return 1
        return 2 if item.nodeid.startswith(FIRST) else 3

    items.sort(key=turn)


def pytest_collection_finish() -> None:
    """What is collected stays until the end: without this, each full garbage collection takes a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> Iterator[None]:
    """Ctrl-C is heeded in the tests and in what they start, also where a shell began pytest in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before or signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def composed_once() -> Iterator[None]:
    """Each file of configs/ is read once, and what the same overrides compose of them is kept for a while."""
    from hydra._internal.config_loader_impl import ConfigLoaderImpl
    from omegaconf import OmegaConf

    from tests.support import ROOT

    load, compose, files, composed = OmegaConf.load, ConfigLoaderImpl.load_configuration, {}, {}
    ours = f"{ROOT}/configs", f"file://{ROOT}/configs", "pkg://", "structured://"

    def once(among, key, make):
        if key not in among:
            among[key] = make()
        return copy.deepcopy(among[key])

    def load_once(file):
        name = str(getattr(file, "name", ""))
        return once(files, name, lambda: load(file)) if name.startswith(f"{ROOT}/configs/") else load(file)

    def compose_once(self, config_name, overrides, *options, **named):
        def make():
            return compose(self, config_name, overrides, *options, **named)

        if not all(str(each.path).startswith(ours) for each in self.config_search_path.get_path()):
            return make()
        if len(composed) > 50:
            composed.clear()
        key = os.getcwd(), config_name, *overrides, str(self.config_search_path), options, *named.items()
        return once(composed, key, make)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(load_once))
        patch.setattr(ConfigLoaderImpl, "load_configuration", compose_once)
        yield


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two simulated boats, two missions each, which nobody changes; beside it the text that it printed."""
    from tests.support import made_once
    from tests.support.commands import SEASON, ran

    def make(folder: Path) -> None:
        done = ran(*SEASON, "--all", "hydra.run.dir=run", folder=folder)
        (folder / "output.txt").write_text(done.stdout)

    return made_once(tmp_path_factory, "finished", make) / "run"


@pytest.fixture
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page whose figures are all its first one, for tests of its words: drawing is most of a report's time."""
    from usvlearn.report import page

    draw: Callable[[str, Any], tuple[str, bytes]] = page._drawing
    drawings: list[tuple[str, bytes]] = []

    def first(name: str, figure: Any) -> tuple[str, bytes]:
        if not drawings:
            drawings.append(draw(name, figure))
        return drawings[0]

    monkeypatch.setattr(page, "_drawing", first)


@pytest.fixture
def real_logs() -> Path:
    """The folder of recorded logs beside the repository; the test is skipped where it is absent."""
    from tests.support import REAL_LOGS

    if not REAL_LOGS.is_dir():
        pytest.skip("recorded logs are not part of the repository and are not beside it")
    return REAL_LOGS
