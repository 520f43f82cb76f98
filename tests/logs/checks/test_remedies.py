"""The overrides that a finding proposes are legal, differ from what is configured, and make the finding go away."""

import math
import shlex

import numpy as np
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.support import few
from tests.support.mistakes import TOP, boats, changed, frozen, then, times, with_positions, with_yaw_rate
from usvlearn.logs.channels.channel import COMMANDS, METRES, SURGE, Channel
from usvlearn.logs.channels.derived_surge import derived_surge
from usvlearn.logs.checks.data_check import check_data
from usvlearn.logs.recordings import align_fleet
from usvlearn.logs.setup import sources_of
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet

UNITS = {"heading": "rad", SURGE: "m/s", "yaw_rate": "rad/s", "north": "m", "east": "m"} | dict.fromkeys(
    ("latitude", "longitude"), "deg"
)


@pytest.fixture(scope="module")
def patrol():
    return fleet(n=1, plant="heron", hours=0.25, mission_minutes=15.0, missions=["patrol"], seed=5,
                 autopilot=Autopilot(lowest=-1.0), aborted_share=0.0)  # fmt: skip


def read(raw, channels):
    """What a reader makes of recordings in the units of a log."""
    sources = sources_of(channels)
    recordings = []
    for one in raw:
        series = {}
        for name, source in sources.items():
            time, value, order = one.channels[source.name][:3]
            how = source.held, source.window, source.delay, 0.0
            series[name] = Channel(time, source.convert(value), order, *how)
        if SURGE not in series:
            series[SURGE], _ = derived_surge("log", series)
        recordings.append(one._replace(channels=series, dropped={}))
    return recordings


def findings(raw, channels):
    recordings = read(raw, channels)
    try:
        aligned = align_fleet(recordings)
    except ValueError:
        aligned = None
    return check_data(recordings, aligned, {}, TOP["heron"], channels)


def plain(raw):
    """The channels of a log in SI units."""
    return {each: {"name": each, **({"unit": UNITS[each]} if each in UNITS else {})} for each in raw[0].channels}


def with_overrides(channels, key):
    changed = {name: dict(each) for name, each in channels.items()}
    for each in OverridesParser.create().parse_overrides(shlex.split(key)):
        *_, channel, option = each.get_key_element().split(".")
        changed[channel][option] = each.value()
    return changed


def esc(log):
    return {name: log[name]._replace(value=1000 + 1000 * np.clip(log[name].value, 0, 1)) for name in COMMANDS}


def another_boat(log):
    rng = np.random.default_rng(3)
    return {name: log[name]._replace(value=np.cumsum(rng.normal(0, 1, len(log[name].time)))) for name in METRES}


def degrees_and_minutes(log):
    places = (52 + log["north"].value / 111195, 10 + log["east"].value / 68458)
    values = {name: 100 * np.floor(x) + 60 * (x % 1) for name, x in zip(("latitude", "longitude"), places, strict=True)}
    return {name: log[METRES[0]]._replace(value=value) for name, value in values.items()}


WRONG = {  # what is wrong -> the log, options of its channels, the kind of the finding, what it proposes
    "a speed controller without reverse": (
        esc, {name: {"zero": 1500.0, "span": 400.0} for name in COMMANDS}, "command scale", "span=500"),
    "radians that were converted twice": (
        times(math.radians(1), "heading"), {}, "heading unit", "heading.span=0.0174533"),
    "a yaw rate that was converted twice": (
        then(with_yaw_rate, times(math.radians(1), "yaw_rate")), {}, "yaw rate unit", "yaw_rate.name=null"),
    "the position of another boat": (
        then(with_positions, another_boat), {}, "position", "north.name=null"),
    "degrees and minutes": (
        then(with_positions, degrees_and_minutes), {}, "position unit", "latitude.name=null"),
    "knots": (times(3600 / 1852, SURGE), {}, "speed scale", "surge.unit=knots"),
    "km/h": (times(3.6, SURGE), {}, "speed scale", "surge.unit=km/h"),
    "a right side that is reversed": (times(-1, "command_right"), {}, "side reversed", "command_right.span=-1"),
    "both sides reversed": (times(-1, *COMMANDS), {}, "side reversed", "command_left.span=-1"),
    "percent": (times(100, *COMMANDS), {}, "command scale", "span=100"),
    "hundredths": (times(0.01, *COMMANDS), {}, "command scale", "span=0.0"),
    "degrees": (times(math.degrees(1), "heading"), {}, "heading unit", "heading.unit=deg"),
    "tenths of a degree": (times(10 * math.degrees(1), "heading"), {}, "heading unit",
                           "heading.unit=deg data.channels.heading.span=10"),
    "hundredths as degrees": (times(100 * math.degrees(1), "heading"), {"heading": {"unit": "deg"}}, "heading unit",
                              "heading.span=100"),
    "a yaw rate that froze": (
        then(with_yaw_rate, frozen("yaw_rate", 300, 500)), {}, "frozen", "yaw_rate.name=null"),
    "a speed that froze, beside a position": (
        then(with_positions, frozen(SURGE, 300, 500)), {}, "frozen", "surge.name=null"),
    "a speed of zeros, beside a position": (
        then(with_positions, times(0, SURGE)), {}, "constant", "surge.name=null"),
}  # fmt: skip


@pytest.mark.parametrize("name", few(WRONG, list(WRONG)[:3], "thorough"))
def test_what_is_proposed_differs_and_helps(name, patrol):
    change, options, kind, proposed = WRONG[name]
    raw = changed(patrol, change)
    names = [each for each in raw[0].channels if not ("latitude" in raw[0].channels and each in METRES)]
    channels = {each: keys | options.get(each, {}) for each, keys in plain(raw).items() if each in names}
    those = [each for each in findings(raw, channels) if each.kind == kind]
    assert those and all(proposed in each.key for each in those), those
    for each in those:
        other = with_overrides(channels, each.key.split(" or ")[0])
        assert other != channels, "the key only repeats what is configured"
        channels = other
    assert kind not in [each.kind for each in findings(raw, channels)]


def test_rows_out_of_order_are_told_and_no_window_is_proposed(patrol):
    def shuffled(log):
        late = {name: np.argsort(x.time + 4.5 * (x.time // 1 % 3 == 1), kind="stable") for name, x in log.items()}
        return {name: x._replace(time=x.time[late[name]], value=x.value[late[name]]) for name, x in log.items()}

    raw = changed(patrol, shuffled)
    those = [each for each in findings(raw, plain(raw)) if each.kind == "stale"]
    assert {"heading", "command_left"} <= {each.about for each in those} and "yaw_rate" not in [x.about for x in those]
    assert all(each.key == "" and "sort the rows" in each.expected for each in those)


def test_speeds_before_their_commands_say_what_to_do():
    def late(log):
        return {name: log[name]._replace(time=log[name].time + 60) for name in COMMANDS}

    raw = changed(boats("heron", 0, 0.25), late)
    (finding,) = (each for each in findings(raw, plain(raw)) if each.kind == "delay")
    assert finding.key == "" and "to the stamps of the speed" in finding.expected
