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
from usvlearn.estimators.ensemble.monitors import state as at
from usvlearn.estimators.ensemble.monitors.state import AT, Number

pytestmark = pytest.mark.filterwarnings("error")
ONE = torch.ones((), dtype=torch.float64)


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


# ---- innovations


NUMBERS = np.array([monitors.description()[number.key] for number in Number])


def row_of(state, places):
    """A state as the kernels have it: a row of its leaves, and the node that tells their places."""
    leaves = [leaf.numpy() for leaf in state]
    node = np.full(WIDTH, -1)
    node[Row.NUMBERS], node[list(places)] = 0, np.cumsum([0, *(leaf.size for leaf in leaves[:-1])])
    return node, np.concatenate([leaf.reshape(-1) for leaf in leaves])


def state_of(state, row):
    """The state like another one from its row."""
    parts = np.split(row.copy(), np.cumsum([leaf.numel() for leaf in state])[:-1])
    return type(state)(*(torch.from_numpy(x.reshape(tuple(leaf.shape))) for x, leaf in zip(parts, state, strict=True)))


def observed(state, innovation):
    node, row = row_of(state, AT.innovations)
    node[Row.SIZE] = len(state.last)
    compiled.observe_innovations(node, row, NUMBERS, innovation.numpy())
    return state_of(state, row)


def watched(innovations):
    state = monitors.init((), innovations.shape[-1], innovations).innovations
    node, row = row_of(state, AT.innovations)
    node[Row.SIZE] = innovations.shape[-1]
    for e in innovations.numpy():
        compiled.observe_innovations(node, row, NUMBERS, e)
    return state_of(state, row)


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
    broken = observed(state, torch.tensor([0.01, math.nan, math.inf], dtype=torch.float64))
    whole = observed(state, torch.tensor([0.01, 0.01, 0.01], dtype=torch.float64))
    for (name, new), (_, fresh), (_, old) in zip(*map(named_leaves, (broken, whole, state)), strict=True):
        assert torch.equal(new[0], fresh[0]) and torch.equal(new[1:], old[1:]) and not torch.equal(new[0], old[0]), name


def test_gross_outliers_hardly_move_scale_and_whiteness():
    e = 0.05 * normal(1500, 100, seed=3)
    struck = e + 50.0 * (torch.rand(e.shape, generator=torch.Generator().manual_seed(4), dtype=e.dtype) < 0.02)
    clean, dirty = watched(e), watched(struck)
    assert (dirty.scale / clean.scale).sqrt().mean().item() == pytest.approx(1.0, abs=0.05)
    assert monitors.whiteness(dirty).correlation.mean().abs() < 0.02


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


def observe(node, row, inputs):
    """One step of one boat's thrusters by the kernel, in place."""
    sample = np.zeros(samples.ROW, row.dtype)
    sample[[samples.LEFT, samples.RIGHT, samples.YAW_RATE, samples.DT]] = inputs[0], inputs[1], inputs[3], inputs[4]
    compiled.observe_thrusters(node, row, NUMBERS.astype(row.dtype), sample, np.empty(256, row.dtype))


def run(inputs):
    """The states of all boats after each step."""
    one, (steps, boats) = monitors.init((), 1, ONE).thrusters, inputs.dt.shape
    node, first = row_of(one, AT.thrusters)
    rows, columns = np.empty((steps, boats, len(first))), torch.stack(tuple(inputs), -1).numpy()
    for boat in range(boats):
        row = first.copy()
        for k in range(steps):
            observe(node, row, columns[k, boat])
            rows[k, boat] = row
    parts = np.split(rows, np.cumsum([leaf.numel() for leaf in one])[:-1], -1)
    shaped = (x.reshape(steps, boats, *leaf.shape) for x, leaf in zip(parts, one, strict=True))
    course = type(one)(*map(torch.from_numpy, shaped))
    return [type(one)(*(leaf[k] for leaf in course)) for k in range(steps)]


def test_each_step_is_that_of_the_equations():
    """(3) to (7), written out, of a boat that loses its left thruster."""
    inputs = boat(400, 1, torch.where(torch.arange(400) < 250, 1.0, 0.2).double(), seed=3)
    M, variance, before = np.zeros((10, 10)), at.YAW_SCALE**2, [0.0, 0.0]
    g, sums, raised = np.zeros(2), np.zeros((2, 2)), np.zeros(2)
    for k, state in enumerate(run(inputs)):
        left, right, rate = (float(x[k, 0]) for x in (inputs[0], inputs[1], inputs[3]))
        z = np.array([rate, 1, *before, left, right, left * abs(left), right * abs(right), left**3, right**3])
        P = np.linalg.inv(M[1:, 1:] + at.YAW_RIDGE * np.eye(9))
        theta, x = P @ M[1:, 0], z[1:]
        thrust = theta[3:].reshape(3, 2)
        full, effect, e = thrust.sum(0), (x[3:].reshape(3, 2) * thrust).sum(0), rate - x @ theta
        sigma = math.sqrt((1 + at.HORIZON * x @ P @ x) * variance + 0.5 * at.MISFIT**2 * (full @ full))
        calm = math.exp(-g.max() / at.CALM)
        if M[4, 4] + M[5, 5] - 2 * M[4, 5] <= at.APART * (M[4, 4] + M[5, 5]):
            effect = 0 * effect
        f, d = (
            np.clip(effect / sigma, -at.EFFECT, at.EFFECT),
            np.clip(e / sigma, -at.CLIP, at.CLIP),
        )
        loss = at.LOSS  # the likelihood of an error of −loss·f less that of 0
        g = np.clip(g + (d**2 - (d + loss * f) ** 2) / 2, 0, 2 * at.THRESHOLD)
        sums = (sums + np.stack([f * d, f * f], -1)) * (g > 0)[:, None]
        plausible = 1 + sums[:, 0] / (sums[:, 1] + at.DOUBT) > at.BACKWARDS
        g, sums = g * plausible, sums * plausible[:, None]
        raised = (g > at.THRESHOLD * np.where(raised > 0, at.CLEARED, 1)).astype(float)
        light = variance / (variance + e * e / at.KNEE**2)
        keep = math.exp(-min(abs(left) + abs(right), 1) * 0.4 / at.YAW_MEMORY)
        M = keep * M + calm * math.sqrt(light) * np.outer(z, z)
        moved = variance + calm * at.YAW_RATE * (e * e * light * at.YAW_SPREAD - variance)
        variance, before = max(moved, at.YAW_FLOOR**2), [rate, before[0]]
        for leaf, expected in zip(state[:6], (M, variance, before, g, sums, raised), strict=True):
            np.testing.assert_allclose(leaf[0], expected, rtol=1e-7, atol=1e-9, err_msg=f"step {k}")
    assert raised.tolist() == [1.0, 0.0]


def test_a_lost_thruster_raises_one_alarm_that_names_side_and_share_and_ends_when_it_is_mended():
    steps = torch.arange(3000)
    left = torch.where((steps >= 1500) & (steps < 2400), 0.4, 1.0).double()
    course = run(boat(3000, 20, left))
    before, during, after = course[1499], course[2399], course[-1]
    assert before.alarms.max() == 0 and before.evidence.max() < at.THRESHOLD / 2
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
    inverse = 1 / (1 + at.YAW_RIDGE)
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


@pytest.mark.parametrize("steps", [100, 2250, 90_000])
def test_rounded_sums_of_a_steady_cruise_keep_the_model_finite(steps):
    """Constant commands: the sums have rank one, and what rounding adds in `steps` steps makes them indefinite."""
    single, rng = torch.tensor([0.6, 0.6, 0.0, 0.0, 0.4]), np.random.default_rng(0)
    z = np.array([0, 1, 0, 0, 0.6, 0.6, 0.36, 0.36, 0.216, 0.216])
    error = np.tril(rng.choice([-1, 1], (200, 10, 10)))
    error = error + np.tril(error, -1).transpose(0, 2, 1)
    exact = steps * np.outer(z, z)
    moments = torch.from_numpy(exact * (1 + np.finfo(np.float32).eps * steps * error)).float()
    assert (torch.linalg.eigvalsh(moments[:, 1:, 1:].double()).amin(-1) < -at.YAW_RIDGE).any() == (steps > 100)
    for element in range(0, 200, 10):
        state = monitors.init((), 1, single).thrusters._replace(moments=moments[element])
        node, row = row_of(state, AT.thrusters)
        observe(node, row, single.tolist())
        after = state_of(state, row)
        assert all(leaf.isfinite().all() for leaf in after) and (after.evidence == 0).all()


def test_sums_that_cannot_be_solved_tell_nothing():
    state = monitors.init((), 1, ONE).thrusters
    state = state._replace(moments=state.moments - 5.0, evidence=torch.tensor([3.0, 1.0]).double())
    node, row = row_of(state, AT.thrusters)
    observe(node, row, (0.5, 0.9, 0.0, 0.3, 0.4))
    after = state_of(state, row)
    assert torch.equal(after.evidence, state.evidence) and all(leaf.isfinite().all() for leaf in after)


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
