"""How people see and answer an alarm, and what a node says of both sides, of time that stands still, and of tracks."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from usvlearn.core.events import BOTH, LOSS, RECOVERY, Event, EventWatch
from usvlearn.live.alarms import ACKNOWLEDGE, FILE, RESET, Alarms
from usvlearn.live.health import Pace
from usvlearn.live.node import Node
from usvlearn.live.plan_requests import Point
from usvlearn.live.service_intervals import ServiceIntervals
from usvlearn.live.status import alike


class Boat(SimpleNamespace):
    """What `Alarms` needs of a node."""

    def reset_alarm(self):
        self.loss, self.resets = None, getattr(self, "resets", 0) + 1


def test_an_alarm_tells_since_when_and_is_acknowledged_and_reset_by_files(tmp_path):
    boat = Boat(last=100.0, loss=Event(40.0, LOSS, "left", 0.4, 0.2, 0.6))
    alarms = Alarms(tmp_path)
    told = "the left thruster gives 40 % of its thrust (20 ... 60 %); no filter has got this yet, since 60 s"
    assert alarms.sentence(boat) == told
    (tmp_path / FILE.format(ACKNOWLEDGE)).touch()
    alarms.obey(boat)
    assert alarms.sentence(boat).endswith(", since 60 s, acknowledged") and not any(tmp_path.iterdir())
    (tmp_path / FILE.format(RESET)).touch()
    alarms.obey(boat)
    assert boat.resets == 1 and alarms.sentence(boat) == "" and not any(tmp_path.iterdir())
    boat.loss = Event(120.0, LOSS, "right", filters=("joint",), given=12.0, effectiveness=0.3)
    boat.last = 150.0
    assert alarms.sentence(boat) == "the right thruster gives 30 % of its thrust; joint got this after 12 s, since 30 s"


def test_a_middleware_answers_an_alarm(tmp_path):
    boat, alarms = Boat(last=100.0, loss=Event(40.0, LOSS, "left", 0.4)), Alarms(tmp_path)
    assert alarms.ask(" Acknowledge\n") and not alarms.ask("silence") and not alarms.ask("")
    alarms.obey(boat)
    assert alarms.sentence(boat).endswith("acknowledged") and alarms.ask(RESET)
    alarms.obey(boat)
    alarms.obey(boat)
    assert boat.resets == 1 and alarms.sentence(boat) == ""


EVIDENCE = "evidence", "sums", "held", "together", "raised"


def test_a_reset_clears_the_evidence_and_what_the_filters_were_told():
    leaf = {name: np.ones(2) for name in (*EVIDENCE, "moments")}
    state = {f"monitors.thrusters.{name}": x for name, x in leaf.items()} | {"accommodation.handed": np.ones(2)}
    node = SimpleNamespace(online=SimpleNamespace(state=dict(state), description={}))
    Node.reset_alarm(node)
    found = node.online.state
    assert all((found[f"monitors.thrusters.{name}"] == 0).all() for name in EVIDENCE)
    assert (found["monitors.thrusters.moments"] == 1).all() and (found["accommodation.handed"] == 0).all()


def test_a_change_tells_how_much_slower_the_boat_is():
    node = SimpleNamespace(_full=math.nan, _before_change=math.nan, changed="")
    Node.compare_full_speed(node, 2.0)
    assert node.changed == ""
    node._before_change = node._full
    Node.compare_full_speed(node, 1.76)
    assert node.changed == "since it has changed, the boat is slower at the same command by 12 %"


def row(raised, share=(1.0, 1.0)):
    return [*share, 0.1, 0.1, *raised, 0.0, 0.0]


def test_a_loss_that_nothing_tells_apart_is_one_event_of_both_sides():
    watch = EventWatch()
    assert watch.see(0.0, row((0, 0))) == []
    (loss,) = watch.see(1.0, row((1, 1), (0.5, 0.5)))
    assert loss.kind == LOSS and loss.side == BOTH and loss.is_alarm
    assert loss.sentence.startswith("the boat gives 50 % of the thrust of both sides (34 ... 66 %)")
    (end,) = watch.see(2.0, row((0, 0)))
    assert end.kind == RECOVERY and end.sentence == "the boat gives its full thrust again"


def test_a_loss_of_both_sides_becomes_that_of_one():
    watch = EventWatch()
    watch.see(0.0, row((0, 0)))
    watch.see(1.0, row((1, 1), (0.7, 0.7)))
    (end,) = watch.see(2.0, row((1, 0), (0.5, 1.0)))
    assert end.sentence == "the right thruster gives its full thrust again"
    assert [event.side for event in watch.losses.values()] == ["left"]


@pytest.mark.parametrize(
    ("steps", "learned", "told"),
    [(2.5, 2.5, None), (0.0, 0.0, "stamps of the messages stand still"), (2.5, 0.0, "nothing is learned")],
    ids=["all", "no step", "nothing learned"],
)
def test_ok_is_not_said_while_nothing_is_learned(steps, learned, told):
    """Steps and learned speeds of a real second; those of a healthy node at 0.4 s are 2.5."""
    pace, node = Pace(1.0), SimpleNamespace(grid=0, learned=0, dt=0.4)
    for second in range(60):
        node.grid, node.learned = round(steps * second), round(learned * second)
        found = pace.judged(node, 1000.0 + second)
    assert (found is None) if told is None else told in found.sentence


def test_messages_that_are_lost_are_told_within_a_minute_by_what_was_learned_before():
    pace, node, told = Pace(1.0), SimpleNamespace(grid=0, learned=0, dt=0.4), {}
    for second in range(300):
        node.grid, node.learned = round(2.5 * second), node.learned + (1 if 100 < second < 200 else 2)
        if (cause := pace.judged(node, 1000.0 + second)) is not None:
            told[second] = cause
    assert 100 < min(told) < 160 and max(told) < 250
    assert told[190].sentence == "many messages are lost"
    assert "45 speeds were learned in the last 45 s, and 90 before" in told[190].warning


def test_a_warning_whose_figures_change_is_the_same():
    one, other = (f"surge: {share} % of {count} messages rejected" for share, count in ((6, 6946), (5.5, "7,012")))
    assert alike(one) == alike(other) != alike("heading: 6 % of 6946 messages rejected")


@pytest.mark.parametrize("held", [False, True])
def test_ellipses_hold_nine_in_ten_of_the_places_that_follow(held):
    """A boat that goes at 1 m/s, to and fro about its track by 0.5 m ahead and 0.2 m across."""
    rng, ellipses = np.random.default_rng(1), ServiceIntervals((2.0,), 0.4, 2, held)
    heading, inside = 0.6, []
    along, aside = np.array([math.cos(heading), math.sin(heading)]), np.array([-math.sin(heading), math.cos(heading)])
    point = Point(2 * along[0], 2 * along[1], math.degrees(heading), math.inf, math.inf, math.nan)
    commands, waiting = np.array([0.5, 0.5]), []
    for k in range(6000):
        time, scatter = 0.4 * k, rng.normal(0, (0.5, 0.2))
        place = time * along + scatter[0] * along + scatter[1] * aside
        ellipses.take(time, place, commands)
        while waiting and waiting[0][0] <= k:
            _, begin, known = waiting.pop(0)
            if math.isfinite(known.major):
                off = place - begin - 2 * along
                axis = math.radians(known.bearing)
                u, v = off @ [math.cos(axis), math.sin(axis)], off @ [-math.sin(axis), math.cos(axis)]
                inside.append((u / known.major) ** 2 + (v / known.minor) ** 2 <= 1)
        ellipses.expect(time, {2.0: np.add(place, point[:2])}, heading, commands)
        waiting.append((k + 5, place, ellipses.put({2.0: point}, heading)[2.0]))
    assert np.mean(inside) == pytest.approx(0.9, abs=0.03) and len(inside) > 5000
    last = waiting[-1][2]
    assert last.bearing == pytest.approx(math.degrees(heading), abs=8) and last.major > 2 * last.minor


def test_ellipses_of_held_commands_learn_nothing_from_commands_that_change():
    ellipses = ServiceIntervals((2.0,), 0.4, 2, held=True)
    point = {2.0: Point(2.0, 0.0, 0.0, math.inf, math.inf, math.nan)}
    for k in range(500):
        time, commands = 0.4 * k, np.full(2, 0.5 if k % 4 else 0.9)
        ellipses.take(time, np.array([time, 0.0]), commands)
        ellipses.expect(time, {2.0: np.array([time + 2.0, 0.0])}, 0.0, commands)
    assert math.isinf(ellipses.put(point, 0.0)[2.0].major)
