"""The command that holds a speed is the inverse of the identified curve, or one sentence says why there is none."""

import numpy as np
import pytest

from tests.support.known_boats import known_boat
from usvlearn.errors import ConfigError
from usvlearn.model.controller.gains import Feedforward


def of(**options) -> Feedforward:
    boat = known_boat(**options)
    return Feedforward.of(boat.name, boat.found)


def test_the_command_holds_the_speed_in_a_simulation():
    boat, forward = known_boat(), of()
    for speed in (0.4, 1.0, 1.9):
        command = float(forward.at(speed))
        course = boat.model.simulate(0.0, np.full(300, command), command, 0.0, 0.2)
        assert course[-1] == pytest.approx(speed, abs=2e-3)


def test_the_band_holds_the_commands_of_nine_boats_in_ten():
    boat, forward = known_boat(), of()
    low, high = forward.band(1.2)
    assert low < forward.at(1.2) < high
    rng, inside = np.random.default_rng(1), 0
    for _ in range(300):
        theta = rng.multivariate_normal(boat.found.theta, boat.found.covariance)
        model = type(boat.model).of(boat.found, theta)
        commands = np.linspace(0.2, 0.8, 601)
        inside += low <= float(np.interp(1.2, model.ahead.steady_speed(commands), commands)) <= high
    assert 0.85 < inside / 300 < 0.95


def test_a_dead_band_has_a_lowest_speed():
    dead = of(thrust_linear_left=-0.2, thrust_linear_right=-0.2)
    speed, command = dead.least
    assert 0.1 < command < 0.3 and 0 < speed < 0.1
    with pytest.raises(ConfigError, match=rf"--speed: found 0\.001 m/s, .*lowest speed.* {speed:.2f} m/s, at"):
        dead.check("heron", "--speed", 0.001)


def test_a_slight_fall_at_full_command_is_saturation_and_a_deep_one_is_refused():
    bent = of(thrust_cubic_left=-1.25, thrust_cubic_right=-1.25)
    assert bent.command[-1] < 1 and (np.diff(bent.speed) > 0).all()
    with pytest.raises(ConfigError, match=r"heron: the steady speed does not rise .* at \d+ %.*: sail straight ahead"):
        of(thrust_cubic_left=-1.7, thrust_cubic_right=-1.7)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"vague": True, "lacks": ["The speed hardly changed."]}, r"not identified.*The speed hardly changed.*sail "),
        ({"drag_linear": 0.0, "drag_quadratic": 0.0, "thrust_speed_left": 0.0, "thrust_speed_right": 0.0}, "no steady"),
        ({"thrust_quadratic_left": -2.0, "thrust_quadratic_right": -2.0}, "no steady speed ahead.*check the signs"),
    ],
)
def test_a_boat_without_a_curve_is_told_what_to_sail(options, said):
    with pytest.raises(ConfigError, match=said):
        of(**options)


def test_a_speed_beyond_full_command_is_refused():
    with pytest.raises(ConfigError, match=r"--speed: found 9 m/s, and heron reaches .* at full command"):
        of().check("heron", "--speed", 9.0)
