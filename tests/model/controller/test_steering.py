"""Steering: its plant is the fitted boat, its loops keep their margins, its laws are the autopilots'."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.fitted_boats import TOP
from tests.support.known_boats import known_boat
from tests.support.turning_boat import TRUE, sailed
from usvlearn.estimators.axis.turning_intervals import HARDLY
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.model.controller.closed_loop import Cascade, CascadeLaw, MoosYaw, MoosYawLaw
from usvlearn.model.controller.gains import GAIN, PHASE, margins
from usvlearn.model.controller.steering import Turns, lawn_mower, parts, steering, trials, turning_step, yaw_of
from usvlearn.model.fit import turning_kernel as at
from usvlearn.model.fit.boat import FittedBoat, Turning
from usvlearn.model.fit.turning import DEVIATION, MEAN, POSITIVE, explained, natural, prepared, rate

THETA = MEAN.copy()
THETA[[*TRUE]] = [np.log(x) if j in POSITIVE else x for j, x in TRUE.items()]
THETA[at.LOSS] = THETA[at.RUDDER] = 0.0
SPEEDS, COMMANDS = np.linspace(0.5, 2.0, 5), np.linspace(0.2, 0.7, 5)


def fitted_boat(spread: float = 0.02, theta: np.ndarray = THETA, **changes) -> FittedBoat:
    turning = Turning(theta, np.diag((spread * DEVIATION) ** 2), 0.95)._replace(**changes)
    top = {"steady_speed_full": Quantity(2.4, 2.3, 2.5, "m/s")}
    return FittedBoat(
        top, "", "", (), 28.0, np.zeros(1), np.zeros(1), np.zeros((1, 1)), top=TOP, turning=turning
    )  # fmt: skip


def designed(boat=None, period=0.1):
    return steering(fitted_boat() if boat is None else boat, SPEEDS, COMMANDS, 1.25, 0.05, period, 50)


def test_gain_and_time_constant_are_those_of_the_plant():
    yaw, p = yaw_of(fitted_boat(), SPEEDS, COMMANDS), natural(THETA)[:, None]
    for k in (0, 2, 4):
        boat = Turns(p, SPEEDS[k] / TOP, COMMANDS[k])
        x = np.zeros((4, 1))
        rates = []
        for steer in (0.0, 0.01):
            for _ in range(400):
                x = turning_step(boat, x, np.array([steer]), 0.05)
            rates.append(float(x[1, 0]))
        expected = rate(p[:, 0], COMMANDS[k] + 0.01, COMMANDS[k] - 0.01, np.array(SPEEDS[k] / TOP))
        assert rates[1] == pytest.approx(float(expected), rel=1e-6)
    assert (yaw.gain.low < yaw.gain.value).all() and (yaw.gain.value < yaw.gain.high).all()
    np.testing.assert_allclose(yaw.time_constant.value, 1 / (TRUE[at.D0] + TRUE[at.D2] * SPEEDS / TOP))


def test_all_corners_keep_their_margins():
    steer = designed()
    cascade = steer.cascade
    gains = SimpleNamespace(proportional=cascade.proportional, integral=cascade.integral)
    assert margins(gains, *steer.yaw.corners, steer.delay).gain >= GAIN - 1e-6
    assert steer.margins.phase >= PHASE - 1e-6 and steer.heading.phase >= 60 and steer.heading.gain >= 6
    assert designed(period=0.5).cascade.angle < cascade.angle


@pytest.mark.parametrize(
    ("boat", "said"),
    [
        (known_boat().identified, "usvlearn fit RUN"),
        (replace(fitted_boat(), turning=None, lacks=(HARDLY,)), "hardly turned"),
        (replace(fitted_boat(), turning=None), "run usvlearn fit RUN again"),
        (fitted_boat(explained=0.2), "explain 20 % of the turns"),
        (fitted_boat(spread=1.0), "too uncertain for gains"),
    ],
)
def test_an_unknown_turning_gets_a_sentence(boat, said):
    steer = designed(boat)
    assert said in steer and list(parts(steer, [])) == [f"Steering: no gains. {steer}"]


def test_the_commands_explain_the_turns_that_they_make_and_no_others():
    rows = prepared(sailed(steps=1500, gyro=True), TOP)
    fit = SimpleNamespace(theta=THETA)
    other = rows.copy()
    other[:, [0, 1]] = other[::-1, [0, 1]]
    assert explained(fit, [rows]) > 0.9 and explained(fit, [other]) < 0.5 and explained(fit, []) == 0.0


def test_ardurover_limits_the_rate_and_its_integral_stops():
    law = CascadeLaw(Cascade(0.5, 0.2, 0.1, 2.0, 0.3, 0.5), 0.1, 0.4)
    law.start(1)
    outs = [float(law.command(1.0, np.zeros((2, 1)))[0]) for _ in range(9)]
    assert outs[0] == pytest.approx((0.5 + 0.2) * 0.05 + 0.1 * 0.05 * 0.1)  # 0.5 rad/s² of 0.1 s
    assert law.turn[0] == pytest.approx(0.3)
    law.auto = 1.0
    law.command(1.1, np.array([[1.1], [0.0]]))
    assert law.turn[0] == pytest.approx(0.3)  # 1 rad/s of the path, limited


def test_the_heading_of_pmarinepid_is_a_pid_in_degrees():
    law = MoosYawLaw(MoosYaw(1.0, 0.5, 0.1, 5.0), 10)
    law.start(1)
    out = float(law.command(np.radians(10.0), np.zeros((2, 1)))[0])
    assert out == pytest.approx((10.0 + 0.1 * 10 * 0.1) / 100)
    out = float(law.command(np.radians(10.0), np.radians([[1.0], [0.0]]))[0])
    assert out == pytest.approx((9.0 - 0.5 * 10 + 0.1 * (10 + 9) * 0.1) / 100)


def test_px4_slews_the_wanted_heading():
    law = CascadeLaw(Cascade(0.5, 0.2, 0.0, 2.0, 0.3, 9.0), 0.1, 0.4, px4=True)
    law.start(1)
    law.command(1.0, np.zeros((2, 1)))
    assert law.goal[0] == pytest.approx(0.03) and law.turn[0] == pytest.approx(0.06)


def test_a_lawn_mower_comes_back():
    course = lawn_mower(0.2, 5.0, 0.1)
    assert course[0] == 0 and course[-1] == pytest.approx(np.pi) and np.abs(np.diff(course)).max() < 0.03


@pytest.mark.thorough
def test_designed_gains_beat_the_defaults_on_drawn_boats():
    steer = designed()
    tried = {(each.autopilot, each.gains): each for each in trials(steer, 0.05, 0.1, 50, 0)}
    rover, defaults = (tried["ArduRover", name] for name in ("designed", "defaults"))
    assert (rover.rms < 0.7 * defaults.rms).all() and not any(each.step.sways.any() for each in tried.values())
    assert "QuickTune" in "".join(map(str, parts(steer, [*tried.values()])))
