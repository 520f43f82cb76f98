"""Fault accommodation: what the yaw rate shows enters the joint filters, and what they and the monitor then tell."""

import numpy as np
import pytest
import torch

from tests.support.kernel_cases import difference
from usvlearn import Ensemble, Inputs, JointEKF, Persistence, Robust, Sample, Trial
from usvlearn.core.samples import tree_map
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.ensemble.accommodation.state import AFTER, WAIT
from usvlearn.estimators.ensemble.monitors.layer import effectiveness
from usvlearn.estimators.joint.state import KAPPA, THETA

DT, BOATS, FAILS, HEALS, END = 0.4, 3, 1500, 2100, 2700
SHARE = 0.3
LEAVES = [
    "accommodation.handed", "accommodation.share", "accommodation.deviation", "accommodation.calm",
    "monitors.thrusters.raised", "members.joint.mean", "members.joint.trial.past_mean", "predictions",
]  # fmt: skip


def sail(seed: int = 0, turns: float = 0.4) -> Sample:
    """Boats whose left thruster keeps SHARE of its thrust from FAILS on, and recovers at HEALS."""
    rng = np.random.default_rng(seed)
    mean = rng.uniform(0.2, 0.9, (END // 20, BOATS)).repeat(20, 0)
    turn = rng.uniform(-turns, turns, (END // 20, BOATS)).repeat(20, 0)
    left, right = np.clip(mean + turn, -1, 1), np.clip(mean - turn, -1, 1)
    share = np.where((np.arange(END) >= FAILS) & (np.arange(END) < HEALS), SHARE, 1.0)
    v, rate = np.zeros(BOATS), np.zeros(BOATS)
    speeds, rates = np.empty((END, BOATS)), np.empty((END, BOATS))
    for k in range(END):
        own, other = 0.7 * share[k] * left[k], 0.7 * right[k]
        v = v + DT * (own + other - 0.1 * abs(v) * v - 0.2 * v)
        rate = 0.5 * rate + 0.5 * (own - other) + 0.02 * rng.standard_normal(BOATS)
        speeds[k], rates[k] = v, rate
    surge = torch.from_numpy(speeds + 0.02 * rng.standard_normal(speeds.shape))
    zero, yes = torch.zeros_like(surge), torch.ones_like(surge, dtype=torch.bool)
    inputs = Inputs(torch.from_numpy(left), torch.from_numpy(right), zero, torch.from_numpy(rates), zero + DT)
    return Sample(inputs, surge, yes, yes.clone())


def ensemble(**given) -> Ensemble:
    joint = JointEKF(2.5, current=1e-3, trial=Trial(**given))
    return Ensemble({"joint": joint, "persistence": Persistence()})


def part(samples: Sample, first: int, last: int) -> Sample:
    return tree_map(lambda x: x[first:last], samples)


@pytest.fixture(scope="module")
def course():
    one, samples = ensemble(), sail()
    state, _, record = rollout(one, one.init((BOATS,)), samples, LEAVES)
    return one, samples, state, record


def test_the_filters_get_the_effectiveness_ten_seconds_after_the_alarm(course):
    _, _, _, record = course
    for boat in range(BOATS):
        alarm, given = (
            int(record[name][:, boat, 0].argmax()) for name in ("monitors.thrusters.raised", "accommodation.handed")
        )
        assert FAILS < alarm < FAILS + 60
        assert given - alarm == round(AFTER / DT)
        assert (record["accommodation.handed"][:, boat, 1] == 0).all()
        past, before, now = (
            record["members.joint.trial.past_mean"][given, boat, 0],
            *record["members.joint.mean"][given - 1 : given + 1, boat],
        )
        at, other = THETA + 3, THETA + 6  # α, β, γ of the left and of the right side
        torch.testing.assert_close(now[other : other + 3], past[other : other + 3], rtol=0, atol=0)
        shares = now[at : at + 3] / past[at : at + 3]
        torch.testing.assert_close(shares, shares[:1].expand(3))
        torch.testing.assert_close(now[KAPPA] / past[KAPPA], shares[0])
        assert abs(float(shares[0]) - SHARE) < 0.3
        torch.testing.assert_close(now[:THETA], before[:THETA], rtol=0.2, atol=0.2)  # the speed goes on


def test_a_minute_later_the_effectiveness_is_right_and_its_interval_holds(course):
    _, _, _, record = course
    at = FAILS + 200
    share, deviation = (record[f"accommodation.{name}"][at, :, 0] for name in ("share", "deviation"))
    assert ((share - SHARE).abs() < 0.1).all()
    assert ((share - SHARE).abs() <= 2.6 * deviation).all() and (deviation < 0.15).all()


def test_a_thruster_that_recovers_gets_its_parameters_back(course):
    _, _, state, record = course
    handed = record["accommodation.handed"][:, :, 0]
    assert (handed[HEALS - 1] == 1).all() and (handed[-1] == 0).all()
    assert (record["accommodation.share"][-1] == 1).all() and (record["accommodation.deviation"][-1] == 0).all()
    for boat in range(BOATS):
        end = HEALS + int((handed[HEALS:, boat] == 0).int().argmax())
        past, now = (record[f"members.joint.{name}"][end, boat] for name in ("trial.past_mean", "mean"))
        assert end < HEALS + 100
        torch.testing.assert_close(now[THETA + 3 : THETA + 6], past[0, THETA + 3 : THETA + 6])
    full = state.members["joint"].mean[:, THETA + 3 : THETA + 5].sum(-1) + state.members["joint"].mean[:, KAPPA]
    torch.testing.assert_close(full, torch.full_like(full, 0.7), rtol=0.15, atol=0)


def test_no_copy_is_made_while_a_fault_is_seen(course):
    _, _, _, record = course
    calm, raised = record["accommodation.calm"], record["monitors.thrusters.raised"].amax(-1) > 0
    assert (calm < WAIT + DT).all()
    assert (calm.diff(dim=0)[raised[1:]] == 0).all()
    assert (calm.diff(dim=0) < -WAIT / 2).sum() > 20 * BOATS


def test_a_run_is_resumed_within_a_fault_bit_for_bit(course):
    one, samples, state, _ = course
    again = one.init((BOATS,))
    for first, last in ((0, FAILS + 35), (FAILS + 35, FAILS + 90), (FAILS + 90, END)):
        again = rollout(one, again, part(samples, first, last))[0]
    assert difference(again, state) == 0.0


def test_an_alarm_that_ends_is_a_recovery_only_if_the_filters_agree(course):
    _, samples, _, _ = course
    one = ensemble()
    state = rollout(one, one.init((BOATS,)), part(samples, 0, FAILS + 200))[0]
    assert (state.accommodation.handed[:, 0] == 1).all()
    quiet = state.monitors.thrusters
    quiet = quiet._replace(evidence=0 * quiet.evidence, raised=0 * quiet.raised, sums=0 * quiet.sums)
    state = state._replace(monitors=state.monitors._replace(thrusters=quiet))
    after = rollout(one, state, part(samples, FAILS + 200, FAILS + 202))[0]
    assert (after.accommodation.handed[:, 0] == 1).all()
    assert ((after.accommodation.share[:, 0] - SHARE).abs() < 0.1).all()


def test_one_command_for_both_sides_blames_both():
    """Nothing tells the sides apart: what the speed finds is given to both."""
    one, samples = ensemble(), sail(5, turns=0.0)
    _, _, kept = rollout(one, one.init((BOATS,)), samples, LEAVES)
    for name in ("monitors.thrusters.raised", "accommodation.handed"):
        assert (kept[name][..., 0] == kept[name][..., 1]).all() and (kept[name][:FAILS] == 0).all()


@pytest.mark.thorough
def test_single_precision_finds_the_same():
    one, samples = ensemble().to(torch.float32), sail(1)
    narrow = tree_map(lambda x: x if x.dtype == torch.bool else x.float(), samples)
    _, _, record = rollout(one, one.init((BOATS,)), narrow, LEAVES)
    share = record["accommodation.share"][FAILS + 200, :, 0]
    assert share.dtype == torch.float32 and ((share - SHARE).abs() < 0.1).all()


def test_only_joint_filters_with_trials_that_nothing_wraps_are_accommodated():
    members = {"plain": JointEKF(2.5), "wrapped": Robust(JointEKF(2.5, trial=Trial())), "persistence": Persistence()}
    none = Ensemble(members)
    assert none.accommodated == () and none.init().accommodation == {} and "accommodation" not in none.description()
    some = Ensemble(members | {"joint": JointEKF(2.5, trial=Trial())})
    assert some.accommodated == ("joint",) and some.description()["accommodation"]["members"] == [3]
    assert Ensemble({"joint": JointEKF(2.5, trial=Trial())}, watched=False).accommodated == ()


def test_a_second_fault_leaves_the_share_of_the_first(course):
    """The older parameters are healthy ones: of both sides their share of them is given."""
    one, _, state, _ = course
    surge, two = torch.ones(BOATS, dtype=torch.float64), torch.ones(BOATS, 2, dtype=torch.float64)
    thrusters = state.monitors.thrusters._replace(
        raised=two,
        since=12 * surge,
        evidence=30 * torch.ones(BOATS, 3, dtype=torch.float64),
        sums=torch.tensor([-24.0, 37.0, 0.0, 0.0]).double().expand(BOATS, 3, 4).clone(),
    )
    handed, share = (two * two.new_tensor(both) for both in ([1.0, 0.0], [0.3, 1.0]))
    first = state.accommodation._replace(handed=handed, share=share)
    state = state._replace(accommodation=first, monitors=state.monitors._replace(thrusters=thrusters))
    row, yes = surge[None], surge[None] > 0
    some = Sample(Inputs(0.5 * row, 0.5 * row, 0 * row, 0 * row, 0.4 * row), row, yes, yes)
    after = rollout(one, state, some)[0]
    joint, past = after.members["joint"], after.members["joint"].trial.past_mean[:, 0]
    assert (after.accommodation.handed == 1).all()
    torch.testing.assert_close((joint.mean / past)[:, THETA + 3], 0.3 * surge)
    share = effectiveness(after.monitors.thrusters)[0][:, 1]  # some 1 − 24/(37 + 3)
    torch.testing.assert_close((joint.mean / past)[:, THETA + 6], share)
    torch.testing.assert_close(share, 0.4 * surge, rtol=0, atol=0.2)
    assert joint.started.all() and (joint.trial.run == 0).all()
