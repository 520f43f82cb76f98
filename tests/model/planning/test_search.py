"""The rehearsal is the joint EKF's own recursion; the search keeps its bounds and finds a local optimum."""

import math

import numpy as np
import pytest
import torch

from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN, YAW_RATE
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError
from usvlearn.model.planning.course import QUARTER, Limits, lawn_mower, planned, steer, steps_of
from usvlearn.model.planning.search import SHARES, Rehearsal, beyond, derived, log_width, search, wide

STEP = 0.4
SHORT = Limits(minutes=2.0)


@pytest.fixture(scope="module")
def rehearsal(boat):
    return Rehearsal(boat.members, boat.leaves)


@pytest.fixture(scope="module")
def plan(rehearsal):
    return search(rehearsal, SHORT, STEP, wide(rehearsal.identified))


@pytest.mark.thorough
def test_a_rehearsal_is_the_recursion_of_the_torch_filter_on_its_own_predictions(rehearsal, boat, reader):
    rows = planned(np.array([1.0, 0.0, 0.5, 0.25]), np.array([0, 1, 3, 2]), Limits(minutes=1.0), STEP).rows
    leaves = {key.partition(".")[2].partition(".")[2]: leaf for key, leaf in boat.leaves.items() if ".jointekf." in key}
    state = type(reader.init())(**{name: torch.as_tensor(leaf) for name, leaf in leaves.items()})
    noise, speeds = state.noise, []
    with torch.no_grad():
        state = reader.start(state, torch.zeros((), dtype=torch.float64))
        for x in rows:
            given = (x[LEFT], x[RIGHT], math.atan2(x[SIN], x[COS]), x[YAW_RATE], x[DT])
            inputs = Inputs(*(torch.tensor(value, dtype=torch.float64) for value in given))
            state = reader.learn(state, inputs, reader.predict(state, inputs)[1])[0]._replace(noise=noise)
            speeds.append(float(state.mean[0]))
    ahead = rehearsal(rows)
    assert ahead.speed == pytest.approx(speeds, abs=1e-9)
    parameters = state.covariance[4:, 4:].numpy()
    assert not np.allclose(parameters, boat.identified.covariance, rtol=0.1)
    assert (ratio := ahead.identified.covariance / parameters) == pytest.approx(ratio[0, 0], rel=1e-6)


def test_a_rehearsal_leaves_the_state_as_it_was(rehearsal, boat):
    rows = lawn_mower(SHORT, 2.7, STEP).rows
    first, second = rehearsal(rows), rehearsal(rows)
    assert first.identified.json() == second.identified.json()
    assert rehearsal.identified.json() == boat.identified.json()


def test_parts_add_up_to_the_whole(rehearsal):
    rows = lawn_mower(SHORT, 2.7, STEP).rows
    parts = rehearsal.by_part(rows, np.array([100, len(rows)]))
    assert np.concatenate([part.speed for part in parts]).tolist() == rehearsal(rows).speed.tolist()
    assert parts[-1].identified.json() == rehearsal(rows).identified.json()


@pytest.mark.thorough
def test_a_plan_is_better_than_a_lawn_mower_and_keeps_its_bounds(rehearsal, plan):
    aims = wide(rehearsal.identified)
    mower = rehearsal(lawn_mower(SHORT, rehearsal.top_speed(1.0), STEP).rows)
    assert log_width(plan.expected.identified, aims) < log_width(mower.identified, aims) - 0.1
    assert log_width(plan.expected.identified, aims) < log_width(rehearsal.identified, aims) - 0.1
    assert beyond(plan.path, SHORT).max() <= 0.01
    for side in (plan.course.left, plan.course.right):
        assert side.min() >= 0 and side.max() <= 1
    assert abs(plan.course.yaw_rate).max() <= SHORT.turn_rate + 1e-9


def test_no_change_of_one_segment_is_better(rehearsal, plan):
    aims, best = wide(rehearsal.identified), log_width(plan.expected.identified, wide(rehearsal.identified))
    first = np.searchsorted(steps_of(SHORT, STEP), np.arange(SHORT.segments))
    shares, headings = plan.course.throttle[first], np.round((plan.course.wanted[first] - SHORT.heading) / QUARTER)
    worse = 0
    for k in range(SHORT.segments):
        for throttles, quarters in [
            *((np.where(np.arange(SHORT.segments) == k, share, shares), headings) for share in SHARES),
            *((shares, np.where(np.arange(SHORT.segments) == k, q, headings)) for q in range(4)),
        ]:
            course = planned(throttles, quarters, SHORT, STEP)
            other = rehearsal(course.rows)
            if beyond(course.path(other.speed, rehearsal.current), SHORT).max() <= 0.01:
                assert log_width(other.identified, aims) >= best - 1e-12
                worse += log_width(other.identified, aims) > best
    assert worse > 20


def test_a_boat_that_may_go_astern_is_planned_within_its_bounds(rehearsal):
    limits = Limits(minutes=1.0, least=-0.5, most=0.5)
    best = search(rehearsal, limits, STEP, wide(rehearsal.identified))
    sides = np.concatenate([best.course.left, best.course.right])
    assert -0.5 <= sides.min() < 0 < sides.max() <= 0.5


@pytest.mark.thorough
def test_a_boat_stays_in_a_small_area_in_a_current_that_would_carry_it_out(boat):
    carried = Rehearsal(boat.members, boat.leaves)
    carried.current = np.array([0.2, -0.15])
    limits = Limits(minutes=2.0, area=20.0)  # the current alone goes 30 m
    best = search(carried, limits, STEP, derived(carried.identified))
    assert beyond(best.path, limits).max() <= 0.01 and best.course.throttle.max() > 0


@pytest.mark.thorough
def test_an_area_that_is_too_small_is_said_with_one_that_would_do(rehearsal):
    with pytest.raises(
        ConfigError, match=r"--area: found 10 m, and no course was found .* give an area of \d+ m, a shorter --segment"
    ):
        search(rehearsal, Limits(minutes=1.0, area=10.0, least=0.3, segment=15.0), STEP, derived(rehearsal.identified))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"minutes": 0.0}, "--minutes"),
        ({"minutes": -3.0}, "--minutes"),
        ({"minutes": math.nan}, "--minutes"),
        ({"minutes": 0.2}, "--minutes: found 0.2, expected 1 or more"),
        ({"minutes": 60.0}, "--minutes: found 60, expected 15 or less"),
        ({"segment": 0.5}, "--segment: found 0.5, expected 2 s or more"),
        ({"area": 0.0}, "--area"),
        ({"most": 0.0}, "thrust and drag show only where the commands change"),
        ({"most": 0.5, "least": 0.45}, "found commands from 0.45 to 0.5, expected a range of 0.1"),
        ({"most": 1.5}, "--command-max: found 1.5"),
        ({"least": -2.0}, "--command-min: found -2.0"),
    ],
)
def test_limits_that_leave_nothing_to_sail_are_said(given, said):
    with pytest.raises(ConfigError, match="--") as error:
        Limits(**given)
    assert said in str(error.value) and len(str(error.value).splitlines()) == 1


def test_turns_take_the_time_of_the_yaw_rate_and_steer_with_both_sides():
    course = steer(np.full(100, 0.5), np.full(100, QUARTER), Limits(), STEP)
    turning = np.flatnonzero(course.yaw_rate)
    assert len(turning) == math.ceil(QUARTER / (Limits().turn_rate * STEP))
    assert (course.left - course.right)[turning] == pytest.approx(0.7)
    assert course.heading[-1] == pytest.approx(QUARTER)
    assert not (course.left - course.right)[turning[-1] + 1 :].any()


def test_a_path_is_the_integral_of_the_speed_and_the_current():
    course = steer(np.full(100, 0.5), np.full(100, math.pi / 2), Limits(heading=math.pi / 2), STEP)
    path = course.path(np.full(100, 2.0), np.array([0.1, 0.0]))
    assert path[-1] == pytest.approx([0.1 * 40, 2.0 * 40])
