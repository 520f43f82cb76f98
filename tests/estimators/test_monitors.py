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
    """Boats of first order whose left thruster has the share `left`, `(steps,)`: inputs, speeds."""
    mean = 0.5 + 0.3 * torch.sin(0.03 * torch.arange(steps).double())[:, None]
    swing = 0.25 * normal(steps // 25 + 1, elements, seed=seed).clamp(-1.5, 1.5).repeat_interleave(25, 0)[:steps]
    commands = torch.stack([mean + swing, mean - swing], -1).clamp(0, 1)
    force = commands * commands * torch.stack([left, torch.ones(steps).double()], -1)[:, None]
    yaw, surge = [torch.zeros(elements).double()], [torch.zeros(elements).double()]
    for tau in force:
        yaw.append(0.5 * yaw[-1] + 0.3 * (tau[:, 0] - tau[:, 1]))
        surge.append(0.9 * surge[-1] + 0.1 * tau.sum(-1))
    rate = torch.stack(yaw[1:]) + noise * normal(steps, elements, seed=seed + 1)
    zero = torch.zeros_like(rate)
    speed = torch.stack(surge[1:]) + 0.02 * normal(steps, elements, seed=seed + 2)
    return Inputs(commands[..., 0], commands[..., 1], zero, rate, zero + 0.4), speed


def observe(node, row, inputs, speed=0.0):
    """One step of one boat's thrusters by the kernel, in place."""
    sample = np.zeros(samples.ROW, row.dtype)
    left, right, heading, rate, dt = inputs
    sample[: samples.MODE] = left, right, math.sin(heading), math.cos(heading), rate, dt, speed
    compiled.observe_thrusters(node, row, NUMBERS.astype(row.dtype), sample, np.empty(256, row.dtype))


def run(inputs, surge):
    """The states of all boats after each step."""
    one, (steps, boats) = monitors.init((), 1, ONE).thrusters, inputs.dt.shape
    node, first = row_of(one, AT.thrusters)
    rows, columns = np.empty((steps, boats, len(first))), torch.stack(tuple(inputs), -1).numpy()
    for boat in range(boats):
        row = first.copy()
        for k in range(steps):
            observe(node, row, columns[k, boat], surge[k, boat].item())
            rows[k, boat] = row
    parts = np.split(rows, np.cumsum([leaf.numel() for leaf in one])[:-1], -1)
    shaped = (x.reshape(steps, boats, *leaf.shape) for x, leaf in zip(parts, one, strict=True))
    course = type(one)(*map(torch.from_numpy, shaped))
    return [type(one)(*(leaf[k] for leaf in course)) for k in range(steps)]


def written_out(M, errors, z, exponent):
    """(3), (4) and what (5) and (8) need of a sample: e, effects, 1/σ, share of the information, slow error."""
    n = len(z) - 1
    P = np.linalg.inv(M[1:, 1:] + at.YAW_RIDGE * np.eye(n))
    theta, x = P @ M[1:, 0], z[1:]
    sides = np.stack([np.isin(np.arange(n), [3 + k, 5 + k, 7 + k]) * theta for k in range(2)])
    effects, full = sides @ x, np.abs(sides.sum(1))
    misfit = (full ** (2 - exponent) * np.abs(effects) ** exponent).sum()
    sigma = math.sqrt(0.5 * at.MISFIT**2 * misfit + (1 + at.HORIZON * x @ P @ x) * errors[at.VARIANCE])
    colour = min(max(errors[at.LAGGED] / errors[at.SQUARE], 0), 0.95) if errors[at.SQUARE] > 0 else 0.0
    slow = at.SLOWNESS * math.sqrt(errors[at.LEVELS])
    return z[0] - x @ theta, np.append(effects, effects.sum()), 1 / sigma, (1 - colour) / (1 + colour), slow


def test_each_step_is_that_of_the_equations():
    """(3) to (8), written out, of a boat that loses its left thruster."""
    inputs, surge = boat(600, 1, torch.where(torch.arange(600) < 350, 1.0, 0.2).double(), seed=3)
    yaw, pull, solved = np.zeros((10, 10)), np.zeros((13, 13)), np.zeros((10, 10))
    errors = np.array([[at.YAW_SCALE**2, 0, 0, 0, 0, at.SLOW_SCALE**2]] * 2)
    g, sums, before, block, began = np.zeros(3), np.zeros((3, 4)), [0.0, 0.0], [], 0.0
    explained, raised, share = np.zeros(2), np.zeros(2), np.ones(2)

    def gather(k, j, e, effects, precision, colour, slow):
        e += sum(raised[i] * (1 - share[i]) * effects[i] for i in range(2) if k < 2 and i != k)
        precision *= min(at.CLIP / max(abs(effects[k] * precision), 1e-300), 1)
        f, d, loss = effects[k] * precision, np.clip(e * precision, -at.CLIP, at.CLIP), at.LOSS
        g[k] = np.clip(g[k] - colour * ((loss * f + d) ** 2 - d**2) / 2, 0, 2 * at.THRESHOLD)  # ratio of likelihoods
        new = colour * np.array([f * d, f * f, f * precision * slow * (j == 0), f * precision * slow * (j == 1)])
        sums[k] = sums[k] * min(at.REMEMBERED / max(sums[k, 1] + colour * f * f, 1e-300), 1) + new
        if g[k] <= 0 or 1 + sums[k, 0] / (sums[k, 1] + at.DOUBT) <= at.BACKWARDS:
            g[k], sums[k] = 0, 0

    def learn(M, own, z, e, floor, keep, seconds):
        s2 = own[at.VARIANCE]
        light, rate = s2 / (s2 + e * e / at.KNEE**2), min(calm * seconds / at.SLOWLY, 1) * (M[1, 1] > at.BEGUN)
        M[:] = keep * M + calm * math.sqrt(light) * np.outer(z, z)
        own[at.VARIANCE] = s2 = max(s2 + calm * at.YAW_RATE * (e * e * light * at.YAW_SPREAD - s2), floor**2)
        c = np.clip(e, -3 * math.sqrt(s2), 3 * math.sqrt(s2))
        own[at.SQUARE] += rate * (c * c - own[at.SQUARE])
        own[at.LAGGED] += rate * (c * own[at.LAST] - own[at.LAGGED])
        own[at.LAST] = c
        own[at.LEVEL] += calm * seconds / at.SLOW * (c - own[at.LEVEL])
        own[at.LEVELS] += rate * (own[at.LEVEL] ** 2 - own[at.LEVELS])
        return e * e * light

    for k, state in enumerate(run(inputs, surge)):
        left, right, rate = (float(x[k, 0]) for x in (inputs[0], inputs[1], inputs[3]))
        v, calm = float(surge[k, 0]), 0.0 if raised.any() else math.exp(-g.max() / at.CALM)
        keep = math.exp(-min(left + right, 1) * 0.4 / at.YAW_MEMORY)
        z = np.array([rate, 1, *before, left, right, left**2, right**2, left**3, right**3])
        e, effects, *more = written_out(solved, errors[0], z, 0)
        apart = yaw[4, 4] + yaw[5, 5] - 2 * yaw[4, 5] > at.APART * (yaw[4, 4] + yaw[5, 5])
        white = errors[0, at.LAGGED] < at.COLOURED * errors[0, at.SQUARE]
        if apart and white and explained[0] < (1 - at.EXPLAINED) * explained[1]:
            for side in range(2):
                gather(side, 0, e, effects, *more)
        square = learn(yaw, errors[0], z, e, at.YAW_FLOOR, keep, 0.4)
        explained += calm * 0.4 / at.SLOWLY * (np.array([square, (e + effects[2]) ** 2]) - explained)
        block.append([left, right, left**2, right**2, left**2, right**2, abs(rate), 1, 0])
        if len(block) == 5:  # 2 s
            mean = np.mean(block, 0)
            z = np.array([v, 1, began, began * abs(began), *mean[:6], mean[6] * began, *mean[7:]])
            e, effects, *more = written_out(pull, errors[1], z, 1)
            for side in range(2 if raised.any() else 3):
                gather(side, 1, e, effects, *more)
            if raised.any():
                g[2], sums[2] = 0, 0
            learn(pull, errors[1], z, e, at.SURGE_FLOOR, math.exp(-min(sum(mean[:2]), 1) * 2 / at.YAW_MEMORY), 2)
            block, began, solved = [], v, yaw.copy()
        before = [rate, before[0]]
        told = (np.tril(yaw), np.tril(pull), errors, explained, g, sums)
        names = ("moments", "surges", "errors", "explained", "evidence", "sums")
        for name, expected in zip(names, told, strict=True):
            np.testing.assert_allclose(
                getattr(state, name)[0], expected, rtol=1e-5, atol=1e-7, err_msg=f"{name} at step {k}"
            )
        raised, share = state.raised[0].numpy(), state.share[0].numpy()
    assert raised.tolist() == [1.0, 0.0]


def test_a_lost_thruster_raises_an_alarm_that_names_side_and_share_and_ends_when_it_is_mended():
    steps = torch.arange(3000)
    left = torch.where((steps >= 1500) & (steps < 2400), 0.4, 1.0).double()
    course = run(*boat(3000, 20, left))
    before, during, after = course[1499], course[2399], course[-1]
    assert before.alarms.max() == 0
    assert (course[1500 + 75].alarms >= 1).all()  # 30 s
    on = torch.stack([state.raised for state in course[1575:2400]]).mean(0)  # share of the time, by boat and side
    assert on[:, 0].mean() > 0.85 and on[:, 1].mean() < 0.05
    share, deviation = monitors.effectiveness(during)
    # the mean of 20 boats: what was learned of the fault before the alarm draws it to 1 by some hundredths
    assert share[:, 0].mean().item() == pytest.approx(0.4, abs=0.1)
    assert deviation[:, 0].median() < 0.2
    assert (course[2400 + 150].raised == 0).all()  # 60 s
    assert (after.raised == 0).all() and (after.alarms == during.alarms).all()


def test_one_engine_that_loses_thrust_is_found_by_the_speed_and_cleared_when_it_is_mended():
    """Both sides get the same command, as with throttle and rudder: no turn tells anything."""
    steps = torch.arange(2500)
    share = torch.where((steps >= 1500) & (steps < 2000), 0.4, 1.0).double()[:, None]
    command = (0.5 + 0.3 * normal(100, 5, seed=4).clamp(-1.5, 1.5)).repeat_interleave(25, 0)
    surge = [torch.zeros(5).double()]
    for force in 2 * share * command**2:
        surge.append(0.9 * surge[-1] + 0.1 * force)
    zero = 0 * command
    inputs = Inputs(command, command, zero, 0.3 * normal(2500, 5, seed=5), zero + 0.4)
    course = run(inputs, torch.stack(surge[1:]) + 0.02 * normal(2500, 5, seed=6))
    assert course[1499].alarms.max() == 0
    found = course[1999]
    seen = found.raised[:, 0] > 0  # of four in five: the other one has hardly any thrust then
    assert (course[1590].raised[seen] == 1).all() and (found.raised[seen] == 1).all() and seen.sum() >= 4
    assert found.share[seen].mean().item() == pytest.approx(0.4, abs=0.12)
    assert (course[2150].raised == 0).all() and (course[-1].alarms == found.alarms).all()


def test_turns_that_no_command_explains_raise_no_alarm():
    """Yaw rates of another cause, so large that chance would sum to evidence; less of them is explained."""
    inputs, surge = boat(1500, 4, torch.ones(1500).double(), seed=21)
    swell = 0.8 * torch.sin(0.05 * torch.arange(1500).double())[:, None] + 0.1 * normal(1500, 4, seed=22)
    course = run(inputs._replace(yaw_rate=swell), surge)
    assert course[-1].alarms.max() == 0
    assert monitors.yaw_explained(course[-1]).max() < monitors.yaw_explained(run(inputs, surge)[-1]).min()


def test_pivots_never_seen_before_raise_hardly_an_alarm():
    """After ten minutes of small differences, full ahead against full astern turns less than the model says.

    Of 20 boats 18 raise none: the leverage of such commands leaves the evidence too little weight.
    """
    inputs, surge = boat(1700, 5, torch.ones(1700).double(), seed=31)
    left, right = inputs.command_left.clone(), inputs.command_right.clone()
    left[1500:1520], right[1500:1520] = 1.0, -1.0
    rate = inputs.yaw_rate.clone()
    rate[1500:1520] = 0.1
    course = run(inputs._replace(command_left=left, command_right=right, yaw_rate=rate), surge)
    assert course[-1].alarms.sum() <= 1


@pytest.mark.thorough
def test_a_healthy_boat_with_outliers_idle_minutes_and_straight_courses_raises_none():
    healthy, surge = boat(1500, 40, torch.ones(1500).double(), seed=11)
    hit = torch.rand(healthy.dt.shape, generator=torch.Generator().manual_seed(1)) < 0.01
    healthy = healthy._replace(yaw_rate=torch.where(hit, 2.5, healthy.yaw_rate))
    idle = tree_map(lambda x: 0 * x, healthy)._replace(dt=healthy.dt, yaw_rate=0.06 * normal(1500, 40, seed=12))
    both = (healthy.command_left + healthy.command_right) / 2
    straight = healthy._replace(command_left=both, command_right=both, yaw_rate=0.06 * normal(1500, 40, seed=13))
    inputs = tree_map(lambda *x: torch.cat(x), straight, healthy, idle, healthy)
    course = run(inputs, torch.cat([surge, surge, 0 * surge, surge]))
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
    state = state._replace(moments=state.moments - 5.0, evidence=torch.tensor([3.0, 1.0, 0.0]).double())
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
