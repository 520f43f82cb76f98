"""The size of hostile proofs, and the work that is allowed for their replay."""

import pytest

from certify.proofs import box_proof


@pytest.fixture(params=[10, pytest.param(1, marks=pytest.mark.thorough)])
def part(request, monkeypatch) -> int:
    """A tenth of the size and of the work of a replay by default; the thorough tests take all of both."""
    monkeypatch.setattr(box_proof, "WORK", box_proof.WORK // request.param)
    return request.param
