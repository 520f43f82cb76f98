"""What surge data alone tell and what they do not, and the mass from a known quantity."""

import pytest
import torch

from tests.support import at, random_samples
from usvlearn import AID, RLS, Inputs, Sample, SurgeDynamics, rollout
from usvlearn.estimators.mass import recover_mass
from usvlearn.estimators.regressors.layer import surge_regressor

MASS = 28.0
THETA = torch.tensor([-3.0, -12.0, -8.0, 15.0, 20.0, -3.0, 12.0, 18.0, -2.0], dtype=torch.float64)
PULL = {"thrust_linear_left + thrust_quadratic_left": 35.0, "thrust_linear_right + thrust_quadratic_right": 30.0}
NAMES = SurgeDynamics(MASS).names
FORGETTING = 1 - 1e-12  # remembers all


def boat(steps: int, *batch: int, mass: float = MASS, theta=THETA, noise: float = 0.0, astern: float = 0.0) -> Sample:
    """A boat at sea: commands that change every 2 s; white noise in the speed that is measured, m/s."""
    inputs = random_samples(steps, *batch).inputs
    held = torch.arange(steps) // 5 * 5
    left, right = ((1 + astern) * x[held] - astern for x in (inputs.command_left, inputs.command_right))
    inputs = inputs._replace(command_left=left, command_right=right)
    speeds, v = [], torch.zeros(batch, dtype=torch.float64)
    for k in range(steps):
        v = v + 0.4 / mass * (surge_regressor(v, at(inputs, k)) @ theta)
        speeds.append(v)
    surge = torch.stack(speeds)
    generator = torch.Generator().manual_seed(0)
    surge = surge + noise * torch.randn(surge.shape, generator=generator, dtype=torch.float64)
    yes = torch.ones(steps, *batch, dtype=torch.bool)
    return Sample(inputs, surge, yes, yes)


@torch.no_grad()
def identified(samples: Sample, guess: float = 50.0) -> torch.Tensor:
    """η by least squares in the unit of a guessed mass."""
    rls = RLS(SurgeDynamics(guess), forgetting=FORGETTING, covariance=1e6)
    end, _, _ = rollout(rls, rls.init(samples.surge.shape[1:]), samples)
    return end.theta / guess


def test_a_boat_twice_as_heavy_and_strong_gives_the_same_data():
    """(m, θ) and (2m, 2θ): no estimator can tell them apart without a known quantity."""
    one, two = boat(300), boat(300, mass=2 * MASS, theta=2 * THETA)
    assert torch.equal(one.surge, two.surge)
    per_mass = identified(one)
    torch.testing.assert_close(per_mass, THETA / MASS, rtol=1e-4, atol=1e-4)
    half, double = (recover_mass(per_mass, {"thrust_quadratic_left": d}, NAMES) for d in (20.0, 40.0))
    torch.testing.assert_close([2 * each for each in half], list(double))


@pytest.mark.parametrize(
    ("left", "right", "speed", "rank"),
    [
        ("free", "free", "free", 9),
        ("free", "left", "free", 6),  # both commands always together: left cannot be told from right
        ("free", "free", "one", 5),  # one speed: c_q and c_l, and all that goes with speed, are one
        ("one", "one", "free", 4),  # one command: all thrust is a constant and a linear drag
    ],
)
def test_what_the_data_excite_is_what_can_be_told(left, right, speed, rank):
    """The rank of W over a hundred samples, as the module's docstring says."""
    generator = torch.Generator().manual_seed(0)

    def draw(kind: str) -> torch.Tensor:
        return torch.full((100,), 0.7).double() if kind == "one" else torch.rand(100, generator=generator).double()

    xi = draw(left)
    inputs = Inputs(xi, xi if right == "left" else draw(right), 0 * xi, 0.5 * draw(speed), 0 * xi + 0.4)
    v = draw(speed)
    assert torch.linalg.matrix_rank(surge_regressor(v, inputs), rtol=1e-10) == rank


def test_mass_of_a_boat_whose_bollard_pull_is_known():
    """Sixteen boats measured for 20 min with noise of 0.5 cm/s: within 1 %."""
    mass, parameters = recover_mass(identified(boat(3000, 16, noise=0.005)), PULL, NAMES)
    assert ((mass - MASS).abs() < 0.01 * MASS).all()
    pulls = parameters[..., 3] + parameters[..., 4]
    assert ((pulls - 35.0).abs() < 0.35).all()


def test_aid_identifies_the_mass_where_a_thrust_is_known():
    """The left pull alone, a first guess that is wrong by far, 40 min ahead and astern: AID is slow but gets there."""
    aid, samples = AID(mass=50.0, gain=10.0, known=dict([next(iter(PULL.items()))])), boat(6000, astern=0.6)
    assert aid.monitor(aid.init())["mass"].isnan()  # nothing was seen yet
    end, _, _ = rollout(aid, aid.init(), samples)
    numbers = aid.monitor(end)
    assert abs(numbers["mass"] - MASS) < 0.05 * MASS
    assert abs(numbers["thrust_linear_left"] + numbers["thrust_quadratic_left"] - 35.0) < 1e-9
    assert abs(numbers["thrust_linear_right"] + numbers["thrust_quadratic_right"] - 30.0) < 1.5


def test_a_first_guess_of_the_mass_scales_the_parameters_and_nothing_else():
    samples = random_samples(100)
    light, heavy = AID(10.0), AID(100.0)
    one, v1, _ = rollout(light, light.init(), samples)
    ten, v10, _ = rollout(heavy, heavy.init(), samples)
    torch.testing.assert_close(v1, v10)
    torch.testing.assert_close(10 * one.theta, ten.theta)


def test_what_is_not_seen_yet_is_nan_and_spoils_no_other_boat():
    per_mass = torch.stack([THETA / MASS, 0 * THETA, -THETA / MASS, 1e-9 * THETA]).float()
    mass, parameters = recover_mass(per_mass, PULL, NAMES)
    assert mass.dtype == torch.float32
    torch.testing.assert_close(mass[0], torch.tensor(MASS))
    assert mass[1:].isnan().all() and parameters[1:].isnan().all()
