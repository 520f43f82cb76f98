"""Boxes of small degenerate networks: every rate is decided as by exact enumeration of cells, and nothing crashes."""

import numpy as np
import pytest

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import slope_at
from certify.proofs.box_proof import proves
from certify.proofs.rounding import float_below
from certify.search.box import certify, operating_box, rate
from tests.support.exact_cells import exact_rate

FAMILIES = ("integers", "halves", "duplicates", "bias-free", "common point", "float32", "zero weights", "dead neurons")
SECONDS = 5.0  # where planes meet in a point the search ends with a bracket


def draw(rng: np.random.Generator, family: str) -> ShallowWeights:
    """Small integers or parts of them: hyperplanes coincide, meet in points and lines, and touch the box."""
    n, m = int(rng.integers(1, 13)), int(rng.integers(0, 4))
    rows, a = rng.integers(-3, 4, (n, m + 2)).astype(float), rng.integers(-3, 4, n) / 4
    if family == "halves":
        rows /= 2
    elif family == "duplicates":
        for i in range(1, n):
            if rng.random() < 0.5:
                rows[i] = rows[rng.integers(i)] * rng.choice([1.0, 2.0, -1.0, -0.5, 3.0])
    elif family == "bias-free":
        rows[:, -1] = 0.0
        if rng.random() < 0.5:
            rows[:, :-1] = rng.normal(size=(n, m + 1))
    elif family == "common point":
        point = np.r_[rng.choice([0.0, 0.25, 0.5, 1.0]), rng.choice([-1.0, 0.0, 0.5, 0.75], m)]
        rows[:, -1] = -rows[:, :-1] @ point
    elif family == "float32":
        rows, a = ((x / rng.choice([3, 7, 10])).astype(np.float32).astype(float) for x in (rows, a))
    elif family == "zero weights":
        rows[rng.random(rows.shape) < 0.5] = 0.0
        a[rng.random(n) < 0.3] = 0.0
    elif family == "dead neurons":
        rows[rng.random(n) < 0.4, -1] = -9.0
    return ShallowWeights(a, rows[:, 0], rows[:, 1:-1], rows[:, -1])


def decided(rng: np.random.Generator, cases: int) -> int:
    """How many networks have a closed rate above 0; each is bracketed, certified just above it, refuted just below."""
    certified = 0
    for k in range(cases):
        weights = draw(rng, FAMILIES[k % len(FAMILIES)])
        box = operating_box(weights.W2.shape[1])
        truth = exact_rate(weights, box)
        bracket = rate(weights, box, seconds=SECONDS)
        assert bracket.lower <= truth <= bracket.upper, (k, weights)
        if bracket.lower:
            slope = abs(slope_at(weights, np.r_[bracket.witness.x, bracket.witness.u]))
            assert float_below(slope) == bracket.lower == abs(bracket.witness.slope), (k, weights)
        if not (truth and bracket.closed):
            continue
        above = float(truth) * (1 + 1e-9)
        verdict = certify(weights, box, above, SECONDS)
        if verdict.verdict == "unknown":  # 1e-9 above is nearer than the bracket, where planes meet in a point
            continue
        assert verdict.verdict == "certified" and proves(weights, box, verdict.tree, above), (k, weights)
        assert not proves(weights, box, verdict.tree, truth), (k, weights)
        assert certify(weights, box, np.nextafter(float(truth), 0), SECONDS).verdict == "refuted", (k, weights)
        certified += 1
    return certified


@pytest.mark.fuzz(cases=120, slow=10_000)
def test_every_rate_is_decided_as_by_exact_cells(rng, cases):
    assert decided(rng, cases) > cases / 2
