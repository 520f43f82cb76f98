"""A checkpoint from which the tests of the node start."""

from pathlib import Path

import pytest

from tests.support.live import learned_set


@pytest.fixture(scope="module")
def start(tmp_path_factory) -> Path:
    return learned_set(tmp_path_factory.mktemp("start"))
