"""The data check: every mistake is found and named, and boats without one are left in peace."""

import itertools
import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support import REAL_LOGS, RECORDED, cases, few
from tests.support.mistakes import (
    ALIGN,
    CONFIGURED,
    FAULTS,
    MISTAKES,
    TOP,
    boats,
    changed,
    frozen,
    kinds,
    late,
    then,
    times,
    with_yaw_rate,
)
from usvlearn.composition.configuration import recordings_of
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import AUXILIARY, COMMANDS, SURGE, Channel, Recording
from usvlearn.logs.checks import response
from usvlearn.logs.checks.data_check import check_data, check_level, refuse
from usvlearn.logs.checks.finding import NOTE, WARNING, Finding
from usvlearn.logs.checks.frozen import _command
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet
from usvlearn.simulate.sensors import Sensors

UNKNOWABLE = ("speed in m/s as knots",)  # without positions nothing fixes the scale of a slow speed


@pytest.fixture(scope="module")
def logs():
    return {plant: boats(plant, 0, 0.5) for plant in PLANTS}


def warned(recordings, plant):
    return kinds(recordings, plant, WARNING)


PLANTS = ("heron", "kingfisher", "wamv")
WRONG = list(itertools.product((name for name in MISTAKES if name not in UNKNOWABLE), PLANTS))


@pytest.mark.parametrize(("name", "plant"), few(WRONG, WRONG[::5], "thorough"))
def test_each_mistake_is_found_and_named(name, plant, logs):
    change, expected = MISTAKES[name]
    assert set(kinds(changed(logs[plant], change), plant)) & set(expected)


@pytest.mark.parametrize("plant", ["heron", "kingfisher", "otter"])
@pytest.mark.parametrize("seeds", few([range(3), range(3, 20)], [range(3)], "thorough"))
def test_no_simulated_boat_without_a_mistake_is_warned_of(plant, seeds):
    for seed in seeds:
        assert warned(boats(plant, seed, 0.2), plant) == [], seed


DYING = list(itertools.product(range(len(FAULTS[1:])), ("heron", "kingfisher", "vtec"), range(3)))


@pytest.mark.parametrize(("fault", "plant", "seed"), few(DYING, DYING[::10], "thorough"))
def test_a_dying_thruster_is_no_reversed_side(fault, plant, seed):
    assert warned(boats(plant, seed, 0.25, FAULTS[1 + fault]), plant) == []


def test_commands_that_are_posted_on_change_are_no_finding():
    recordings = fleet(n=1, hours=0.3, sensors=Sensors(commands="on_change"))
    assert kinds(recordings, "heron") == []


@pytest.mark.parametrize("name", RECORDED)
def test_real_boats_as_configured(name):
    if not (REAL_LOGS / name).is_dir():
        pytest.skip(f"the logs of {name} are not here: they are not published with this project")
    recordings, settings = recordings_of(name, {"data": {"path": str(REAL_LOGS / name)}})
    recordings, surge_max = list(recordings), settings["vehicle"]["surge_max"]
    aligned = align_fleet(recordings, **settings["align"])
    findings = check_data(recordings, aligned, settings["align"], surge_max, settings["data"]["channels"])
    assert findings == []
    if name == "blueboat":  # its logs name the sides the other way round
        left, right = COMMANDS
        sides = [
            one._replace(channels={**one.channels, left: one.channels[right], right: one.channels[left]})
            for one in recordings
        ]
        others = check_data(sides, None, settings["align"], surge_max, settings["data"]["channels"])
        assert [(each.kind, each.severity) for each in others] == [("sides swapped", WARNING)]


def test_findings_say_the_number_and_the_key(logs):
    wrong = changed(logs["heron"], late)
    (finding,) = check_data(wrong, None, ALIGN, TOP["heron"], CONFIGURED)
    assert finding.about == "commands, surge" and finding.severity == WARNING
    assert "10" in finding.found and "behind the commands" in finding.found
    assert finding.key == "" and "s from the stamps of the speed" in finding.sentence()


@pytest.fixture(scope="module")
def patrol():
    return {plant: fleet(n=1, plant=plant, hours=0.25, mission_minutes=15.0, missions=["patrol"], seed=5,
                         autopilot=Autopilot(lowest=-1.0), aborted_share=0.0)
            for plant in ("heron", "vtec", "otter")}  # fmt: skip


@pytest.mark.parametrize("name", [SURGE, "heading", "yaw_rate"])
def test_a_channel_that_freezes_is_told_with_its_run_and_time(name, patrol):
    for plant, recordings in patrol.items():
        whole = changed(recordings, with_yaw_rate) if name == "yaw_rate" else recordings
        (finding,) = (
            each
            for each in check_data(changed(whole, frozen(name, 300, 500)), None, ALIGN, TOP[plant], CONFIGURED)
            if each.kind == "frozen"
        )
        assert (finding.about, finding.severity) == (name, WARNING)
        first, last = (float(each) for each in re.findall(r"from (\d+) to (\d+) s", finding.found)[0])
        assert abs(first - 300) < 3 and abs(last - 500) < 3 and recordings[0].run in finding.found


def test_a_command_that_freezes_while_the_boat_turns_as_before_is_told(patrol):
    for side in COMMANDS:
        wrong = changed(patrol["heron"], frozen(side, 450, 900, 0.1))
        findings = check_data(wrong, None, ALIGN, TOP["heron"], CONFIGURED)
        assert ("frozen", side) in [(each.kind, each.about) for each in findings]


def test_what_stays_equal_for_a_reason_is_not_frozen(patrol):
    (log,) = patrol["heron"]
    surge, heading = log.channels[SURGE], log.channels["heading"]
    coarse = {SURGE: surge._replace(value=np.round(surge.value, 1)),
              "heading": heading._replace(value=np.radians(np.round(np.degrees(heading.value))))}  # fmt: skip

    def rest(log):  # the boat lies still, with thrusters that are off or idle
        return {name: frozen(name, 400, 600, value)(log)[name]
                for name, value in ((SURGE, 0.0), ("heading", None))}  # fmt: skip

    def cruise(log):
        return {name: frozen(name, 400, 600)(log)[name] for name in COMMANDS}

    for change in (lambda log: coarse, rest, cruise, then(rest, cruise)):
        findings = check_data(changed([log], change), None, ALIGN, TOP["heron"], CONFIGURED)
        assert "frozen" not in [each.kind for each in findings], change


def commands_before(seconds):
    return lambda log: {name: log[name]._replace(time=log[name].time - seconds) for name in COMMANDS}


@pytest.mark.parametrize("seconds", few([4, 5, 10], [5], "thorough"))
def test_a_delay_of_seconds_is_told_with_its_key(seconds):
    for plant in ("heron", "otter", "wamv"):
        recordings = boats(plant, 0, 0.6)
        for change, delay in (
            (commands_before(seconds), seconds),  # a speed that comes late
            (then(commands_before(seconds), set_delay(seconds)), None),  # the same, as configured
        ):
            findings = check_data(changed(recordings, change), None, ALIGN, TOP[plant], CONFIGURED)
            keys = [each.key for each in findings if each.kind == "delay"]
            if delay is None:
                assert not keys, (plant, keys)
            else:
                (key,) = keys
                proposed = float(key.split()[0].removeprefix("data.channels.command_left.delay="))
                assert abs(proposed - delay) <= 1, (plant, key)


def set_delay(seconds):
    return lambda log: {name: log[name]._replace(delay=float(seconds)) for name in COMMANDS}


def test_a_configured_delay_that_is_too_long_is_told():
    findings = check_data(changed(boats("heron", 0, 0.6), set_delay(5)), None, ALIGN, TOP["heron"], CONFIGURED)
    (finding,) = [each for each in findings if each.kind == "delay"]
    assert finding.key.split()[0] in ("data.channels.command_left.delay=0", "data.channels.command_left.delay=1")


def test_a_delay_is_told_from_enough_bins_on_and_no_command_freezes_near_its_end():
    fit = response.Fit(4, certainty=5.0, ratio=0.6, explained=0.5, bins=response.ENOUGH)
    assert response._is_told(fit, 0.0) and not response._is_told(fit._replace(bins=fit.bins - 1), 0.0)
    e = SimpleNamespace(commands=(np.linspace(-1, 1, 400), np.linspace(-1, 1, 400)))  # whose turn is not looked at
    assert [_command(e, COMMANDS[0], value, slice(0, 300)) for value in (-0.97, 0.97)] == [None, None]


def test_several_boats_are_checked_apart(logs):
    wrong = [one._replace(boat="other") for one in changed(logs["heron"], times(-1, "command_left"))]
    findings = check_data([*logs["heron"], *wrong], None, ALIGN, TOP["heron"])
    assert {each.boat for each in findings} == {"other"}


def test_a_copied_speed_rejected_and_stale_messages_and_a_clock_that_jumps_are_told(logs):
    (recording, *_) = logs["heron"]

    def found(**channels):
        changed_ = recording._replace(channels={**recording.channels, **channels})
        try:
            aligned = align_fleet([changed_], **ALIGN)
        except LogFormatError:
            aligned = None
        return {each.kind: each for each in check_data([changed_], aligned, ALIGN, TOP["heron"], CONFIGURED)}

    surge, heading = recording.channels[SURGE], recording.channels["heading"]
    place = np.arange(len(surge.time)) // 2 * 2
    copied = surge._replace(value=surge.value[place] + np.random.default_rng(0).normal(0, 0.01, len(place))[place])
    assert found(surge=copied)["repeats"].key == "data.channels.surge.period=0.4"
    slow = heading._replace(time=heading.time[::20], value=heading.value[::20], order=heading.order[::20])
    assert found(heading=slow)["stale"].key.startswith("data.channels.heading.window=")
    rare = {name: recording.channels[name] for name in COMMANDS}
    rare = {name: each._replace(**{key: getattr(each, key)[::40] for key in ("time", "value", "order")})
            for name, each in rare.items()}  # fmt: skip
    assert found(**rare)["stale"].key == "data.channels.command_right.held=true"  # and the left one
    half = len(heading.time) // 2
    back = heading._replace(time=heading.time - 100.0 * (np.arange(len(heading.time)) == half))
    assert found(heading=back)["clock"].severity == NOTE
    turning = recording.channels["heading"]
    rate = Channel(turning.time, np.where(np.arange(len(turning.time)) % 3 == 0, 5.0, 0.0), turning.order)
    assert found(yaw_rate=rate)["rejected"].key == "align.yaw_rate_max=5"


@pytest.mark.parametrize("every", [5, 10])
def test_a_sensor_that_is_repeated_in_a_faster_table_serves_all_steps_that_it_can(logs, every):
    one = logs["heron"][0]
    surge = one.channels[SURGE]
    times = np.arange(surge.time[0], surge.time[-1], 1 / every)
    order = np.linspace(surge.order[0], surge.order[-1], len(times)).astype(int)
    held = Channel(times, np.interp(np.floor(times), surge.time, surge.value), order, period=1.0)
    assert "stale" not in warned([one._replace(channels=one.channels | {SURGE: held})], "heron")


def test_horizons_without_a_step_are_told(logs):
    (finding,) = check_data(logs["heron"], None, ALIGN, TOP["heron"], horizons=(0.1, 0.4, 2.0))
    assert (finding.kind, finding.severity) == ("horizons", NOTE)
    assert "0.1 s" in finding.found and finding.key == "forecasts.horizons=[0.4,2]"


def test_strict_lists_all_warnings_and_no_note():
    findings = [Finding("a", "surge", "x", "1", "2", "k=1"), Finding("b", "heading", "y", "3", "4", severity=NOTE)]
    with pytest.raises(LogFormatError, match=r"check=strict: found 1 warning, expected none: \(1\) a, surge: found 1"):
        refuse(findings)
    refuse(findings[1:])


def test_levels():
    assert [*map(check_level, (None, "warn", "strict", "off", False))] == ["warn", "warn", "strict", "off", "off"]
    for wrong in ("of", True, 3):
        with pytest.raises(ConfigError, match=r"check: found .*, expected one of warn, strict, off"):
            check_level(wrong)


def values(rng, n):
    kinds_ = (
        lambda: np.zeros(n), lambda: np.full(n, np.nan), lambda: rng.normal(size=n) * 10.0 ** rng.integers(-300, 299),
        lambda: rng.choice([0.0, np.nan, np.inf, -np.inf, 1e299], n), lambda: rng.integers(0, 2, n).astype(float),
        lambda: np.cumsum(rng.normal(size=n)), lambda: rng.uniform(0, 360, n),
    )  # fmt: skip
    return kinds_[rng.integers(len(kinds_))]()


def stamps(rng, n):
    kinds_ = (
        lambda: np.arange(n) * 0.1, lambda: rng.uniform(-1e9, 1e9, n), lambda: np.zeros(n),
        lambda: np.arange(n) * 0.1 - 50.0 * (np.arange(n) > n / 2), lambda: np.arange(n) * 10.0 ** rng.integers(-6, 7),
    )  # fmt: skip
    return kinds_[rng.integers(len(kinds_))]()


@pytest.mark.thorough
@cases(120, 300)
def test_no_numbers_stop_the_check(count):
    """Warnings are errors here, too."""
    others = ("yaw_rate", *AUXILIARY)
    sources = {name: {"name": name} for name in (*COMMANDS, "heading", *others)}
    for seed in range(count):
        rng = np.random.default_rng(seed)
        channels = {}
        for name in (*COMMANDS, "heading", SURGE, *others):
            if name not in others or rng.random() < 0.5:
                n = int(rng.choice([0, 1, 2, 5, 400])) if rng.random() < 0.3 else 600
                channels[name] = Channel(stamps(rng, n), values(rng, n), np.arange(n))
        for each in check_data([Recording("boat", "run", channels, {})], None, {}, 2.0, sources if seed % 2 else None):
            assert each.severity in (WARNING, NOTE) and each.found and each.expected
