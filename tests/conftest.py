"""What the tests share: seeded samples, and the place of the real logs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.support import REAL_LOGS, ROOT
from usvlearn import Inputs, Sample

torch.set_num_threads(1)
os.environ["COLUMNS"] = "160"  # of tables, wherever the tests run


@pytest.fixture
def real_logs() -> Path:
    """The folder of recorded logs beside the repository; the test is skipped where it is absent."""
    if not REAL_LOGS.is_dir():
        pytest.skip("recorded logs are not part of the repository and are not beside it")
    return REAL_LOGS


def random_samples(steps: int, *batch: int, seed: int = 0, dtype=torch.float64) -> Sample:
    """Random inputs and speeds, all fresh and measured."""
    generator = torch.Generator().manual_seed(seed)

    def uniform() -> torch.Tensor:
        return torch.rand(steps, *batch, generator=generator, dtype=dtype)

    yes = torch.ones(steps, *batch, dtype=torch.bool)
    inputs = Inputs(uniform(), uniform(), 6 * uniform(), uniform() - 0.5, torch.full((steps, *batch), 0.4, dtype=dtype))
    return Sample(inputs, 2 * uniform(), yes, yes)


def python(code: str, **environment: str) -> subprocess.CompletedProcess:
    """Run code in a Python of its own, which has to end well."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done
