"""Settings of all tests, and the place of the real logs."""

import os
from pathlib import Path

import pytest
import torch

from tests.support import REAL_LOGS

torch.set_num_threads(1)
os.environ["COLUMNS"] = "160"  # of tables, wherever the tests run


@pytest.fixture
def real_logs() -> Path:
    """The folder of recorded logs beside the repository; the test is skipped where it is absent."""
    if not REAL_LOGS.is_dir():
        pytest.skip("recorded logs are not part of the repository and are not beside it")
    return REAL_LOGS
