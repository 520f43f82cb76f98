"""Monitors against what is known: autocorrelations, a CUSUM written as a loop, boats that lose a thruster."""

import math

import numpy as np
import pytest
import torch

from tests.support import random_samples
from usvlearn import RLS, Inputs, SurgeDynamics, rollout
from usvlearn.core import prepared_samples as samples
from usvlearn.core.family import WIDTH, Row
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.estimators.ensemble.monitors import kernel as compiled
from usvlearn.estimators.ensemble.monitors import layer as monitors
from usvlearn.estimators.ensemble.monitors.state import AT, Number

pytestmark = pytest.mark.filterwarnings("error")
ONE = torch.ones((), dtype=torch.float64)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ---- innovations


def watched(innovations, memory=500.0):
    state = monitors.init(innovations.shape[1:-1], innovations.shape[-1], innovations).innovations
    for e in innovations:
        state = monitors.observe_innovations(state, e, memory)
    return state


@pytest.mark.parametrize("phi", [-0.5, 0.0, 0.3, 0.8])
def test_whiteness_of_an_ar1_is_its_coefficient(phi):
    noise = 0.03 * normal(1500, 200, seed=1)
    e = [noise[0] / math.sqrt(1 - phi**2)]
    for each in noise[1:]:
        e.append(phi * e[-1] + each)
    state = watched(torch.stack(e) + 0.02)
    white = monitors.whiteness(state)
    # some 950 samples a column: ±0.03 each, ±0.003 in the mean; clipping at 3 s, for a level of 0.02 off 0, costs 2 %
    assert white.correlation.mean().item() == pytest.approx(phi, abs=0.02 + 0.01 * abs(phi))
    assert state.scale.sqrt().mean().item() == pytest.approx(math.sqrt(0.03**2 / (1 - phi**2) + 0.02**2), rel=0.06)


@pytest.mark.parametrize("steps", [60, 1500])
def test_white_noise_lies_in_its_band_95_times_in_100(steps):
    white = monitors.whiteness(watched(0.05 * normal(steps, 4000, seed=2)))
    # of 4000 columns 95 ± 0.35 %; the band is that of many samples
    assert (white.correlation.abs() <= white.band).double().mean().item() == pytest.approx(0.95, abs=0.015)
    weights = (1 - 1 / 500) ** np.arange(steps)  # of the samples, newest first
    assert white.samples[0].item() == pytest.approx(weights.sum() ** 2 / (weights**2).sum(), rel=1e-9)


def test_a_column_without_a_number_is_left_bit_identical_and_the_others_are_not_touched():
    e = 0.05 * normal(50, 3)
    state = watched(e)
    broken = monitors.observe_innovations(state, torch.tensor([0.01, math.nan, math.inf], dtype=torch.float64))
    whole = monitors.observe_innovations(state, torch.tensor([0.01, 0.01, 0.01], dtype=torch.float64))
    for (name, new), (_, fresh), (_, old) in zip(*map(named_leaves, (broken, whole, state)), strict=True):
        assert torch.equal(new[0], fresh[0]) and torch.equal(new[1:], old[1:]) and not torch.equal(new[0], old[0]), name


def test_gross_outliers_hardly_move_scale_and_whiteness():
    e = 0.05 * normal(1500, 100, seed=3)
    struck = e + 50.0 * (torch.rand(e.shape, generator=torch.Generator().manual_seed(4), dtype=e.dtype) < 0.02)
    clean, dirty = watched(e), watched(struck)
    assert (dirty.scale / clean.scale).sqrt().mean().item() == pytest.approx(1.0, abs=0.05)
    assert monitors.whiteness(dirty).correlation.mean().abs() < 0.02


# ---- the CUSUM


def looped(effect, error, loss=monitors.LOSS):
    """Page's test of a loss on one side, sample by sample: g after each, and the estimate of the share that is left."""
    g, moment, weight, course = 0.0, 0.0, 0.0, []
    for f, e in zip(effect, error, strict=True):
        f, e = np.clip(f, -monitors.EFFECT, monitors.EFFECT), np.clip(e, -monitors.CLIP, monitors.CLIP)
        g += (e**2 - (e + loss * f) ** 2) / 2  # log-likelihood of mean −loss·f less that of mean 0, unit variance
        moment, weight = moment + f * e, weight + f * f
        if g <= 0:
            g = moment = weight = 0.0
        g = min(g, 40.0)
        course.append((g, moment, weight))
    return course


def test_cusum_is_the_loop():
    effect, error = 2 * normal(300, 2, seed=5), 2 * normal(300, 1, seed=6) - 0.5
    g, sums = torch.zeros(2).double(), torch.zeros(2, 2).double()
    expected = [looped(effect[:, side].tolist(), error[:, 0].tolist()) for side in (0, 1)]
    for k in range(300):
        g, sums = monitors.cusum(g, sums, effect[k], error[k], 40.0)
        for side in (0, 1):
            assert [g[side].item(), *sums[side].tolist()] == pytest.approx(expected[side][k], abs=1e-9)


# ---- a boat that loses a thruster


def boat(steps, elements, left, seed=0, noise=0.06):
    """Yaw of boats of first order whose left thruster has the share `left`, `(steps,)`: inputs `(steps, elements)`."""
    mean = 0.5 + 0.3 * torch.sin(0.03 * torch.arange(steps).double())[:, None]
    swing = 0.25 * normal(steps // 25 + 1, elements, seed=seed).clamp(-1.5, 1.5).repeat_interleave(25, 0)[:steps]
    commands = torch.stack([mean + swing, mean - swing], -1).clamp(0, 1)
    force = commands * commands * torch.stack([left, torch.ones(steps).double()], -1)[:, None]
    yaw = [torch.zeros(elements).double()]
    for tau in force:
        yaw.append(0.5 * yaw[-1] + 0.3 * (tau[:, 0] - tau[:, 1]))
    rate = torch.stack(yaw[1:]) + noise * normal(steps, elements, seed=seed + 1)
    zero = torch.zeros_like(rate)
    return Inputs(commands[..., 0], commands[..., 1], zero, rate, zero + 0.4)


def run(inputs, dtype=torch.float64):
    state = monitors.init(inputs.dt.shape[1:], 1, ONE.to(dtype)).thrusters
    course = []
    for each in zip(*inputs, strict=True):
        state = monitors.observe_thrusters(state, Inputs(*(x.to(dtype) for x in each)))
        course.append(state)
    return course


def test_a_lost_thruster_raises_one_alarm_that_names_side_and_share_and_ends_when_it_is_mended():
    steps = torch.arange(3000)
    left = torch.where((steps >= 1500) & (steps < 2400), 0.4, 1.0).double()
    course = run(boat(3000, 20, left))
    before, during, after = course[1499], course[2399], course[-1]
    assert before.alarms.max() == 0 and before.evidence.max() < monitors.THRESHOLD / 2
    assert (course[1500 + 75].alarms == 1).all()  # 30 s
    assert (during.raised == torch.tensor([1.0, 0.0])).all()
    share, deviation = monitors.effectiveness(during)
    # the mean of 20 boats: what was learned of the fault before the alarm draws it to 1 by some hundredths
    assert share[:, 0].mean().item() == pytest.approx(0.4, abs=0.1)
    assert deviation[:, 0].max() < 0.1
    first = 0.4 * sum((state.alarms == 0).double() for state in course)  # s without an alarm, per boat
    assert during.since == pytest.approx(0.4 * 2400 - first - 0.4, abs=1e-6)
    assert (after.raised == 0).all() and (after.alarms == 1).all()


def test_effectiveness_is_as_unsure_as_the_thrust_that_it_is_a_share_of():
    """(6) by hand: M of ones on its diagonal, and ϑ of a tenth for each term of the left side."""
    state = monitors.init((), 1, ONE).thrusters
    moments = torch.eye(10).double()
    moments[[4, 6, 8], 0] = moments[0, [4, 6, 8]] = 0.1
    sums, evidence = torch.tensor([[-60.0, 90.0], [0.0, 0.0]]).double(), torch.tensor([12.0, 0.0]).double()
    state = state._replace(moments=moments, sums=sums, evidence=evidence, variance=0.0025 * ONE)
    share, deviation = monitors.effectiveness(state)
    assert share.tolist() == [pytest.approx(0.4), 1.0]
    inverse = 1 / (1 + monitors.YAW_RIDGE)
    spread, full = math.sqrt(0.0025 * 3 * inverse), 3 * 0.1 * inverse
    assert deviation[0].item() == pytest.approx(math.sqrt(1 / 100 + (0.6 * 2 * spread / full) ** 2))
    assert deviation[1].item() == pytest.approx(math.sqrt(1 / 10))


@pytest.mark.thorough
def test_a_healthy_boat_with_outliers_idle_minutes_and_straight_courses_raises_none():
    healthy = boat(1500, 40, torch.ones(1500).double(), seed=11)
    hit = torch.rand(healthy.dt.shape, generator=torch.Generator().manual_seed(1)) < 0.01
    healthy = healthy._replace(yaw_rate=torch.where(hit, 2.5, healthy.yaw_rate))
    idle = tree_map(lambda x: 0 * x, healthy)._replace(dt=healthy.dt, yaw_rate=0.06 * normal(1500, 40, seed=12))
    both = (healthy.command_left + healthy.command_right) / 2
    straight = healthy._replace(command_left=both, command_right=both, yaw_rate=0.06 * normal(1500, 40, seed=13))
    course = run(tree_map(lambda *x: torch.cat(x), straight, healthy, idle, healthy))
    assert course[-1].alarms.max() == 0
    assert all(leaf.isfinite().all() for _, leaf in named_leaves(course[-1]))


def kernel_step(state, inputs):
    """`observe_thrusters` of one boat by the compiled kernel."""
    leaves = [leaf.numpy() for leaf in state]
    row = np.concatenate([leaf.reshape(-1) for leaf in leaves])
    sample = np.zeros(samples.ROW, row.dtype)
    sample[[samples.LEFT, samples.RIGHT, samples.YAW_RATE, samples.DT]] = inputs.command_left, inputs.command_right, \
        inputs.yaw_rate, inputs.dt  # fmt: skip
    numbers = np.array([monitors.description()[number.key] for number in Number], row.dtype)
    places, node = np.cumsum([0, *(leaf.size for leaf in leaves[:-1])]), np.full(WIDTH, -1)
    node[Row.NUMBERS], node[list(AT.thrusters)] = 0, places
    compiled.observe_thrusters(node, row, numbers, sample, np.empty(256, row.dtype))
    parts = np.split(row, places[1:])
    return type(state)(*(torch.from_numpy(x.reshape(leaf.shape)) for x, leaf in zip(parts, leaves, strict=True)))


@pytest.mark.parametrize("steps", [100, 2250, 90_000])
def test_rounded_sums_of_a_steady_cruise_keep_the_model_finite(steps):
    """Constant commands: the sums have rank one, and what rounding adds in `steps` steps makes them indefinite."""
    single, rng = torch.tensor([0.6, 0.6, 0.0, 0.0, 0.4]), np.random.default_rng(0)
    z = np.array([0, 1, 0, 0, 0.6, 0.6, 0.36, 0.36, 0.216, 0.216])
    error = np.tril(rng.choice([-1, 1], (200, 10, 10)))
    error = error + np.tril(error, -1).transpose(0, 2, 1)
    exact = steps * np.outer(z, z)
    moments = torch.from_numpy(exact * (1 + np.finfo(np.float32).eps * steps * error)).float()
    assert (torch.linalg.eigvalsh(moments[:, 1:, 1:].double()).amin(-1) < -monitors.YAW_RIDGE).any() == (steps > 100)
    state = monitors.init((200,), 1, single).thrusters._replace(moments=moments)
    inputs = Inputs(*(x.expand(200) for x in single))
    after = monitors.observe_thrusters(state, inputs)
    assert all(leaf.isfinite().all() for leaf in after)
    assert (after.evidence == 0).all()
    for element in range(0, 200, 20):
        one = kernel_step(tree_map(lambda x, i=element: x[i], state), Inputs(*single))
        for name, x, y in zip(after._fields, one, tree_map(lambda x, i=element: x[i], after), strict=True):
            torch.testing.assert_close(x, y, rtol=1e-4, atol=1e-6, msg=name)


def test_sums_that_cannot_be_solved_tell_nothing():
    state = monitors.init((), 1, ONE).thrusters
    state = state._replace(moments=state.moments - 5.0, evidence=torch.tensor([3.0, 1.0]).double())
    inputs = Inputs(*torch.tensor([0.5, 0.9, 0.0, 0.3, 0.4]).double())
    after = monitors.observe_thrusters(state, inputs)
    assert torch.equal(after.evidence, state.evidence) and all(leaf.isfinite().all() for leaf in after)
    for name, x, y in zip(after._fields, kernel_step(state, inputs), after, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12, msg=name)


# ---- excitation


def learned(**replaced):
    seen = random_samples(400, seed=5)
    seen = seen._replace(inputs=seen.inputs._replace(**{k: f(seen.inputs) for k, f in replaced.items()}))
    rls = RLS(SurgeDynamics(28.0), forgetting=0.9999, covariance=10.0)
    return rls, rollout(rls, rls.init(), seen)[0]


def test_a_boat_that_only_goes_straight_knows_nothing_of_the_drag_of_turning():
    rls, state = learned(yaw_rate=lambda inputs: 0 * inputs.yaw_rate)
    prior = 10.0 * 28.0**2
    share = dict(zip(rls.model.names, monitors.excitation(state.factor, prior).tolist(), strict=True))
    assert share.pop("drag_cross") == 0.0
    assert min(share.values()) > 0.3
    direction, least = monitors.least_informed(state.factor, prior)
    assert direction[rls.model.names.index("drag_cross")].item() == pytest.approx(1.0, abs=1e-9)
    assert least == 0.0
    # the diagonal and eigenvectors of the covariance itself
    scaled = state.covariance / prior
    assert share["drag_quadratic"] == pytest.approx(1 - scaled[0, 0].item())
    report = monitors.excitation_report(rls.model.names, state.factor, prior)
    assert report["excitation_drag_linear"].item() == pytest.approx(share["drag_linear"])


def test_sides_that_always_agree_leave_their_difference_unknown():
    _, state = learned(command_right=lambda inputs: inputs.command_left)
    direction, least = monitors.least_informed(state.factor, 10.0 * 28.0**2)
    drag, left, right = direction.split(3)
    torch.testing.assert_close(left, -right, rtol=0, atol=1e-6)
    assert drag.abs().max() < 1e-6 and left.norm().item() == pytest.approx(math.sqrt(0.5), abs=1e-6)
    assert least == 0.0
    values = torch.linalg.eigvalsh(state.covariance / (10.0 * 28.0**2))
    assert (values[-3:] > 0.99).all() and values[-4] < 0.9  # three differences, and no more


# ---- what a person sees


def test_report_names_every_member_and_side():
    state = monitors.init((2,), 2, ONE)
    report = monitors.monitor_report(state, ["aid", "rls"])
    assert {"alarm", "evidence_left", "effectiveness_right", "whiteness_aid", "scale_rls"} <= set(report)
    assert all(value.shape == (2,) for value in report.values())
