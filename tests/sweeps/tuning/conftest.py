"""The fleet on which members are tuned."""

import pytest
from hydra.utils import instantiate

from tests.support.configured import configured
from usvlearn.logs.recordings import align_fleet


@pytest.fixture(scope="module")
def fleet():
    """Two boats, two missions each."""
    cfg = configured()
    return align_fleet(instantiate(cfg["data"]), **cfg["align"])
