"""The offset of the compass, the current and the dead zone of a fit, and where they are not known."""

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP
from tests.support.turning_boat import TRUE, sailed
from usvlearn.core.prepared_samples import COS, LEARN, LEFT, MODE, PREDICT, RIGHT, ROW, SIN, SURGE, YAW_RATE
from usvlearn.core.samples import Inputs, Sample
from usvlearn.logs.channels.channel import Channel
from usvlearn.logs.channels.poses import poses
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.ground import CIRCLES, FEW_COURSES, NO_GROUND, with_ground
from usvlearn.model.fit.logs import ACROSS, ALONG, over_ground
from usvlearn.model.fit.turning import NO_DEAD
from usvlearn.model.fit.turning_kernel import HEADING, LAG

OFFSET, CURRENT = np.radians(5.0), np.array([0.2, -0.15])  # rad; m/s north and east


@pytest.fixture(scope="module")
def plain() -> FittedBoat:
    rows = sailed(steps=1800)
    return fit_boat("a", {"1": rows}, MASS, TOP, "nine").identified


def drifting(seed: int, course: float | None = None, offset: float = OFFSET) -> np.ndarray:
    """A mission with its velocity over ground, measured beside a compass that shows too much."""
    rows, rng = sailed(seed, 4500), np.random.default_rng(seed)
    psi = rows[:, HEADING] if course is None else np.full(len(rows), course)
    c, s, w = np.cos(psi), np.sin(psi), rows[:, SURGE]
    north, east = np.stack([w * c, w * s], 0) + CURRENT[:, None] + 0.04 * rng.standard_normal((2, len(rows)))
    measured = psi + offset
    rows[:, COS], rows[:, SIN] = np.cos(measured), np.sin(measured)
    along = north * rows[:, COS] + east * rows[:, SIN], east * rows[:, COS] - north * rows[:, SIN]
    return np.column_stack([rows, *along])


def test_offset_and_current_are_found_with_intervals_that_hold(plain):
    missions = {f"{k}": drifting(k) for k in range(3)}
    boat = with_ground(plain, missions)
    offset, current = boat["compass_offset"], boat["current"]
    assert offset.low < 5.0 < offset.high and offset.value == pytest.approx(5.0, abs=0.3) and offset.unit == "deg"
    assert current.low < 0.25 < current.high and current.value == pytest.approx(0.25, abs=0.01)
    for name in ("compass_offset", "current", "dead_zone", "thrust_lag"):
        assert boat[name] == FittedBoat.read(boat.facts())[name]


def test_without_ground_or_on_one_course_nothing_is_told(plain):
    for rows, said in ((sailed(), NO_GROUND), (sailed()[:, :ROW], NO_GROUND), (drifting(0, 0.4), FEW_COURSES),
                       (drifting(0)[:3000], FEW_COURSES)):  # fmt: skip
        boat = with_ground(plain, {"1": rows})
        assert np.isnan([boat[name].value for name in ("compass_offset", "current")]).all() and boat.lacks[-1] == said
    straight = drifting(1)
    straight[:, [SIN, COS]] = 0.0, 1.0  # its own current is not known; that of another mission is
    assert with_ground(plain, {"1": drifting(0), "2": straight})["current"].value == pytest.approx(0.25, abs=0.01)


def test_a_slow_receiver_makes_no_log_short(plain):
    rows = drifting(0)
    rows[np.arange(len(rows)) % 5 > 0, MODE] = PREDICT
    assert with_ground(plain, {"1": rows})["current"].value == pytest.approx(0.25, abs=0.01)


def test_circles_of_one_speed_tell_the_current_alone(plain):
    """The drift of a turn, in proportion to speed and yaw rate, looks there as an offset of the compass does."""
    rows, psi, rng = np.zeros((6000, ACROSS + 1)), 0.2 * np.arange(6000) * 0.1, np.random.default_rng(0)
    rows[:, MODE], rows[:, YAW_RATE], rows[:, COS], rows[:, SIN] = LEARN, 0.2, np.cos(psi), np.sin(psi)
    noise = 0.04 * rng.standard_normal((2, 6000))
    rows[:, ALONG] = 2.0 + CURRENT @ [rows[:, COS], rows[:, SIN]] + noise[0]
    rows[:, ACROSS] = -0.1 + CURRENT @ [-rows[:, SIN], rows[:, COS]] + noise[1]
    boat = with_ground(plain, {"1": rows})
    assert np.isnan(boat["compass_offset"].value) and boat.lacks[-1] == CIRCLES
    assert boat["current"].low < 0.25 < boat["current"].high


def test_dead_zone_and_lag_are_those_of_the_commands_or_unknown(plain):
    known = fit_boat("a", {f"{k}": sailed(k) for k in range(2)}, MASS, TOP, "nine").quantities
    zone = known["dead_zone"]
    assert zone.low < 0.06 < zone.high and zone.high - zone.low < 0.04
    lag = known["thrust_lag"]
    assert lag.low < TRUE[LAG] < lag.high and lag.unit == "s"
    rows = sailed(steps=900)
    rows[:, RIGHT] = rows[:, LEFT]
    known = fit_boat("a", {"1": rows}, MASS, TOP, "nine").identified
    assert np.isnan(known["dead_zone"].value) and NO_DEAD in known.lacks


@pytest.mark.parametrize("known", ["sway", "fixes", "nothing"])
def test_the_velocity_over_ground_comes_from_sway_or_fixes_not_from_added_speeds(known):
    time = np.arange(0, 60, 0.1)
    heading, zero, fresh = 0.1 * np.sin(0.2 * time), np.zeros(len(time)), np.ones(len(time), bool)
    samples = Sample(Inputs(zero, zero, heading, zero, zero + 0.1), zero + 2.0, fresh, fresh)
    order = np.arange(len(time))
    channels = {"heading": Channel(time, heading, order, window=0.5)}
    east = 2 * np.sin(heading) + 0.3 * np.cos(heading)
    if known == "sway":
        channels["sway"] = Channel(time, zero + 0.3, order, window=0.5)
    if known == "fixes":
        way = np.cumsum(2 * np.cos(heading) - 0.3 * np.sin(heading)) * 0.1, np.cumsum(east) * 0.1
        channels |= {k: Channel(time, x, order, window=0.5) for k, x in zip(("north", "east"), way, strict=True)}
    velocity = over_ground(samples, poses(channels, time, samples), time, 0.1)[100:-100]
    if known == "nothing":
        assert np.isnan(velocity[:, 1]).all()
    else:
        np.testing.assert_allclose(velocity, [[2.0, 0.3]] * len(velocity), atol=0.03)
