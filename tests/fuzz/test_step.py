"""`Online.step` with anything in any field: a TypeError that names the field, or a step to a finite state."""

import datetime
import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from tests.support import at
from tests.support.configured import default_ensemble
from usvlearn import AID, Ensemble, Inputs, Online, Persistence, Sample, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.errors import ShapeError

FIELDS = (*Inputs._fields, "surge", "fresh", "measured")
NUMBERS = (
    0, 1, -1, 0.5, -0.5, 2.5, 9.99, 10.0, 31.0, 99.0, 100.0, 1e3, 1e4, 1e9, 1e38, 1e300, 5e-324, 10**30, math.nan,
    math.inf, -math.inf, np.float32(0.5), np.float64(0.5), np.int8(-3), np.uint64(2**63), np.array(0.5),
    np.array([0.5]), [0.5], torch.tensor(0.5), torch.tensor([1], dtype=torch.int32), Fraction(1, 2), True,
)  # fmt: skip
BOOLS = (True, False, 1, 0, np.True_, np.False_, np.int64(1), np.array(True), torch.tensor(False))
FLOATS = (0.0, 1.0, math.nan, np.float64(1.0), np.array(1.0), torch.tensor(1.0))  # which are no bools
NEITHER = (
    "0.5", "false", "", b"1", None, 1j, np.complex64(1), object(), {}, [], {"a": 1}, datetime.timedelta(1), "nan",
    np.array("0.5"), np.array(["0.5"]), np.datetime64(1, "s"), np.array(None), torch.tensor(1j), np.ones(3), [0.1, "x"],
    float, 10**400, np.ma.masked,
)  # fmt: skip
BOATS = {
    "kernel": lambda: Online(Ensemble({"aid": AID(28.0), "persistence": Persistence()})),
    "torch": lambda: Online(Ensemble({"aid": AID(28.0), "persistence": Persistence()}), backend="torch"),
    "batch": lambda: Online(AID(28.0), (2,)),
}


def draw(rng, values):
    return values[rng.integers(len(values))]


def sample_of(values) -> Sample:
    return Sample(Inputs(*values[:5]), *values[5:])


@pytest.mark.fuzz(cases=400, slow=20_000)
@pytest.mark.parametrize("kind", BOATS)
def test_step_takes_numbers_and_bools_alone(rng, cases, kind):
    boat, refused = BOATS[kind](), 0
    before = dict(named_leaves(boat.state))
    for _ in range(cases):
        values = [0.5, 0.4, 0.1, 0.02, 0.4, 1.0, True, True]
        wrong = set()
        for place in rng.choice(8, rng.integers(1, 4), replace=False):
            right = BOOLS if place >= 6 else NUMBERS
            bad = NEITHER if place < 6 else (*NEITHER, *FLOATS)
            if rng.random() < 0.4:
                wrong.add(FIELDS[place])
                values[place] = draw(rng, bad)
            else:
                values[place] = draw(rng, right)
        if wrong:
            refused += 1
            with pytest.raises((TypeError, ShapeError)) as caught:
                boat.step(sample_of(values))
            assert str(caught.value).partition(":")[0] in wrong
            for name, leaf in named_leaves(boat.state):
                assert np.array_equal(leaf, before[name], equal_nan=True), name
        else:
            boat.step(sample_of(values))
            before = {name: np.asarray(leaf).copy() for name, leaf in named_leaves(boat.state)}
            assert (before.get("halfwidths", np.zeros(1)) >= 0).all()  # infinite before ten errors
            assert all(name == "halfwidths" or np.isfinite(leaf).all() for name, leaf in before.items())
    assert 0.2 * cases < refused < 0.9 * cases


@pytest.mark.fuzz(cases=3000, slow=300_000)
@pytest.mark.parametrize(
    ("dtype", "single"),
    [(torch.float64, True), (torch.float64, False), pytest.param(torch.float32, False, marks=pytest.mark.thorough)],
    ids=["single", "rollout", "float32"],
)
def test_no_samples_make_the_default_ensemble_remember_what_is_not_finite(rng, cases, dtype, single):
    """Stretches of constant and of random samples, each field at times at its bounds, beyond them, or absent."""
    ensemble, finite = default_ensemble(dtype), 0
    state, boat = ensemble.init(), Online(ensemble) if single else None
    for first in range(0, cases, 100):
        samples = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, stretch(rng, 100))
        if boat:
            predictions, state = [boat.step(at(samples, k)) for k in range(100)], boat.state
        else:
            with torch.no_grad():
                state, predictions, _ = rollout(ensemble, state, samples)
        finite += int(np.isfinite(np.asarray(predictions)).sum())
        for name, leaf in named_leaves(state):
            assert name == "predictions" or np.isfinite(np.asarray(leaf)).all(), (first, name)
    assert finite > 0.5 * cases


def stretch(rng, steps) -> Sample:
    """Samples that stay as they are for a while, some with a fault."""
    fields = np.empty((6, steps))
    begin = 0
    while begin < steps:
        bounds = rng.choice([0.0, 1.0, 1.0, 99.99], 3)
        commands, yaw_rate = rng.uniform(-1, 1, 2) * bounds[0], rng.uniform(-1, 1) * bounds[1]
        surge = rng.uniform(-1, 1) * rng.choice([1.0, 3.0, 10.0, bounds[2]])
        still = [*commands, rng.uniform(-7, 7), yaw_rate, rng.choice([0.05, 0.4, 0.4, 5.0, 9999.0]), surge]
        length = int(rng.choice([1, 5, 50, 100]))
        noise = rng.choice([0.0, 0.0, 1e-6, 0.05]) * rng.standard_normal(fields[:, begin : begin + length].shape)
        fields[:, begin : begin + length] = np.array(still)[:, None] + noise
        begin += length
    fields[4] = np.abs(fields[4])
    struck = rng.random(fields.shape) < 0.01
    fields[struck] = rng.choice([math.nan, math.inf, -1e300, 1e300, 0.0, 99.99, 30.0, -50.0], struck.sum())
    fresh = rng.random(steps) < 0.97
    arrays = Inputs(*fields[:5]), fields[5], fresh, fresh & (rng.random(steps) < 0.9)
    return tree_map(torch.as_tensor, Sample(*arrays))


@pytest.mark.thorough
@pytest.mark.parametrize("speed", [11.0, 20.0, 31.0, 50.0, 99.0, -50.0, 1e6])
def test_a_speed_that_is_stuck_beyond_all_measure_is_not_learned(speed):
    boat = Online(default_ensemble(torch.float64))
    inputs = Inputs(0.6, 0.6, 0.3, 0.0, 0.4)
    boat.step(Sample(inputs._replace(dt=0.0), 0.9, True, True))
    for _ in range(200):
        boat.step(Sample(inputs, 0.9, True, True))
    stuck = [boat.step(Sample(inputs, speed, True, True)) for _ in range(500)]
    assert np.abs(np.array(stuck) - 0.9).max() < 0.3
    assert boat.step(Sample(inputs, 0.9, True, True)) == pytest.approx(0.9, abs=0.3)
