"""The study of surge, sway and yaw rate: a linear boat is fitted exactly, and errors and bounds are those by hand."""

from fractions import Fraction

import numpy as np
import pytest
import torch
import vector
from vector import Boat, above, errors, joint, least_squares, padded, separate, simulated_by

from usvlearn import Inputs, VectorSample
from usvlearn.core.samples import tree_map

R = np.array([[0.9, 0.05, 0.0], [0.1, 0.7, -0.1], [0.0, 0.1, 0.8]])
B = np.array([[0.1, 0.1], [0.02, -0.02], [0.1, -0.1]])


def runs(seed: int, steps: int, count: int) -> VectorSample:
    """Of a linear boat without noise."""
    rng = np.random.default_rng(seed)
    commands, x = rng.uniform(-1, 1, (steps, count, 2)), np.zeros((steps, count, 3))
    for k in range(1, steps):
        x[k] = x[k - 1] @ R.T + commands[k] @ B.T
    dt = np.where(np.arange(steps) == 0, 0.0, 0.2)[:, None] * np.ones((1, count))
    inputs = Inputs(commands[..., 0], commands[..., 1], 0 * dt, 0 * dt, dt)
    return tree_map(torch.from_numpy, VectorSample(inputs, x, dt >= 0, np.ones(x.shape, bool)))


@pytest.fixture(scope="module")
def boat():
    learned, tuning, reported = runs(0, 60, 1), runs(1, 20, 2), runs(2, 20, 2)
    return Boat("linear", (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), 1, learned, tuning, reported, reported.velocity)


def test_a_joint_fit_of_a_linear_boat_is_exact_and_one_of_each_axis_is_not(boat):
    for kind in ("joint", "products"):
        free, one = least_squares(boat, kind)
        assert free.mae.max() < 1e-9 and one.max() < 1e-9
    free, one = least_squares(boat, "axis")
    assert free.mae[1] > 1e-3 and one[1] > 1e-3


def test_persistence_keeps_the_first_velocity(boat):
    free, one = simulated_by(boat, lambda x, u: x)
    x = boat.reported.velocity
    torch.testing.assert_close(free.mae, (x[1:] - x[0]).abs().mean((0, 1)))
    torch.testing.assert_close(free.rmse, (x[1:] - x[0]).square().mean((0, 1)).sqrt())
    torch.testing.assert_close(one, (x[1:] - x[:-1]).abs().mean((0, 1)))


@pytest.mark.thorough
def test_networks_of_all_seeds_and_axes_have_errors(boat):
    start = simulated_by(boat, lambda x, u: x)[0].mae
    for study in (joint, separate):
        free, one, state, _ = study(boat, {"kept": 20, "window": 3, "windows": 2}, 2)
        assert free.mae.shape == free.rmse.shape == one.shape == (2, 3)
        assert (free.mae < 1.5 * start).all() and (one < free.mae).all()
        assert vector.largest_rate(state, None) <= Fraction(vector.KAPPA)


def test_shorter_runs_count_only_where_they_are():
    one = tree_map(lambda x: x[:, 0].numpy(), runs(3, 9, 1))
    both = padded([one, tree_map(lambda x: x[:4], one)])
    assert both.fresh.sum(0).tolist() == [9, 4] and both.velocity[4:, 1].isnan().all()
    predicted = torch.zeros(9, 2, 3, dtype=torch.float64)
    found = errors(predicted, torch.where(both.measured, both.velocity, torch.nan))
    x = torch.from_numpy(one.velocity)
    torch.testing.assert_close(found.mae, torch.cat([x, x[:4]]).abs().mean(0))


def test_a_bound_is_rounded_up():
    assert above(Fraction(99901, 100000)) == "≤ 0.9991" and above(Fraction(1, 2)) == "≤ 0.5000"
