"""Logs of real boats: what `usvlearn inspect` concludes, against the configurations that were made by hand."""

import pytest
import yaml

from tests.support import REAL_LOGS, RECORDED, ROOT
from tests.support.shapes import certainties, score
from usvlearn.logs.channels.channel import CHANNELS, COMMANDS, SWAY
from usvlearn.logs.inspection.inspected import inspect_logs

BOATS = {  # boat -> channels that are also right: another name of the same quantity
    "blueboat": {},
    "dalian": {},
    "pearl": {"heading": ["IMU_HEADING"], "surge": ["GPS_SPEED"]},
    "vtec": {"heading": ["*NED_pose"], "command_left": ["/lpwm"], "command_right": ["/rpwm"]},
}
DELAYS = {"blueboat": (0.0, 0.05), "dalian": (0.15, 0.2), "vtec": (0.2, 0.25)}  # s, by learning online with each
PLAIN = {"unit": "1", "zero": 0.0, "span": 1.0}


@pytest.fixture(scope="module")
def found(request):
    if not (REAL_LOGS / request.param).is_dir():
        pytest.skip(f"{REAL_LOGS / request.param} is absent")
    return request.param, inspect_logs([str(REAL_LOGS / request.param)])


def truth(boat):
    """The hand-made configuration, as what is right."""
    channels = yaml.safe_load((ROOT / "configs" / "data" / f"{boat}.yaml").read_text())["data"]["channels"]
    wanted = {}
    for name in (each for each in (*CHANNELS, SWAY) if each in channels):
        source = channels[name]
        full = {**PLAIN, **source}
        keys = ("name", "zero", "span") if name in COMMANDS else ("name", "unit")
        first = {key: full[key] for key in (*keys, *(["field"] if "field" in source else []))}
        wanted[name] = [first, *({**first, "name": other} for other in BOATS[boat].get(name, ()))]
    return wanted


@pytest.mark.parametrize("found", RECORDED, indirect=True)
def test_channels_and_units_are_those_of_the_configuration(found):
    boat, inspected = found
    result = score(inspected.proposal.channels, certainties(inspected.decisions), truth(boat))
    assert result.wrong == []
    assert len(result.right) >= 0.9 * sum(map(len, result)), result.unsure
    assert len(inspected.recordings) == len(inspected.logs.files)


@pytest.mark.parametrize("found", [each for each in RECORDED if each != "pearl"], indirect=True)
def test_the_delay_is_that_of_the_command_delay(found):
    boat, inspected = found
    assert inspected.lag.delay in DELAYS[boat]


@pytest.mark.thorough
@pytest.mark.parametrize("found", ["blueboat"], indirect=True)
def test_a_contradiction_is_told(found):
    """The boat of these logs turns to port with a stronger left thruster, as the columns name the sides."""
    (left,) = (each for each in found[1].decisions if each.channel == "command_left" and each.what == "series")
    assert (left.value, left.certainty) == ("thr_right", "unsure")
    assert left.reason.startswith("swapped against the names")


@pytest.mark.parametrize("found", ["dalian"], indirect=True)
def test_copies_of_a_speed_are_told(found):
    assert [each.value for each in found[1].decisions if each.what == "period"] == ["0.2 s"]


@pytest.mark.parametrize("name", ["LOG_BOAT1_7_10_2015_____13_37_23.alog"])
def test_a_boat_with_a_rudder(name):
    path = REAL_LOGS / "moos" / name
    if not path.exists():
        pytest.skip(f"{path} is absent")
    channels = inspect_logs([str(path)]).proposal.channels
    assert channels["command_left"]["name"] == channels["command_right"]["name"] == "DESIRED_THRUST"
    assert channels["heading"]["name"] == "NAV_HEADING"
    assert channels["surge"]["name"] in ("NAV_SPEED", "NAV_SPEED_OVER_GROUND")
