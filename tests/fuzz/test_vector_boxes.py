"""Boxes of small networks with a vector state: decided as by exact cells, and above every point and pair of points."""

from fractions import Fraction

import numpy as np
import pytest

from certify.networks.vector import RELU, activation
from certify.proofs.box_planes import Box
from certify.proofs.vector_box_proof import bound, proves
from certify.proofs.vector_points import norm_at
from certify.search.vector_box import certify, rate
from tests.support.exact_cells import exact_norm
from tests.support.networks import SCALING, greatest_ratio, vector_network


@pytest.mark.fuzz(cases=24, slow=600)
def test_one_hidden_layer_is_decided_as_by_exact_cells(rng, cases):
    """Gaussian networks are decided; where planes coincide or meet in a point the bracket holds the truth."""
    closed = 0
    for k in range(cases):
        q, m, phi = 1 + k % 2, k // 2 % 2, RELU if k % 3 else activation("leaky:1/4")
        weights = vector_network(rng, q, m, int(rng.integers(1, 5)), integer=k % 4 == 3)
        box, norm = Box(-np.ones(q + m), np.ones(q + m)), ("inf", "one")[k // 4 % 2]
        scaling = SCALING if q == 2 and k % 5 == 0 else None
        truth = exact_norm(weights, phi, box, norm, scaling)
        found = rate(weights, phi, box, norm, scaling, gap=1e-6, seconds=3.0)
        assert (
            found.lower <= truth <= found.upper
            and greatest_ratio(weights, phi, box, norm, scaling, rng) <= truth + 1e-6
        )
        proved = bound(weights, phi, box, found.tree, norm, scaling)
        assert truth <= proved <= Fraction(found.upper)
        if not truth:
            continue
        above, below = float(truth) * (1 + 1e-6), float(truth) * (1 - 1e-6)
        verdict = certify(weights, phi, box, above, norm, scaling, 3.0)
        assert verdict.verdict in ("certified", "unknown") and verdict.lower <= truth <= verdict.upper
        if verdict.verdict == "certified":
            assert proves(weights, phi, box, verdict.tree, above, norm, scaling)
            assert not proves(weights, phi, box, verdict.tree, truth, norm, scaling)
            closed += 1
        verdict = certify(weights, phi, box, below, norm, scaling, 3.0)
        assert verdict.verdict == "refuted" or k % 4 == 3
        if verdict.verdict == "refuted":
            point = np.r_[verdict.witness.x, verdict.witness.u]
            assert (box.lo <= point).all() and (point <= box.hi).all()
            assert norm_at(weights, phi, point, norm, scaling) >= Fraction(below)
    assert closed > 0.7 * cases


@pytest.mark.fuzz(cases=12, slow=400)
def test_tanh_and_two_layers_are_bounded_and_no_point_exceeds_the_bound(rng, cases):
    certified = 0
    for k in range(cases):
        name, last = [("tanh", 0), ("tanh", 3), ("relu", 3), ("leaky:0.1", 3)][k % 4]
        q, m, phi, norm = 1 + k // 4 % 3, int(rng.integers(0, 2)), activation(name), ("inf", "one")[k // 2 % 2]
        weights = vector_network(rng, q, m, 4, last)
        lo = np.round(rng.uniform(-1, 0, q + m), 1)
        box = Box(lo, lo + rng.choice([0.25, 1.0], q + m))
        scaling = SCALING if q == 2 else None
        found = rate(weights, phi, box, norm, scaling, gap=0.01, seconds=2.0)
        assert found.lower <= found.upper
        assert greatest_ratio(weights, phi, box, norm, scaling, rng) <= found.upper + 1e-6
        for point in rng.uniform(box.lo, box.hi, (5, q + m)):
            seen = norm_at(weights, phi, point, norm, scaling)
            assert seen is None or seen <= Fraction(found.upper)
        if found.upper:
            verdict = certify(weights, phi, box, found.upper * 1.001, norm, scaling, 2.0)
            assert verdict.verdict == "certified"
            assert not proves(weights, phi, box, verdict.tree, Fraction(found.lower), norm, scaling)
            certified += 1
        if found.lower:
            assert certify(weights, phi, box, found.lower * 0.999, norm, scaling, 2.0).verdict == "refuted"
    assert certified > 0.8 * cases
