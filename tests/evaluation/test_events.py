"""Events: losses of thrust, recoveries, and changes of the boat, from what was published of each step."""

import numpy as np
import pytest

from usvlearn.core.events import CHANGE, LOSS, RECOVERY, Event, EventWatch, event_of
from usvlearn.core.samples import Fleet, Run
from usvlearn.evaluation.diagnostics import events

FILTERS = ("joint", "joint_averaged")
DT, STEPS = 0.4, 1000


def fleet(*names: str, steps: int = STEPS) -> Fleet:
    runs = tuple(Run(DT * np.arange(steps)[:, None], None, (name,), (steps,)) for name in names)
    return Fleet(("anna",), runs, {})


def published(share=None, raised=None, handed=None, changes=None, steps: int = STEPS) -> dict[str, np.ndarray]:
    """What is published of one boat; each argument is steps → value of the left side, or of both filters."""
    thrusters, health = np.zeros((steps, 1, 5)), np.zeros((steps, 1, 6 + len(FILTERS)))
    thrusters[:, 0, :2], health[:, 0, :2] = 1.0, 0.1
    for place, values in ((health[:, 0, 2], raised), (health[:, 0, 4], handed), (thrusters[:, 0, 0], share)):
        for (first, last), value in (values or {}).items():
            place[first:last] = value
    for k, step in enumerate(changes or ()):
        health[step:, 0, 6 + k] = 1.0
    thrusters[:, 0, 4] = health[:, 0, 2:4].max(-1)
    return {"thrusters": thrusters, "health": health}


def told(*stretches, names=("one",)) -> list[dict]:
    return events(fleet(*names), stretches, FILTERS)["anna"]


def test_a_loss_is_one_event_with_the_effectiveness_of_two_minutes_later():
    share = {(100, 200): 0.6, (200, 400): 0.45, (400, 700): 0.4, (700, 900): 0.2}
    happened = told((0, 0, published(share, {(100, 900): 1.0}, {(125, 900): 1.0})))
    loss, recovery = happened
    assert (loss["kind"], loss["run"], loss["side"], loss["time"]) == (LOSS, "one", "left", pytest.approx(40.0))
    assert loss["effectiveness"] == 0.4 and loss["given"] == pytest.approx(10.0) and loss["filters"] == list(FILTERS)
    assert (loss["low"], loss["high"]) == (pytest.approx(0.4 - 0.1645), pytest.approx(0.4 + 0.1645))
    assert (recovery["kind"], recovery["side"], recovery["time"]) == (RECOVERY, "left", pytest.approx(360.0))
    assert recovery["effectiveness"] is None and event_of(recovery) == Event(recovery["time"], RECOVERY, "left")


def test_a_loss_of_both_that_becomes_one_side_changes_no_earlier_loss():
    row = published({(100, 200): 0.5, (500, STEPS): 0.4}, {(100, 200): 1.0, (500, STEPS): 1.0})
    row["health"][500:520, 0, 3] = 1.0  # the right side, too, at first
    losses = [each for each in told((0, 0, row)) if each["kind"] == LOSS]
    assert [(each["time"], each["side"]) for each in losses] == [(40.0, "left"), (200.0, "left")]


def test_stretches_and_runs_do_not_repeat_what_goes_on():
    whole = published({(100, 900): 0.5}, {(100, 900): 1.0}, {(125, 900): 1.0})
    parts = [(0, k, {name: x[k : k + 250] for name, x in whole.items()}) for k in range(0, STEPS, 250)]
    assert told(*parts) == told((0, 0, whole))
    on = published({(0, STEPS): 0.5}, {(0, STEPS): 1.0}, {(0, STEPS): 1.0})
    happened = told((0, 0, published({(100, STEPS): 0.5}, {(100, STEPS): 1.0})), (1, 0, on), names=("one", "two"))
    assert [each["run"] for each in happened] == ["one"]


def test_a_loss_goes_on_in_the_next_run_on_one_clock():
    """Times of a run begin at 0 again: the two minutes, and the half minute of a change, go on."""
    first = published({(900, STEPS): 0.5}, {(900, STEPS): 1.0})
    after = published({(0, 100): 0.4, (100, 600): 0.1}, {(0, 600): 1.0}, {(0, 600): 1.0}, changes=(500,))
    happened = told((0, 0, first), (1, 0, after), names=("one", "two"))
    assert [(each["kind"], each["run"]) for each in happened] == [(LOSS, "one"), (CHANGE, "two"), (RECOVERY, "two")]
    loss, change, recovery = happened
    assert loss["time"] == pytest.approx(360.0) and loss["given"] == pytest.approx(40.6, abs=0.5)
    assert loss["effectiveness"] == 0.1  # of 120 s after the alarm, in the second run
    assert change["time"] == pytest.approx(200.0) and recovery["time"] == pytest.approx(240.0)


def test_a_model_of_a_checkpoint_has_changed_before():
    """Counts begin at the first step; an alarm that is on already is told as one."""
    watch, row = EventWatch(FILTERS), np.array([0.4, 1, 0.1, 0, 1, 0, 1, 0, 3, 2], float)
    (alarm,) = watch.see(0.0, row)
    assert alarm.is_alarm and alarm.low > 0
    assert [event.kind for event in watch.see(200.0, row + np.eye(10)[8])] == [CHANGE]


def test_a_clock_that_begins_anew_leaves_no_negative_times():
    watch, row = EventWatch(FILTERS), np.array([0.4, 1, 0.1, 0, 1, 0, 0, 0, 0, 0], float)
    watch.see(1e9, row)
    (given,) = watch.see(5.0, row + np.eye(10)[6])
    assert given.given == 0.0


def test_steps_that_were_not_made_are_passed_over():
    some = published({(100, 300): 0.5}, {(100, 300): 1.0})
    for array in some.values():
        array[150:160] = np.nan
    assert [each["kind"] for each in told((0, 0, some))] == [LOSS, RECOVERY]


def test_changes_within_half_a_minute_are_one_event():
    assert [each["filters"] for each in told((0, 0, published(changes=(100, 150))))] == [list(FILTERS)]
    happened = told((0, 0, published(changes=(100, 300))))
    assert [(each["kind"], each["filters"]) for each in happened] == [(CHANGE, [name]) for name in FILTERS]


def test_a_loss_explains_the_changes_that_follow_at_once():
    happened = told((0, 0, published({(100, 900): 0.5}, {(100, 900): 1.0}, changes=(110, 600))))
    assert [each["kind"] for each in happened] == [LOSS, CHANGE, RECOVERY]


def test_a_watch_on_board_says_a_loss_again_when_the_filters_have_it():
    watch, row = EventWatch(FILTERS), np.array([0.4, 1, 0, 0, 1, 0, 0, 0, 0, 0], float)
    (alarm,) = watch.see(10.0, row)
    assert alarm.is_alarm and alarm.sentence == "the left thruster gives 40 % of its thrust"
    assert watch.see(10.4, row) == []
    given = row.copy()
    given[[2, 6]] = 0.1, 1.0
    (update,) = watch.see(20.0, given)
    assert not update.is_alarm
    assert update.sentence == (
        "the left thruster gives 40 % of its thrust (24 ... 56 %); joint and joint_averaged got this after 10 s"
    )
    assert watch.losses == {0: update}
    (healed,) = watch.see(30.0, np.array([1, 1, 0, 0, 0, 0, 0, 0, 0, 0], float))
    assert healed.sentence == "the left thruster gives its full thrust again" and watch.losses == {}
