"""Settings of all tests, and the place of the real logs."""

import gc
import os
from pathlib import Path

import pytest
import torch

from tests.support import REAL_LOGS

torch.set_num_threads(1)
os.environ["COLUMNS"] = "160"  # of tables, wherever the tests run


WITHOUT_KERNELS = ("tests/certify", "tests/logs", "tests/core", "tests/display", "tests/simulate")
WITH = "tests/core/test_lock.py"
FIRST = "tests/report/test_from_runs.py"  # which makes a report that several modules look at, for which they would wait


def pytest_configure(config: pytest.Config) -> None:
    """Let pytest-xdist keep the order below."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """From an empty cache, one process compiles the kernels while the others run what needs none."""

    def turn(item: pytest.Item) -> int:
        if item.nodeid.startswith("tests/engine/test_kernels.py"):
            return 0
        if item.nodeid.startswith(WITHOUT_KERNELS) and not item.nodeid.startswith(WITH):
            return 1
        return 2 if item.nodeid.startswith(FIRST) else 3

    items.sort(key=turn)


def pytest_collection_finish() -> None:
    """What is collected stays until the end: without this, each full garbage collection takes a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def real_logs() -> Path:
    """The folder of recorded logs beside the repository; the test is skipped where it is absent."""
    if not REAL_LOGS.is_dir():
        pytest.skip("recorded logs are not part of the repository and are not beside it")
    return REAL_LOGS
