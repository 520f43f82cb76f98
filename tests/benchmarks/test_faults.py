"""The benchmark of changes: its true model errs by the noise alone, its alarms and steps are counted as they say."""

import math

import faults
import numpy as np
import pytest
import torch

from usvlearn.simulate.fault import SIDES, faulty_vessels
from usvlearn.simulate.plants import plant


def answer_of(errors, begin=600, **more):
    """An answer with these errors of `own`, and of 1 of the true model."""
    true = np.ones_like(errors)
    none = np.zeros(errors.shape[1])
    return faults.Answer({"own": errors, "true model": true}, begin, none, none, none, none, none, {}, **more)


def test_every_change_is_there_on_both_sides():
    names = set(faults.events())
    assert {f"{side} {share}" for side in SIDES for share in ("70%", "40%", "0%")} < names
    assert {"left +50 %", "wear to 40 %", "towed body", "load", "gust", "stuck speed"} < names


@pytest.mark.parametrize(("name", "event"), faults.events().items())
def test_an_event_leaves_the_share_of_thrust_that_it_says(name, event):
    if "fault" in event.options:
        ticks = round(60 * event.minutes * 4)
        vessels = faulty_vessels(event.options["fault"], plant("heron"), [ticks], 4.0)
        assert min(vessels) == 60 * faults.MINUTE * 4
        shares = (vessels[max(vessels)].thrust_table[0, 0, :, -1] / 33.6).tolist()
        expected = [event.share if side == event.side else 1.0 for side in SIDES]
        assert shares == pytest.approx(expected), name


def test_the_true_model_errs_by_the_noise_of_two_speeds():
    """White noise of .02 m/s and a resolution of .05 m/s: of a difference, √2 √(.02² + .05²/12) m/s in all."""
    found = faults.course(faults.events()["gust"], "random", "otter", 3, 3)
    error = (found.true - found.target).numpy()[50:2000]
    spread = 1.4826 * np.nanmedian(np.abs(error))  # few are outliers
    assert spread == pytest.approx(math.sqrt(2 * (0.02**2 + 0.05**2 / 12)), rel=0.1)


def test_a_stuck_speed_is_judged_by_the_one_that_a_working_sensor_has():
    found = faults.course(faults.events()["stuck speed"], "random", "otter", 3, 1)
    part = slice(found.begin + 1, found.begin + 40)
    assert np.nanstd(found.samples.surge[part].numpy()) < 1e-9 < 0.05 < np.nanstd(found.target[part].numpy())


def test_ratio_is_of_the_first_predictions_and_steps_end_with_the_running_mean():
    errors = np.ones((1500, 4))
    errors[600:650] = 3.0
    found = answer_of(errors)
    assert faults.ratio(found, "own") == pytest.approx(2.0)
    # the mean of 50 steps is within 1.1 once at most 2 of them are of 3: 1 + 2 · 2/50 = 1.08
    assert faults.steps_back(found, "own") == 48
    errors[600:] = 3.0
    assert math.isinf(faults.steps_back(answer_of(errors), "own"))


def test_what_was_worse_before_the_event_is_back_at_its_own_level():
    errors = np.full((1500, 4), 1.5)
    assert faults.steps_back(answer_of(errors), "own") == 0


def test_alarms_are_counted_from_the_event_and_name_the_first_side():
    raised = np.zeros((100, 4, 2))
    raised[60:, 0, 0] = raised[70:80, 1, 1] = raised[55:, 2] = raised[10:20, 3, 0] = 1
    delay, right, early = faults.alarms(raised, 50, 0)
    assert delay.tolist() == [4.4, 8.4, 2.4, math.inf]
    assert right.tolist() == [True, False, False, False]  # both sides at once name none
    assert early.tolist() == [False, False, False, True]


def test_a_loss_is_answered_and_shown():
    (name, drive, event, found), *_ = faults.answers(
        5, 2, ("left 0%",), plants=("heron",), peers={"RLS": faults.plain_rls}, drives=("random",)
    )
    row = faults.cells(event, found)
    assert (name, drive) == ("left 0%", "random")
    assert np.isfinite(found.delay).all() and row["side right"] == "100%"
    ratios = {name: faults.ratio(found, name) for name in ("RLS", "joint", "ensemble", "oracle")}
    assert ratios["RLS"] > ratios["joint"] and all(0.8 < each < 6 for each in ratios.values())
    assert found.errors["RLS"].shape == found.errors["ensemble"].shape
    assert torch.isfinite(torch.from_numpy(found.effect)).all()
