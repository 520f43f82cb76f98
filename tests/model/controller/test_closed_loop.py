"""Boats in the closed loop move as the model does, autopilots do what their sources say, and instability is seen."""

import numpy as np
import pytest

from tests.support.known_boats import known_boat
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.quantities import Ahead
from usvlearn.model.controller.closed_loop import Moos, MoosLaw, Rover, RoverLaw, ahead_step, draws, simulate, steps_of
from usvlearn.model.controller.design import Wanted, controller, facts, parts

ROVER = Rover(1.5, 45, 0.3, 0.2, 0.1, 10.0, 10.0)


def test_a_step_is_that_of_the_model():
    boat, rng = known_boat(), np.random.default_rng(0)
    v, xi = rng.uniform(0, 3, 500), rng.uniform(0, 1, 500)
    np.testing.assert_allclose(
        ahead_step(boat.model.ahead, v, xi, 0.05), boat.model.step(v, xi, xi, 0.0, 0.05), rtol=0, atol=1e-12
    )


def test_a_late_command_acts_later_by_its_delay():
    theta = np.stack([known_boat().identified.theta] * 2)
    result = simulate(Ahead(theta), np.array([0.0, 0.6]), RoverLaw(ROVER, 0.2), [1.0], 4.0)
    first = [float(result.time[np.flatnonzero(result.speed[:, k] > 0)[0]]) for k in range(2)]
    assert first[1] - first[0] == pytest.approx(0.6)


def test_ardurover_adds_base_and_pid_and_its_integral_stops():
    law = RoverLaw(ROVER, 0.1)
    law.start(1)
    out = [float(law.command(1.0, np.array([0.8]))[0]) for _ in range(100)]
    assert out[0] == pytest.approx(0.45 / 1.5 + 0.3 * 0.2 + 0.2 * 0.2 * 0.1)
    assert out[-1] == pytest.approx(0.45 / 1.5 + 0.3 * 0.2 + 0.1)  # ATC_SPEED_IMAX
    limited = RoverLaw(ROVER, 0.1)
    limited.start(1)
    for _ in range(50):
        limited.command(3.0, np.array([0.0]))  # more than full throttle
    assert limited.integral[0] == pytest.approx(0.2 * 3.0 * 0.1)  # of the first iteration, before the limit was reached


def test_the_moos_block_sums_up_to_the_gains():
    """A PI controller's output for a constant error after n iterations: k_p e + k_i e t."""
    moos = Moos.of(proportional=0.3, integral=0.2, slope=0.3, period=0.45)
    law = MoosLaw(moos)
    law.start(1)
    for _ in range(10):
        law.command(1.0, np.array([1.0]))  # no error before the step
    for _ in range(40):
        out = float(law.command(1.4, np.array([1.0]))[0])
    assert moos.tick == 20 and out == pytest.approx(0.3 * 0.4 + 0.2 * 0.4 * 40 / 20)


@pytest.mark.thorough
def test_two_hundred_boats_settle_and_none_is_unstable():
    design = controller(known_boat())
    for steps in design.loops.values():
        for step in steps:
            assert len(step.settled) == 200
            assert not step.sways.any() and np.isfinite(step.settled).all()
            assert np.quantile(step.overshoot, 0.95) < 0.4
    assert max(np.quantile(step.overshoot, 0.95) for step in design.loops["MOOS-IvP"]) < 0.15


@pytest.mark.thorough
def test_gains_beyond_the_margins_are_seen_to_be_unstable():
    design = controller(known_boat(), Wanted(boats=50))
    times = 1.5 * 10 ** (design.margins.gain / 20)
    loud = design.rover._replace(proportional=times * design.rover.proportional, integral=times * design.rover.integral)
    theta = draws(design.boat.identified, 50)
    course = [design.speeds[0], design.speeds[4], design.speeds[-1]]
    responses = simulate(
        Ahead(theta), np.full(50, design.late + design.period), RoverLaw(loud, design.period), course, 30.0
    )
    assert any(step.sways.any() for step in steps_of(responses))


@pytest.mark.thorough
def test_the_default_follows_the_options():
    slow = controller(
        known_boat(), Wanted(boats=10, speed=1.2, range=(0.8, 1.6), bandwidth=0.5, damping=1.2, delay=0.3)
    )
    assert (slow.gains.bandwidth, slow.gains.damping, slow.late) == (0.5, 1.2, 0.3)
    assert slow.rover.cruise_speed == 1.2 and slow.speeds[[0, -1]].tolist() == [0.8, 1.6]
    assert facts(slow)["closed_loop"]["ArduRover"][0]["boats"] == 10


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        (Wanted(period=0.0), "--period: found 0"),
        (Wanted(boats=1), "--boats: found 1"),
        (Wanted(period=1e-9), "--period: found 1e-09, expected 0.01 to 2"),
        (Wanted(bandwidth=1e-9), "--bandwidth: found 1e-09"),
        (Wanted(delay=1e300), "--delay: found 1e.300, expected 0 to 10 s"),
        (Wanted(seed=-1), "--seed: found -1"),
        (Wanted(range=(0.5, 0.5000001)), "--range: found 0.5 0.5"),
        (Wanted(delay=-1.0), "--delay: found -1"),
        (Wanted(range=(1.5, 1.0)), "--range: found 1.5 1"),
        (Wanted(speed=9.0), "--speed: found 9 m/s"),
    ],
)
def test_a_wrong_option_is_named(wanted, said):
    with pytest.raises(ConfigError, match=said):
        controller(known_boat(), wanted)


@pytest.mark.thorough
def test_a_range_that_slow_boats_do_not_reach_is_told():
    boat = known_boat()
    top = float(boat.model.ahead.steady_speed(1.0))
    texts = [list(parts(controller(boat, Wanted(boats=20, range=(0.8, high))))) for high in (0.6 * top, 0.99 * top)]
    assert ["slowest boats" in "".join(map(str, each)) for each in texts] == [False, True]


@pytest.mark.thorough
def test_a_set_that_does_not_tell_its_step_asks_for_the_delay():
    with pytest.raises(ConfigError, match="give --delay"):
        controller(known_boat()._replace(setup=None))
    assert controller(known_boat()._replace(setup=None), Wanted(delay=0.2, boats=5)).late == 0.2
