"""The size of hostile proofs, and the work that is allowed for their replay."""

import pytest

from certify.proofs import box_proof, vector_box_proof, vector_statements


@pytest.fixture(params=[10, pytest.param(1, marks=pytest.mark.thorough)])
def part(request, monkeypatch) -> int:
    """A tenth of the size and of the work of a replay by default; the thorough tests take all of both."""
    for module in (box_proof, vector_box_proof, vector_statements):
        monkeypatch.setattr(module, "WORK", module.WORK // request.param)
    return request.param
