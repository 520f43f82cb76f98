"""The data check on boats that are not ours: signs of speeds, compasses and clocks."""

import re

import numpy as np
import pytest

from tests.support.strangers import sail
from usvlearn.core.samples import Fleet
from usvlearn.logs.channels.channel import SURGE, Channel, Recording
from usvlearn.logs.checks.course import compass_of_runs
from usvlearn.logs.checks.data_check import check_data
from usvlearn.logs.checks.delivery import rejected
from usvlearn.logs.checks.evidence import Evidence
from usvlearn.logs.checks.finding import NOTE, WARNING
from usvlearn.logs.checks.response import delays
from usvlearn.logs.checks.scales import runs


def stranger(boat, late=0.0, channels=(SURGE, "heading"), **values):
    """A recording of a boat of `tests.support.strangers`, of which some channels are stamped `late` seconds late."""
    time, order = boat["time"], np.arange(len(boat["time"]))
    named = {"command_left": boat["l"], "command_right": boat["r"], "heading": boat["psi"], SURGE: boat["u"], **values}
    series = {name: Channel(time + late * (name in channels), value, order) for name, value in named.items()}
    return Recording("a", "1", series, {})


def told_of(recording, **channels):
    given = {name: {"name": name} for name in recording.channels} | channels
    return {each.kind: each for each in check_data([recording], None, {}, 2.5, given)}


def test_a_speed_without_a_sign_of_a_boat_that_goes_astern_is_found():
    finding = told_of(stranger(sail(6), surge=sail(6)["sog"]))["speed sign"]
    assert (finding.severity, finding.key) == (WARNING, "")
    assert "both commands push astern" in finding.found
    assert "speed sign" not in told_of(stranger(sail(6)))
    assert "speed sign" not in told_of(stranger(sail(6, lowest=0.0), surge=sail(6, lowest=0.0)["sog"]))


@pytest.mark.parametrize("off", [20.0, -10.0])
def test_a_compass_that_is_off_is_found_and_a_current_is_none(off):
    boat = sail(6)
    moved = {"north": boat["n"] + 0.4 * boat["time"], "east": boat["e"] - 0.3 * boat["time"]}
    wrong = told_of(stranger(boat, heading=boat["psi"] + np.radians(off), **moved))["heading offset"]
    assert float(wrong.key.partition("zero=")[2]) == pytest.approx(np.radians(off), abs=0.03)
    assert "heading offset" not in told_of(stranger(boat, **moved))


@pytest.mark.parametrize("late", [18.0, -18.0, 7.0])
def test_clocks_that_differ_are_found_in_both_directions_of_a_short_log(late):
    finding = told_of(stranger(sail(4), late))["delay"]
    assert "clocks of both differ" in finding.sentence()
    assert ("command_left.delay=" in finding.key) == (late == 7)
    how = "add 18 s to" if late > 0 else "take 18 s from"
    assert (f"{how} the stamps of the commands" in finding.expected) == (late != 7)
    assert "delay" not in told_of(stranger(sail(4)))


ODD = {
    ("surge",): (-1.0, -4.0, -18.0),
    ("heading",): (2.5, 3.0, 18.0, -2.0, -18.0),
    ("command_left", "command_right"): (1.0, 3.0, 18.0),
}


@pytest.mark.parametrize(("late", "channels"), [(late, names) for names, each in ODD.items() for late in each])
def test_the_table_whose_clock_differs_is_named_with_its_shift(late, channels):
    finding = told_of(stranger(sail(6), late, channels))["delay"]
    name = {"surge": "speed", "heading": "heading"}.get(channels[0], "commands")
    how = re.search(r"(take|add) (\d+) s (from|to) the stamps of the (\w+)", finding.expected)
    assert how and (how[1], how[4]) == ("take" if late > 0 else "add", name)
    assert float(how[2]) == pytest.approx(abs(late), abs=1)


@pytest.mark.parametrize("rate", [0.01, -0.01])
@pytest.mark.parametrize("names", [("command_left", "command_right"), ("heading",), (SURGE,)])
def test_a_clock_that_runs_faster_is_found(names, rate):
    log = stranger(boat := sail(12, 2))
    assert not {"clock drift", "delay"} & told_of(log).keys()
    ran = {name: log.channels[name]._replace(time=(1 + rate) * boat["time"]) for name in names}
    finding = told_of(log._replace(channels=log.channels | ran))["clock drift"]
    side = "faster" if (rate > 0) != (len(names) == 2) else "slower"
    assert f"its clock runs {side} than that of the commands" in finding.expected


def receiver(late, off=0.0):
    """Kinds of findings where the receiver is so many s late, and the compass off by so many degrees."""
    boat = sail(8)
    moved = {"north": boat["n"], "east": boat["e"]}
    return told_of(stranger(boat, late, tuple(moved), heading=boat["psi"] + np.radians(off), **moved))


@pytest.mark.parametrize("late", [18.0, -18.0, 8.0, -30.0])
def test_a_receiver_with_another_clock_is_found_in_both_directions(late):
    assert "clocks" in receiver(late)


@pytest.mark.parametrize(("late", "off"), [(0, 0), (2, 0), (0, 30), (-1, -40)])
def test_a_late_receiver_and_a_wrong_compass_are_no_other_clock(late, off):
    assert "clocks" not in receiver(late, off)


@pytest.mark.parametrize(("seed", "late"), [(1, 2.0), (3, 2.5), (4, 2.5)])
def test_a_heading_that_is_two_seconds_late_is_found_and_an_early_or_slow_one_is_not(seed, late):
    boat = sail(8, seed)
    moved = {"north": boat["n"], "east": boat["e"]}
    for shift in (late, 0.5, -2.0):
        findings = told_of(stranger(boat, shift, ("heading",), heading=boat["psi"], **moved))
        assert ("clocks" in findings) == (shift == late)


@pytest.mark.parametrize(("start", "severity"), [(1.7e9, WARNING), (54_400.0, NOTE), (41_234.2, NOTE), (0.0, None)])
def test_runs_of_the_same_minutes_are_asked_for_also_without_a_date(start, severity):
    def severity_of(pause):
        runs = []
        for run in (0, 1):
            channels = stranger(sail(3, run + 1)).channels
            begun = {name: each._replace(start=start + run * pause) for name, each in channels.items()}
            runs.append(Recording("a", f"r{run}", begun, {}))
        asked = [each for each in check_data(runs, None, {}, 2.5) if each.kind == "together"]
        assert all("set data.path to the run of one, or to {r0: FILE, r1: FILE}" in each.sentence() for each in asked)
        return [each.severity for each in asked]

    assert severity_of(1) == ([severity] if severity else [])
    assert severity_of(4000) == []


@pytest.mark.parametrize("current", [(0.5, -0.3), (0.0, 0.5), (-0.4, 0.2)])
def test_a_course_in_place_of_a_heading_is_found_by_the_current(current):
    boat = sail(6, lowest=0.0)
    drift = [each * boat["time"] for each in current]
    moved = {"north": boat["n"] + drift[0], "east": boat["e"] + drift[1]}
    rates = [np.gradient(each, boat["time"]) for each in moved.values()]
    course = {"heading": np.unwrap(np.arctan2(rates[1], rates[0])), SURGE: np.hypot(*rates)}
    finding = told_of(stranger(boat, **moved, **course))["course"]
    assert "current" in finding.found and finding.severity == NOTE
    assert "course" not in told_of(stranger(boat, **moved))
    assert "course" not in told_of(stranger(boat, north=boat["n"], east=boat["e"]))


IMPOSSIBLE = {
    SURGE: lambda u, rng: np.where(np.arange(len(u)) % 2, 9.0, -9.0),
    "heading": lambda psi, rng: np.where(np.arange(len(psi)) % 4 < 2, psi, 2 - psi),
    "north": lambda x, rng: x + 40 * rng.integers(0, 2, len(x)),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_a_series_that_jumps_to_and_fro_is_found(name):
    boat, rng = sail(6), np.random.default_rng(0)
    columns = {SURGE: boat["u"], "heading": boat["psi"], "north": boat["n"], "east": boat["e"]}
    finding = told_of(stranger(boat, **columns | {name: IMPOSSIBLE[name](columns[name], rng)}))["jumps"]
    assert finding.about.startswith(name) and finding.severity == WARNING and "of two boats" in finding.expected
    spikes = {
        key: np.where(rng.random(len(x)) < 0.02, 30 * x, x) + rng.normal(0, 0.1, len(x)) for key, x in columns.items()
    }
    assert "jumps" not in told_of(stranger(boat, **spikes))


def test_stamps_far_in_the_future_are_told_as_such():
    one = stranger(sail(6))
    late = one.channels[SURGE]._replace(time=one.channels[SURGE].time + 1e12 * (np.arange(len(sail(6)["u"])) > 300))
    fleet = Fleet(("a",), (), {"a": {SURGE: {"not_a_number": 400}}})
    (finding,) = rejected(Evidence("a", [one._replace(channels=one.channels | {SURGE: late})], fleet, {}, 2.5, {}))
    assert "leave out rows whose stamps are more than 1e+12 s after" in finding.expected


@pytest.mark.parametrize("placed", [True, False])
def test_a_log_of_another_unit_than_the_others_is_named(placed):
    logs = []
    for run, boat in enumerate(sail(3, seed) for seed in (1, 2, 3)):
        where = {"north": boat["n"], "east": boat["e"]} if placed else {}
        logs.append(stranger(boat, **where)._replace(run=f"r{run}"))

    def kinds(**factors):
        odd = {name: each._replace(value=each.value * factors.get(name, 1)) for name, each in logs[1].channels.items()}
        evidence = Evidence("a", [logs[0], logs[1]._replace(channels=odd), logs[2]], None, {}, 2.5, {})
        return {each.kind: each.found for each in runs(evidence)}

    assert kinds() == {}
    for factor in (1.944, 3.6):
        assert "in r1 (×" in kinds(surge=factor)["speeds of runs"]
    for factor in (100, 1e-3, 2.55):
        assert "in r1 (×" in kinds(command_left=factor, command_right=factor)["commands of runs"]
    assert kinds(command_left=0.1, command_right=0.1, surge=0.2).keys() <= ({"speeds of runs"} if placed else set())


@pytest.mark.parametrize(("count", "which"), [(2, 1), (2, 0), (3, 2), (4, 0)])
def test_the_log_whose_sides_are_swapped_is_named(count, which):
    logs = [stranger(sail(4, seed))._replace(run=f"r{seed}") for seed in range(1, count + 1)]
    assert "sides of runs" not in {each.kind for each in check_data(logs, None, {}, 2.5)}
    channels = logs[which].channels
    wrong = {"command_left": channels["command_right"], "command_right": channels["command_left"]}
    for odd in (wrong, {"heading": channels["heading"]._replace(value=-channels["heading"].value)}):
        logs[which] = logs[which]._replace(channels=channels | odd)
        finding = {each.kind: each for each in check_data(logs, None, {}, 2.5)}["sides of runs"]
        assert finding.found.endswith(f"unlike in other logs, in r{which + 1}") and finding.severity == WARNING
    one = {"command_left": channels["command_left"]._replace(value=-channels["command_left"].value)}
    logs[which] = logs[which]._replace(channels=channels | one)
    finding = {each.kind: each for each in check_data(logs, None, {}, 2.5)}["sides of runs"]
    assert (finding.about, finding.found[-2:]) == ("command_left", f"r{which + 1}") and "reverse it" in finding.expected
    lost = channels["command_left"]._replace(value=0 * channels["command_left"].value)
    logs[which] = logs[which]._replace(channels=channels | {"command_left": lost})
    assert "sides of runs" not in {each.kind for each in check_data(logs, None, {}, 2.5)}


@pytest.mark.parametrize(("bias", "unit"), [(3.0, "rad/s"), (-3.0, "deg/s"), (2.0, "enu_rad/s")])
def test_a_gyro_with_a_bias_is_found_and_one_of_another_scale_is_none(bias, unit):
    boat = sail(6)
    rate = boat["turn"] + np.radians(bias)
    finding = told_of(stranger(boat, yaw_rate=rate), yaw_rate={"name": "yaw_rate", "unit": unit})["yaw rate bias"]
    factor = {"rad/s": 1, "deg/s": np.radians(1), "enu_rad/s": -1}[unit]
    assert float(finding.key.partition("zero=")[2]) == pytest.approx(np.radians(bias) / factor, rel=0.1)
    for other in (boat["turn"], 1.2 * boat["turn"], np.roll(boat["turn"], 4)):
        assert "yaw rate bias" not in told_of(stranger(boat, yaw_rate=other))


@pytest.mark.parametrize(("size", "at", "off"), [(15.0, 0.0, 0.0), (-15.0, 1.0, 8.0), (18.0, 2.5, -5.0)])
def test_a_compass_whose_error_changes_with_the_heading_is_found(size, at, off):
    boat = sail(12)
    moved = {"north": boat["n"] + 0.3 * boat["time"], "east": boat["e"] - 0.3 * boat["time"]}
    wrong = boat["psi"] + np.radians(size * np.sin(boat["psi"] + at) + off)
    finding = told_of(stranger(boat, heading=wrong, **moved))["compass"]
    degrees = float(re.search(r"is (\d+)° off", finding.found)[1])
    assert degrees == pytest.approx(abs(size), abs=4)
    assert "compass" not in told_of(stranger(boat, heading=boat["psi"] + np.radians(off), **moved))
    twice = boat["psi"] + np.radians(size * np.sin(2 * boat["psi"] + at) + off)
    assert "a quarter of a turn" in told_of(stranger(boat, heading=twice, **moved))["compass"].found


def placed(seed, off=0.0, minutes=6):
    """A log with a position in a current; the heading is `off` degrees off, which may change."""
    boat = sail(minutes, seed)
    moved = {"north": boat["n"] + 0.2 * boat["time"], "east": boat["e"] - 0.2 * boat["time"]}
    return stranger(boat, heading=(boat["psi"] + np.radians(off)) % (2 * np.pi), **moved)._replace(run=f"r{seed}")


@pytest.mark.parametrize("channels", [{SURGE: {"name": "u"}}, {"north": {"name": "n"}, "east": {"name": "e"}}])
@pytest.mark.parametrize(("offs", "odd"), [((0, 90, 0), "r2"), ((-30, 0), "r1"), ((10, 10, 10, 35), "r4")])
def test_the_log_whose_heading_is_off_unlike_in_others_is_named(offs, odd, channels):
    def kinds(offs):
        logs = [placed(seed, off) for seed, off in enumerate(offs, 1)]
        return {each.kind: each.found for each in compass_of_runs(Evidence("a", logs, None, {}, 2.5, channels))}

    assert re.findall(r"° off in (r\d)", kinds(offs)["compass of runs"]) == [odd]
    assert "compass of runs" not in kinds([offs[-2]] * len(offs))


@pytest.mark.parametrize(
    "change", [lambda share: 60 * share, lambda share: -25 * (share > 0.5), lambda share: 120 * share]
)
def test_a_heading_whose_error_changes_during_a_log_is_found(change):
    share = np.linspace(0, 1, len(sail(9)["time"]))
    assert "off in the thirds of r1" in told_of(placed(1, change(share), 9))["compass drift"].found
    assert not {"compass drift", "compass"} & told_of(placed(1, 20, 9)).keys()


@pytest.mark.parametrize(("lates", "odd"), [((0, 4, 0), "r2"), ((-4, 0), "r1"), ((0, 0, 0, 18), "r4")])
def test_the_log_whose_clocks_differ_unlike_in_others_is_named(lates, odd):
    def told(lates):
        logs = [stranger(sail(6, seed), late)._replace(run=f"r{seed}") for seed, late in enumerate(lates, 1)]
        return [each.found for each in delays(Evidence("a", logs, None, {}, 2.5, {}))]

    assert re.findall(r"commands in (r\d)", *told(lates)) == [odd]
    assert told([0] * len(lates)) == []


@pytest.mark.parametrize(("side", "late"), [("left", 1.0), ("right", 0.8), ("left", 2.0), ("right", -1.0)])
def test_a_side_whose_commands_are_of_another_clock_is_named(side, late):
    finding = told_of(stranger(sail(8), late, (f"command_{side}",)))["delay of a side"]
    if late > 0:
        assert finding.about != f"command_{side}" and f"take {round(late)} s from the stamps of" in finding.expected
        assert finding.expected.endswith(f"command_{side}")
    else:
        assert (finding.about, finding.key) == (f"command_{side}", f"data.channels.command_{side}.delay={-late:g}")
    assert "delay of a side" not in told_of(stranger(sail(8)))


@pytest.mark.parametrize("side", ["l", "r"])
def test_a_thruster_that_stops_within_a_log_is_named(side):
    finding = told_of(stranger(sail(8, dies=side)))["thruster lost"]
    assert finding.severity == NOTE and finding.about == {"l": "command_left", "r": "command_right"}[side]
    assert "thruster lost" not in told_of(stranger(sail(8)))


def test_a_position_that_freezes_on_a_boat_that_turns_is_found():
    boat = sail(9, 7)
    place = {"north": boat["n"], "east": boat["e"]}
    assert "frozen" not in told_of(stranger(boat, **place))
    stopped = np.minimum(np.arange(len(boat["n"])), int(0.7 * len(boat["n"])))
    logs = [stranger(boat, **{name: value[stopped] for name, value in place.items()})]
    findings = check_data(logs, None, {}, 2.5, {name: {"name": name} for name in logs[0].channels})
    assert {each.about for each in findings if each.kind == "frozen"} == {"north", "east"}
