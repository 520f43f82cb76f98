"""The core of the node: what it publishes of each step."""

import io
import json
import math
from itertools import pairwise

import numpy as np
import pytest

from tests.support.live import boat, messages, sail
from usvlearn.core import checkpoint
from usvlearn.core.events import LOSS, Event
from usvlearn.engine.online import Online
from usvlearn.errors import ConfigError
from usvlearn.live import diagnostics
from usvlearn.live.health import COMPILING, Refit
from usvlearn.live.moos.block import MIDDLEWARE
from usvlearn.live.node import Node
from usvlearn.live.node_folder import NodeFolder
from usvlearn.live.plan_requests import parse_plan, sampled
from usvlearn.live.prior import prior
from usvlearn.live.service_intervals import ServiceIntervals
from usvlearn.live.start import Options, begin
from usvlearn.live.status import PLANNED, TABLE, TRACK, WIDTH, StatusLine, of_health, of_step, page, summary_of
from usvlearn.logs.alignment.align import Aligner
from usvlearn.logs.alignment.mixing import Mix, sides_of
from usvlearn.logs.channels.channel import REQUIRED, Source
from usvlearn.logs.channels.derived_surge import COURSES, VELOCITIES
from usvlearn.logs.setup import Setup
from usvlearn.simulate.fault import Fault
from usvlearn.simulate.fleet import fleet


def node(start, channels=None, **options) -> Node:
    setup = Setup.of(checkpoint.load(start)[1]["setup"])
    if channels is not None:
        setup = Setup(channels, setup.align)
    return Node(setup, Online.open(start), **options)


@pytest.mark.parametrize(("dt", "last"), [(0.4, 30.0), (0.05, 30.0), (0.03, 10.0)])
def test_a_horizon_of_more_steps_than_a_forecast_has_is_left_out(start, dt, last):
    setup = node(start).setup
    assert max(Node(Setup(setup.channels, {**setup.align, "dt": dt}), Online.open(start)).horizons) == last


def test_the_next_prediction_is_that_of_the_next_step_where_the_commands_stay(start):
    """With all inputs constant, what is predicted of the next step is what is then predicted of it."""
    one, steps = node(start), []
    for k in range(300):
        values = {"command_left": 0.5, "command_right": 0.5, "heading": 1.0, "surge": 1.0 + 0.02 * (k % 5)}
        for name, value in values.items():
            steps += one.push(name, 5.0 + 0.1 * k, value)
    for before, after in pairwise(steps[20:]):
        assert before.next == pytest.approx(after.speed, abs=1e-12)
        assert (before.next_low, before.next_high) == pytest.approx((after.low, after.high), abs=1e-12)


@pytest.mark.thorough
def test_a_plan_is_answered_by_the_forecast_of_its_commands(start):
    """Also with delays, and the commands in force until the first row; in both forms."""
    one = node(start)
    sail(one, messages(boat(0.1), 0.0))
    ahead = one._aligner.ahead(75)
    plan = {"t": [0, 4], "left": [0.5, 0.8], "right": [0.5, 0.6], "heading": [1.0, 1.5]}
    reply = json.loads(one.answer(json.dumps({"id": "A", **plan})))
    commands = np.where(np.arange(75)[:, None] < 10, [0.5, 0.5], [0.8, 0.6])
    headings = np.interp(0.4 * np.arange(75), [0.0, 4.0], [1.0, 1.5])
    turns = np.where(np.arange(75) < 10, 0.125, 0.0)
    expected = one.online.forecast(commands, headings, turns, 0.4)
    np.testing.assert_allclose(reply["surge"], expected.surge, atol=6e-4)
    np.testing.assert_allclose([math.inf if x is None else x for x in reply["high"]], expected.high, atol=6e-4)
    assert reply["id"] == "A" and reply["time"] == pytest.approx(one.last, abs=1e-3) and reply["t"][-1] == 30.0
    rows = dict(each.split("=") for each in one.answer("t,left,right\n2,0.5,0.5\n4,0.8,0.6").split(","))
    commands[:5, 0], commands[:5, 1] = ahead.command_left[:5], ahead.command_right[:5]
    expected = one.online.forecast(commands, ahead.heading, ahead.yaw_rate, 0.4)
    numbers = [[float(x) for x in (each if ":" in each else f"{each}:-inf:inf").split(":")] for each in rows.values()]
    np.testing.assert_allclose(numbers, np.stack(expected[1:], -1), atol=6e-4)
    late = Setup.of({**one.setup.json(), "channels": {
        name: {**each, "delay": 0.8 if name.startswith("command") else 0.0}
        for name, each in one.setup.json()["channels"].items()}})  # fmt: skip
    other = Node(late, Online.open(start))
    sail(other, messages(boat(0.1), 0.0))
    plan = parse_plan("0,1,1")
    commands = sampled(plan, 0.4 * np.arange(76) - 0.8, other._aligner.ahead(75).command_left, "left")
    assert (commands[:2] == other._aligner.ahead(2).command_left).all() and (commands[2:] == 1.0).all()
    assert "plan" not in one.counts


@pytest.mark.parametrize(("text", "sentence"), [
    ("", "found 0 rows"), ("a", "found 'a' in row 1, expected rows t,left,right"), ("0,1", "found '0,1' in row 1"),
    ("0,60,60", "found left 60 in row 1, expected -1 to 1, shares of full scale"),
    ("0,1,1;0,1,1", "times t that do not rise"), ("-1,1,1", "times t that do not rise"),
    ("0,1,1;1,1,1,1", "found '1,1,1,1' in row 2"), ("0,nan,1", "found left nan in row 1"), ("inf,1,1", "found t inf"),
    ("1000,1,1", "found t 1000, expected at most 239.6 s"), ("1e308,1,1", "found t 1e+308, expected at most 239.6 s"),
    ("0,1,1;" * 2000, "found 2000 rows"),
    ("0" * 200_000, "found 200000 characters"), ("{", "found no JSON"), ("[" * 5000, "no JSON"), ("[]", "without"),
    ('{"t": [0], "left": [1]}', "JSON without lists t, left and right"),
    ('{"t": [0], "left": [1], "right": [1, 1]}', "lists of different lengths"),
    ('{"t": [0], "left": [true], "right": [1]}', "found left True"),
    ('{"t": [0], "left": ["\\u001b"], "right": [1]}', "found left"),
    ('{"t": [0], "left": [1], "right": [1], "speed": 3}', "found the key 'speed'"),
    ('{"id": 1e999, "t": [0], "left": [1], "right": [NaN]}', "found right nan"),
    ('{"t": [0], "left": [' + "9" * 4000 + '], "right": [1]}', "found left 999"),
    ('{"t": [0], "left": [1], "right": [1], "heading": [1e12]}', "headings: found"),
])  # fmt: skip
def test_a_bad_plan_is_answered_by_a_sentence_and_counted(start, text, sentence):
    one = node(start)
    sail(one, messages(boat(0.02), 0.0))
    reply = one.answer(text)
    reply = json.loads(reply)["error"] if text[:1] in ("{", "[") else reply.removeprefix("error: ")
    assert sentence in reply and len(reply) < 300 and "\n" not in reply
    assert one.counts["plan"] == {"refused": 1}


@pytest.mark.thorough
def test_a_plan_is_answered_where_the_longest_forecast_has_more_steps_than_an_answer(start):
    one = node(start)
    setup = Setup.of({**one.setup.json(), "align": {**one.setup.align, "dt": 0.04}})
    one = Node(setup, one.online)
    sail(one, messages(boat(0.02), 0.0))
    reply = json.loads(one.answer('{"t": [0], "left": [1], "right": [1]}'))
    assert len(reply["surge"]) == 250 and reply["t"][-1] == 10.0  # 30 s have more steps than a forecast


def test_a_plan_without_inputs_is_answered_so(start):
    assert node(start).answer("0,1,1").startswith("error: plan: no forecast can be made now")


@pytest.mark.thorough
def test_a_lost_thruster_is_told_and_stays_told(start):
    fault = Fault(side="left", share=0.4, minute=10.0)
    log = fleet(
        n=1, hours=25 / 60, mission_minutes=25.0, missions=["lawn_mower"], aborted_share=0.0, paused_share=0.0,
        fault=fault,
    )[0]  # fmt: skip
    one = node(start)
    steps = sail(one, messages(log, 0.0))
    alarm, given = (event for step in steps for event in step.events if event.kind == LOSS)
    assert 600.0 < alarm.time - one.origin < 700.0 and one.loss.side == "left" and one.alarms == 1
    assert alarm.is_alarm and alarm.low < 0.4 < alarm.high and given.given == pytest.approx(10.0, abs=0.41)
    assert given.low < 0.4 < given.high and one.loss.low < 0.4 < one.loss.high


@pytest.mark.thorough
def test_one_command_for_both_sides_makes_the_steps_of_two_equal_ones(start):
    channels = Setup.of(checkpoint.load(start)[1]["setup"]).channels
    given = {**channels, "command_right": channels["command_left"]}
    both, two = node(start, given), node(start)
    taken: tuple[list, list] = [], []
    for name, stamp, value in messages(boat(0.05), 0.0):
        if name != "command_right":
            parts = ("command_left", "command_right") if name == "command_left" else (name,)
            for one, steps in zip((both, two), taken, strict=True):
                steps += [step for part in parts for step in one.push(part, stamp, value)]
    assert both.one_command and not two.one_command and len(taken[0]) > 400
    np.testing.assert_array_equal(*([step.speed for step in steps[1:]] for steps in taken))


def test_throttle_and_steering_make_the_sides(start):
    sides = sides_of({"name": "T", "unit": "percent", "held": True}, {"name": "S"})
    channels = Setup.of(checkpoint.load(start)[1]["setup"]).channels
    one = node(start, {**channels, **{side: Mix.of(each) for side, each in sides.items()}})
    taken = []
    one.took = lambda *message: taken.append(message)
    for side in ("left", "right"):
        one.push(f"command_{side}[0]", 1.0, 80.0)
        one.push(f"command_{side}[1]", 1.0, 30.0)
    assert taken == [("command_left", 0.0, 1.0), ("command_right", 0.0, pytest.approx(0.5))]
    assert not one.one_command


@pytest.mark.parametrize(("given", "sentence"), [
    ({"steering": {"name": "S"}}, "steering: found it without throttle"),
    ({"throttle": {"name": "T"}, "command_left": {"name": "L"}}, "command_left: found it beside throttle"),
    ({"throttle": {"name": ["T", "U"]}}, r"throttle: found \['T', 'U'\], expected the name of one signal"),
    ({"throttle": {"span": 2.0}}, "throttle: found None, expected the name of one signal"),
    ({"throttle": {"name": "T"}, "steering": {"name": "S", "unit": "percent"}}, "steering.unit: .* without throttle"),
    ({"throttle": {"name": "T"}, "steering": {"name": "S", "delay": 0.2}}, "steering.delay: .*that of the throttle"),
    ({"throttle": {"name": "T", "weight": [1.0]}}, "throttle.weight: found"),
])  # fmt: skip
def test_a_wrong_throttle_is_one_sentence(tmp_path, given, sentence):
    with pytest.raises(ConfigError, match=sentence):
        begin(NodeFolder(tmp_path), Options(tmp_path, mass=36.0, surge_max=3.0, channels=given), MIDDLEWARE)


def test_a_set_of_two_sides_can_be_continued_with_one_command_and_back(tmp_path):
    def setup(facts, **channels):
        options = Options(tmp_path, mass=36.0, surge_max=3.0, channels={k: {"name": v} for k, v in channels.items()})
        (tmp_path / "start.safetensors").unlink(missing_ok=True)
        leaves, known = prior(36.0, 3.0)
        checkpoint.save(tmp_path / "start.safetensors", leaves, **known, **facts)
        return begin(NodeFolder(tmp_path), options, MIDDLEWARE).setup

    sides = setup({})
    mixed = setup({"setup": sides.json()}, throttle="T", steering="S")
    assert mixed.channels["command_right"].weights == (1.0, -1.0)
    one = setup({"setup": mixed.json()}, throttle="T")
    assert one.one_command and one.channels["command_left"].unit == "percent"
    assert setup({"setup": mixed.json()}, command_left="DESIRED_THRUST_L", command_right="DESIRED_THRUST_R") == sides


def test_one_throttle_is_not_read_in_two_ways(tmp_path):
    """A checkpoint with a reversed left side made the throttle ahead on the right and astern on the left."""
    leaves, known = prior(36.0, 3.0)
    facts = begin(NodeFolder(tmp_path), Options(tmp_path, mass=36.0, surge_max=3.0), MIDDLEWARE).setup.json()
    facts["channels"]["command_left"]["span"] = -1.0
    checkpoint.save(tmp_path / "start.safetensors", leaves, **known, setup=facts)
    with pytest.raises(ConfigError, match=r"found span -1.0 of command_left and 1.0 of .*: give throttle.span"):
        begin(NodeFolder(tmp_path), Options(tmp_path, channels={"throttle": {"name": "T"}}), MIDDLEWARE)
    channels = {"throttle": {"name": "T", "span": 1.0}}
    assert begin(NodeFolder(tmp_path), Options(tmp_path, channels=channels), MIDDLEWARE).setup.one_command


@pytest.mark.thorough
def test_what_an_interval_does_not_tell_is_no_number(start):
    """The top speed of a prior is 3 m/s, and its interval reaches from -61 to 67 m/s."""
    before = Online.of(*prior(36.0, 3.0))
    assert before.identified()["steady_speed_full"].high > 60
    quantities, wrong = diagnostics.identified(before)
    assert wrong == ""
    assert all(math.isnan(value) for value, *_ in quantities.values()) and len(quantities) == 18
    health = COMPILING._replace(state="ok", identified=quantities)
    lines = page(health)
    assert "steady speed full     not known yet" in lines and not any("(" in line for line in lines if "steady" in line)
    assert "PARAMS" not in [post.name for post in of_health(health)]
    learned, log = node(start), boat(0.5, seed=3)
    sail(learned, messages(log, 0.0))
    value, low, high, _ = diagnostics.identified(learned.online)[0]["steady_speed_full"]
    assert low < value < high < 2 * value


def test_the_surge_is_computed_from_ground_speed_and_course(start):
    channels = {name: Source(name) for name in ("command_left", "command_right", "heading", *COURSES)}
    one = node(start, channels)
    one.push("heading", 10.0, 0.5)
    one.push(COURSES[0], 10.1, 2.0)
    one.push(COURSES[1], 10.1, 0.5 + math.pi / 3)
    assert one.derived == pytest.approx(1.0)
    one.push(VELOCITIES[0] if VELOCITIES[0] in channels else "heading", 10.2, 0.5)
    assert one.derived is None


def test_a_part_that_is_not_known_is_refused(start):
    with pytest.raises(ConfigError, match="part: found 'speed', expected one of command_left"):
        node(start).push("speed", 1.0, 1.0)


def test_what_lies_ahead_is_what_the_next_steps_see():
    """Commands stay in force, a command that was posted takes effect after its delay, the heading turns on."""
    side = {"held": True, "delay": 0.5}
    sources = {name: Source(name, **(side if name.startswith("command") else {})) for name in REQUIRED}
    aligner, samples = Aligner(sources, dt=0.4), []
    for k in range(41):
        left = 0.2 if k < 38 else 0.8
        for name, value in {"command_left": left, "command_right": 0.3, "heading": 0.05 * k, "surge": 1.0}.items():
            samples += aligner.push(name, 0.1 * k, value)
    ahead = aligner.ahead(3)
    after = samples[-1][0]  # 3.6; the left command of 0.8 takes effect at 3.8 + 0.5
    expected = [0.2, 0.2 + 0.6 * (after + 0.8 - 4.3) / 0.4, 0.8]
    np.testing.assert_allclose(ahead.command_left, expected, atol=1e-9)
    np.testing.assert_allclose(ahead.command_right, 0.3)
    np.testing.assert_allclose(ahead.yaw_rate, 0.5, rtol=1e-6)
    np.testing.assert_allclose(np.diff(ahead.heading), 0.2, rtol=1e-6)
    later = aligner.ahead(26)  # the turn goes on for 1.2 s and then ends
    np.testing.assert_allclose(later.yaw_rate[:4], 0.5, rtol=1e-6)
    np.testing.assert_allclose(later.yaw_rate[10], 0.5 * np.exp(-(4.0 - 1.2) / 1.2), rtol=1e-6)
    np.testing.assert_allclose(np.diff(later.heading), 0.4 * later.yaw_rate[:-1], rtol=1e-6)
    aligner.push("surge", 9.0, 1.0)
    assert np.isnan(aligner.ahead(1).heading[0]), "the last heading is too old"


def test_posts_are_those_of_the_table(start):
    one = node(start)
    steps = sail(one, messages(boat(0.02)))
    network = {"contracting": True, "condition": "exact", "rate": 0.9, "time_constant": None, "equilibrium": 0.1}
    quantities = {"drag_linear": (-1.0, -2.0, 0.0, "kg/s")}
    health = COMPILING._replace(state="ok", identified=quantities, contraction={"rnn": network}, refit=Refit())
    posts = of_step(steps[-1]._replace(events=(Event(1.0, LOSS, "left", 0.4),)), members=True) + of_health(health)
    kinds = {each.name: each.kind for each in TABLE}
    assert {post.name for post in posts} == set(kinds) - {PLANNED, TRACK, "TRACK_IF_HELD"}
    assert all((kinds[post.name] == "D") == isinstance(post.value, float) for post in posts)
    assert all(len(each.short) <= 10 for each in TABLE)
    first = of_step(steps[0])
    assert not any(isinstance(post.value, float) and not math.isfinite(post.value) for post in first)
    assert "state=ok" in summary_of(health)
    lines = page(health._replace(warnings=("ü" * 200,), sentence="x " * 100), steps[-1])
    assert all(len(line) <= WIDTH and line.isascii() for line in lines)
    text = "\n".join(page(health, steps[0]._replace(measured=math.nan, speed=math.nan, next=math.nan)))
    assert "measured unknown, predicted unknown" in text and "nan" not in text.lower()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_line_in_a_terminal_is_replaced_and_a_file_has_only_changes(start):
    one = node(start)
    steps = sail(one, messages(boat(0.02)))
    health = COMPILING._replace(state="ok", sentence="ok; 12 steps", steps=12, counts={"surge": {"stale": 2}})
    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file):
        line = StatusLine("node", stream)
        for _ in range(3):
            line.show(health, steps[-1])
        line.say("an alarm\x1b[2J")
        line.show(health._replace(state="stale", sentence="no surge (V) for 3 s; 12 steps"), None, "no link")
        line.show(health._replace(state="stale", sentence="no surge (V) for 4 s; 12 steps"), None, "no link")
        line.close()
    assert file.getvalue().splitlines() == ["node: ok", r"node: an alarm\x1b[2J", "node: no surge (V); no link"]
    assert terminal.getvalue().count("\r") >= 6 and "predicted" in terminal.getvalue()
    assert terminal.getvalue().endswith("not saved yet\n")


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "seed"), [("lawn_mower", 31), ("patrol", 32)])
def test_forecasts_of_held_commands_have_intervals_that_hold_whatever_is_commanded(start, kind, seed):
    """The intervals that assume that the commands stay hold half of the speeds 10 s ahead, or less."""
    one, log = node(start), fleet(n=1, hours=1.0, seed=seed, missions=[kind])[0]
    steps = sail(one, messages(log, 0.0))
    speed = {round(step.time, 1): step.measured for step in steps}
    inside, narrow = [], []
    for step in steps[250:]:  # 100 s
        later = speed.get(round(step.time + 10.0, 1), math.nan)
        if step.forecasts and math.isfinite(later):
            inside.append(step.forecasts[10.0][1] <= later <= step.forecasts[10.0][2])
            narrow.append(step.if_held[10.0][1] <= later <= step.if_held[10.0][2])
            assert step.forecasts[10.0][0] == step.if_held[10.0][0]
    assert len(inside) > 1500 and 0.8 < np.mean(inside) < 0.97 and np.mean(narrow) < 0.7
    again = ServiceIntervals(one.horizons, one.dt)
    again.load(json.loads(json.dumps(one.held.json())))
    assert all(again.halfwidth(h) == pytest.approx(one.held.halfwidth(h), abs=1e-3) for h in one.horizons)


@pytest.mark.parametrize("given", [None, 3, {"2": [0.9, -1.0]}, {"2": ["a"]}, {"2": [math.nan] * 20}, {"2": [0.1] * 20},
                                   {"2": []}, {"2": [0.9] * 1000}, {"2": [True] * 20}])  # fmt: skip
def test_intervals_of_a_foreign_set_begin_anew(given):
    held = ServiceIntervals([2.0], 0.4)
    held.load(given)
    assert held.halfwidth(2.0) == math.inf
