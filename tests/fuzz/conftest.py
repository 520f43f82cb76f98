"""What the fuzzers share: how many cases each draws, and from which seed.

    @pytest.mark.fuzz(cases=300, slow=10_000)
    def test_something(rng, cases): ...

draws 100 cases by default, the other 200 among the thorough tests, and 10,000 with `pytest -m slow`.
`FUZZ_SEED=7 pytest -m slow tests/fuzz` draws other cases.
"""

import os
import zlib

import numpy as np
import pytest


def pytest_generate_tests(metafunc):
    if mark := metafunc.definition.get_closest_marker("fuzz"):
        counts = {
            mark.kwargs["cases"] // 3: (),
            mark.kwargs["cases"] - mark.kwargs["cases"] // 3: pytest.mark.thorough,
            mark.kwargs["slow"]: pytest.mark.slow,
        }
        metafunc.parametrize(
            "cases", [pytest.param(max(n, 1), marks=tier, id=f"{max(n, 1)}") for n, tier in counts.items()]
        )


@pytest.fixture
def rng(request) -> np.random.Generator:
    """Random numbers of this test alone: by its name and the seed of the run."""
    seed = int(os.environ.get("FUZZ_SEED", "0"))
    return np.random.default_rng([seed, zlib.crc32(request.node.nodeid.encode())])
