"""The sway and the position in logs of boats that drift: what `usvlearn inspect` finds, and how sure it is."""

from pathlib import Path

import numpy as np
import pytest

from tests.support.exported import DEG, KNOTS, write_table
from tests.support.traps import TRAPS
from tests.support.voyages import voyage
from usvlearn.logs.channels.channel import VELOCITIES
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.inspection.vocabulary import fit
from usvlearn.simulate.planar_fleet import planar_fleet


@pytest.fixture(scope="module")
def drifting():
    """Columns of a simulated boat in a current, with surge and sway by GPS and compass."""
    (recording,) = planar_fleet(n=1, hours=1 / 10, seed=3)
    time = np.arange(0.5, 359.0, 0.2)

    def at(name, factor=1.0):
        channel = recording.channels[name]
        return np.interp(time, channel.time, factor * channel.value)

    heading = recording.channels["heading"]
    psi = np.interp(time, heading.time, np.unwrap(heading.value))
    north, east = map(at, VELOCITIES)
    return {
        "time": time,
        "lat": at("latitude", DEG),
        "lon": at("longitude", DEG),
        "heading": DEG * psi % 360,
        "u": north * np.cos(psi) + east * np.sin(psi),
        "v": east * np.cos(psi) - north * np.sin(psi),
        "thrust_left": at("command_left"),
        "thrust_right": at("command_right"),
    }


def inspected(folder: Path, columns, **changed):
    table = {name: value for name, value in (columns | changed).items() if value is not None}
    result = inspect_logs([str(write_table(folder / "a.csv", table))])
    return result, {each.what: each for each in result.decisions if each.channel == "sway"}


@pytest.mark.parametrize(("factor", "unit", "span"), [(1.0, "m/s", None), (-1.0, "m/s", -1.0), (KNOTS, "knots", None)])
def test_unit_and_side_are_proved_by_the_position(tmp_path, drifting, factor, unit, span):
    result, sway = inspected(tmp_path, drifting, v=factor * drifting["v"])
    channel = result.settings["data"]["channels"]["sway"]
    assert (channel["name"], channel["unit"], channel.get("span")) == ("v", unit, span)
    assert {each.certainty for each in sway.values()} == {"certain"}
    assert sway["sign"].value == ("to starboard" if factor > 0 else "to port")
    (recording,) = result.recordings
    np.testing.assert_allclose(recording.channels["sway"].value, drifting["v"], atol=1e-9)
    assert not [each for each in result.findings if each.kind.startswith(("sway", "position"))]


def test_without_a_position_the_side_is_unsure(tmp_path, drifting):
    result, sway = inspected(tmp_path, drifting, lat=None, lon=None)
    assert (sway["series"].value, sway["sign"].certainty) == ("v", "unsure")
    assert "sway.sign: {certainty: unsure, found: to starboard" in result.text and "# or span: -1" in result.text


def over_ground(columns, late=0.0):
    """Speed and course over ground in place of surge and sway, some seconds late."""
    course = np.radians(columns["heading"]) + np.arctan2(columns["v"], columns["u"])
    turned = np.interp(columns["time"] - late, columns["time"], np.unwrap(course))
    return {"u": None, "v": None, "sog": np.hypot(columns["u"], columns["v"]), "cog": DEG * turned % 360}


@pytest.mark.thorough
def test_speed_and_course_over_ground_are_written_where_they_tell_the_sway(tmp_path, drifting):
    result, _ = inspected(tmp_path, drifting, **over_ground(drifting))
    channels = result.settings["data"]["channels"]
    assert (channels["ground_speed"]["name"], channels["surge"]["name"]) == ("sog", "sog")
    assert (channels["course"]["name"], channels["course"]["unit"]) == ("cog", "deg")
    assert set(result.recordings[0].channels) >= {"ground_speed", "course", "surge"}
    late, _ = inspected(tmp_path, drifting, **over_ground(drifting, late=4.0))
    assert not {"ground_speed", "course"} & set(late.proposal.channels)


def test_the_position_is_written_beside_a_speed_that_is_logged(tmp_path, drifting):
    channels = inspected(tmp_path, drifting)[0].settings["data"]["channels"]
    assert [channels[name]["name"] for name in ("surge", "latitude", "longitude")] == ["u", "lat", "lon"]


def test_no_other_series_is_taken_for_a_sway(tmp_path, drifting):
    noise = np.random.default_rng(0).normal(0, 0.1, len(drifting["time"]))
    others = {"sway_angle": 10 * noise, "lateral_error": noise, "vz": noise, "lateral_acceleration": noise}
    _, sway = inspected(tmp_path, drifting, v=None, **others)
    assert not sway


def test_coordinates_of_which_none_is_known_to_be_north_are_told_and_not_written(tmp_path):
    path = TRAPS["unnamed_axes"].write(tmp_path, voyage(1, kind="station_keeping", plant="vtec"))
    result = inspect_logs([str(path)])
    (decision,) = (each for each in result.decisions if each.channel == "position")
    assert decision.certainty == "unsure" and "north" not in result.proposal.channels


def test_names_of_a_sway():
    named = "sway NAV_SWAY lateral_velocity sideways Seitengeschwindigkeit Quergeschwindigkeit vitesse_latérale"
    for name in (*named.split(), "velocidad lateral", "velocità laterale", "dwarssnelheid", "sivuttaisnopeus"):
        assert fit("sway", name) >= 2 and fit("surge", name) < 1 and fit("command", name) < 1, name
    for name in ("sway_angle", "lateral_acceleration", "desired_sway", "lateral error", "roll", "sway_force"):
        assert fit("sway", name) < 1, name
