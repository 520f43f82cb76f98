"""Sides and signs of commands: what is decided of boats with swapped and reversed commands, in short and long logs."""

import math

import numpy as np
import pytest

from tests.support import strangers
from tests.support.exported import write_table
from tests.support.strangers import sail, told
from tests.support.traps import columns
from tests.support.voyages import voyage
from usvlearn.logs.channels.series import Series
from usvlearn.logs.inspection.candidate import candidates
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.inspection.proposal import propose

TRAPS = {  # whether the columns have each other's name; signs of the left and the right command of the boat
    "none": (False, 1, 1),
    "swapped": (True, 1, 1),
    "reversed": (False, -1, -1),
    "swapped and reversed": (True, -1, -1),
    "left reversed": (False, -1, 1),
    "right reversed": (False, 1, -1),
    "swapped, left reversed": (True, -1, 1),
}
NAMES = ("thrust_left", "thrust_right")


def steady(minutes: float = 4.0, seed: int = 0) -> dict[str, np.ndarray]:
    """A boat that holds its speed in a current that comes and goes: the speed falls as the throttle opens."""
    rng, dt = np.random.default_rng(seed), 0.1
    time = np.arange(0, 60 * minutes, dt)
    wanted = np.repeat(rng.uniform(0, 2, len(time) // 400 + 1), 400).cumsum()[: len(time)] / 400
    speed, rate, heading = np.empty((3, len(time)))
    left, right = np.empty((2, len(time)))
    v, r, psi, flow = 1.4, 0.0, wanted[0], 0.0
    for k, goal in enumerate(wanted):
        flow += dt * (-flow / 40) + 0.02 * math.sqrt(dt) * rng.normal()
        throttle, turn = 0.55 + 1.5 * (1.4 - v), np.clip(0.6 * math.sin(goal - psi), -0.2, 0.2)
        left[k], right[k], speed[k], rate[k], heading[k] = throttle + turn, throttle - turn, v, r, psi
        v += dt * (2.5 * throttle - v + flow) / 2
        r += dt * (0.3 * 2 * turn - r) / 0.5
        psi += dt * r
    north, east = (np.cumsum(speed * each(heading)) * dt for each in (np.cos, np.sin))
    return {
        "time": time,
        "pwm_left": np.round(1500 + 400 * left),
        "pwm_right": np.round(1500 + 400 * right),
        "heading": np.degrees(heading) % 360,
        "yaw_rate": rate + rng.normal(0, 0.005, len(time)),
        "speed": speed + rng.normal(0, 0.002, len(time)),
        "lat": 48.5 + np.degrees(north / 6371000),
        "lon": 9.05 + np.degrees(east / 6371000 / math.cos(math.radians(48.5))),
    }


def concluded(table: dict[str, np.ndarray]):
    time = table["time"]
    series = [Series(name, None, time, value, np.arange(len(time))) for name, value in table.items() if name != "time"]
    return propose(candidates(series), "CSV")


def trapped(table: dict[str, np.ndarray], trap: str) -> dict[str, np.ndarray]:
    swapped, left, right = TRAPS[trap]
    columns = {NAMES[0]: left * table[NAMES[0]], NAMES[1]: right * table[NAMES[1]]}
    if swapped:
        columns = {NAMES[0]: columns[NAMES[1]], NAMES[1]: columns[NAMES[0]]}
    return {**table, **columns}


def judged(seen, trap: str) -> tuple[bool, bool, bool, bool]:
    """Whether the sides are right, and the signs; and whether each is listed under Please check."""
    swapped, *signs = TRAPS[trap]
    names = NAMES[::-1] if swapped else NAMES
    true = dict(zip(names, signs, strict=True))
    keys = [seen.channels[name] for name in ("command_left", "command_right")]
    unsure = {each.what for each in seen.decisions if each.certainty == "unsure" and each.channel.startswith("comm")}
    right = (
        [each["name"] for each in keys] == list(names),
        all(math.copysign(1, each["span"]) == true[each["name"]] for each in keys),
    )
    return *right, "series" in unsure, "sign" in unsure


def test_a_boat_that_holds_its_speed_is_not_taken_for_reversed(tmp_path):
    table = steady()
    both = table["pwm_left"] + table["pwm_right"]
    assert np.corrcoef(both, table["speed"])[0, 1] < -0.9
    result = inspect_logs([str(write_table(tmp_path / "steady.csv", table))])
    channels = result.settings["data"]["channels"]
    assert [channels[f"command_{side}"]["name"] for side in ("left", "right")] == ["pwm_left", "pwm_right"]
    assert min(channels[f"command_{side}"]["span"] for side in ("left", "right")) > 0
    reasons = [each.reason for each in result.decisions]
    assert not any("nan" in each.replace(".", " ").split() or "reversed:" in each for each in reasons)
    listed = [each for each in result.decisions if each.certainty == "unsure" and each.channel == "command_left"]
    assert {"series", "sign"} & {each.what for each in listed} or channels["command_left"]["span"] == 400


@pytest.mark.parametrize("trap", TRAPS)
@pytest.mark.parametrize(("minutes", "kind"), [(3.0, "patrol"), (3.0, "station_keeping"), (20.0, "convoy")])
def test_what_is_wrong_is_never_silent(trap, minutes, kind):
    for seed, plant in ((31, "heron"), (32, "otter")):
        sides, signs, sides_listed, signs_listed = judged(
            concluded(trapped(columns(voyage(seed, plant, minutes, kind)), trap)), trap
        )
        assert sides or sides_listed
        assert signs or signs_listed


@pytest.mark.parametrize("trap", TRAPS)
def test_a_long_log_tells_sides_and_signs(trap):
    proposal = concluded(trapped(columns(voyage(33, "vtec", 20.0)), trap))
    assert judged(proposal, trap)[:2] == (True, True)
    overruled = TRAPS[trap][0], min(TRAPS[trap][1:]) < 0
    assert judged(proposal, trap)[2:] == overruled  # listed where names, or habit, are overruled, and nowhere else


@pytest.mark.parametrize("names", [("throttle", "steering"), ("throttle", "rudder"), ("tau_x", "tau_n")])
@pytest.mark.parametrize("ahead", [1, -1])
def test_a_throttle_of_both_sides_that_is_reversed_is_found_and_listed(names, ahead):
    table = columns(voyage(34, "vtec", 10.0))
    left, right = (table.pop(name) for name in NAMES)
    proposal = concluded({**table, names[0]: ahead * (left + right) / 2, names[1]: (left - right) / 2})
    for name, way in (("command_left", 1), ("command_right", -1)):
        channel = proposal.channels[name]
        signs = channel.get("weight", [math.copysign(1, np.max(channel["span"]))])
        assert signs == ([ahead] if names[1] == "rudder" else [ahead, way])
    certainties = {each.certainty for each in proposal.decisions if each.what == "sign"}
    assert (certainties == {"unsure"}) == (ahead < 0)
    assert {each.value for each in proposal.decisions if each.what == "sign"} == {
        "positive ahead" if ahead > 0 else "reversed"
    }


def test_a_reason_gives_the_signs_that_were_decided():
    proposal = concluded(trapped(columns(voyage(33, "vtec", 20.0)), "swapped and reversed"))
    (reason,) = {each.reason for each in proposal.decisions if each.what == "sign"}
    signs = [[float(part.split()[-2]) for part in side.split(",")] for side in reason.partition(": ")[2].split(";")]
    assert np.sign(signs).tolist() == [[-1, -1], [-1, 1]]
    assert "likely" not in reason


def test_a_latitude_on_a_straight_line_is_no_clock():
    table = steady()
    table["lat"] = 48.5 + 1.2e-5 * table["time"]
    (candidate,) = (each for each in candidates([Series("lat", None, table["time"], table["lat"], np.arange(2400))]))
    assert candidate.is_clock
    assert concluded(table).channels["latitude"]["name"] == "lat"


@pytest.mark.parametrize("gear", ["gear", "Gang", "marche", "reverse", ""])
@pytest.mark.parametrize("size", [1.0, 2800.0])
def test_commands_without_a_sign_of_a_boat_that_goes_astern_are_asked(gear, size):
    def table(boat):
        sides = {name: size * np.abs(boat[name[0]]) for name in ("left", "right")}
        return {"time": boat["time"], "heading": boat["hdg"], "speed": boat["u"]} | sides

    boat = sail(4)
    gears = {f"{gear}_{name}": np.sign(boat[name[0]]) for name in ("left", "right") if gear}
    decision = next(each for each in concluded(table(boat) | gears).decisions if each.what == "sign")
    assert decision.certainty == "unsure"
    assert (", ".join(gears) if gear else "the speed is astern in") in decision.reason
    assert told(concluded(table(sail(4, lowest=0.0))))["command_left", "sign"][1] != "unsure"


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    ("names", "parts"), [(("axis0", "axis1"), False), (("a", "b"), True), (("joy_x", "joy_y"), False)]
)
def test_commands_without_names_are_found_whatever_their_sense(sign, names, parts):
    boat = strangers.sail(6, lowest=0.0)
    axes = (boat["l"], boat["r"]) if parts else (boat["l"] - boat["r"], (boat["l"] + boat["r"]) / 2)
    pair = {name: sign * each for name, each in zip(names, axes, strict=True)}
    proposal = strangers.concluded(boat, heading=boat["hdg"], speed=boat["u"], **pair)
    assert not proposal.missing and "position" not in {each.channel for each in proposal.decisions}
    assert {math.copysign(1, proposal.channels[side]["span"]) for side in ("command_left", "command_right")} == {sign}
    assert not parts or (proposal.channels["command_left"]["name"], proposal.channels["command_right"]["name"]) == names
    assert strangers.told(proposal)["command_left", "series"][1] == "unsure"


@pytest.mark.parametrize(("name", "role"), [("heading", "hdg"), ("speed", "u")])
def test_a_state_that_never_changes_is_named(name, role):
    boat = strangers.sail(4)
    states = {"heading": boat["hdg"], "speed": boat["u"]} | {name: 0 * boat[role] + 45}
    proposal = strangers.concluded(boat, left=boat["l"], right=boat["r"], **states)
    assert proposal.unfit.startswith(f"'{name}' is always 45")
