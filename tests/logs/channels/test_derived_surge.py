"""The speed of a log that has none, from velocities over ground or from positions, which also give the track."""

import numpy as np
import pytest

from tests.support.files import refused, write
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.derived_surge import filtered
from usvlearn.logs.channels.positions import local
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.read import read_recordings
from usvlearn.logs.recordings import align_fleet

HZ, SECONDS = 5, 300
HEADER = "t,L,R,psi,vn,ve,sog,cog,lat,lon,x,y"
EQUATOR, ECCENTRICITY = 6378137.0, 0.00669437999014  # WGS 84: m, squared


def voyage(rng=None, noise=0.0):
    """A boat that goes ahead and astern on a slow turn; time, and columns as of HEADER."""
    fine = np.arange(0, SECONDS, 0.01)
    surge, psi = 1.0 + 1.5 * np.sin(2 * np.pi * fine / 60), 0.02 * fine
    rates = surge * np.array([np.cos(psi), np.sin(psi)])
    places = np.cumsum(rates, 1) * 0.01
    at = slice(0, None, 100 // HZ)
    t, v, psi, (vn, ve), (x, y) = fine[at], surge[at], psi[at], rates[:, at], places[:, at]
    if rng is not None:
        x, y = x + noise * rng.normal(size=len(t)), y + noise * rng.normal(size=len(t))
    latitude = np.radians(63.4)
    bent = 1 - ECCENTRICITY * np.sin(latitude) ** 2
    lat = np.degrees(latitude + x / (EQUATOR * (1 - ECCENTRICITY) / bent**1.5))
    lon = np.degrees(np.pi - 1e-5 + y / (EQUATOR / np.sqrt(bent) * np.cos(latitude)))  # it crosses the 180th meridian
    lon = (lon + 180) % 360 - 180
    course = np.degrees(np.arctan2(ve, vn)) % 360
    return v, np.stack([t, 0 * t, 0 * t, np.degrees(psi), vn, ve, np.hypot(vn, ve), course, lat, lon, x, y], 1)


def read(tmp_path, rows, **pair):
    text = "\n".join(",".join(f"{x:.10g}" for x in row) for row in rows)
    path = write(tmp_path / "a.csv", f"{HEADER}\n{text}\n")
    channels = {
        "command_left": {"name": "L"},
        "command_right": {"name": "R"},
        "heading": {"name": "psi", "unit": "deg"},
    }
    with pytest.warns(UserWarning, match="no speed is configured: the surge is computed from"):
        (recording,) = read_recordings(path, Table("t"), channels | pair)
    return recording


@pytest.mark.parametrize(
    ("pair", "tolerance"),
    [
        ({"velocity_north": {"name": "vn"}, "velocity_east": {"name": "ve", "unit": "m/s"}}, 1e-8),
        ({"ground_speed": {"name": "sog"}, "course": {"name": "cog", "unit": "deg"}}, 1e-6),
        ({"latitude": {"name": "lat", "unit": "deg"}, "longitude": {"name": "lon", "unit": "deg"}}, 0.05),
        ({"north": {"name": "x"}, "east": {"name": "y"}}, 0.05),
    ],
)
def test_the_surge_is_that_of_the_boat_ahead_and_astern(tmp_path, pair, tolerance):
    surge, rows = voyage()
    speed = read(tmp_path, rows, **pair).channels["surge"]
    true = np.interp(speed.time, rows[:, 0], surge)
    assert len(speed.time) >= len(rows) - 3
    np.testing.assert_allclose(speed.value[30:], true[30:], atol=tolerance)  # the filter has settled
    assert true.min() < -0.4


def test_speeds_from_noisy_positions_are_better_than_their_differences(tmp_path):
    surge, rows = voyage(np.random.default_rng(0), noise=0.1)
    speed = read(tmp_path, rows, north={"name": "x"}, east={"name": "y"}).channels["surge"]
    error = np.abs(speed.value - np.interp(speed.time, rows[:, 0], surge))[50:]
    plain = np.abs(np.hypot(*np.diff(rows[:, -2:], axis=0).T) * HZ - np.abs(surge[1:]))[50:]
    assert error.mean() < 0.25 * plain.mean()


def test_a_speed_depends_on_past_positions_only():
    _, rows = voyage()
    t, x, y = rows[:, 0], rows[:, -2], rows[:, -1]
    whole, part = np.array(filtered(t, x, y)), np.array(filtered(t[:200], x[:200], y[:200]))
    np.testing.assert_array_equal(whole[:, :200], part)


def test_copies_outliers_outages_and_bad_positions_do_no_harm():
    _, rows = voyage()
    t, x, y = rows[:, 0].copy(), rows[:, -2].copy(), rows[:, -1].copy()
    clean = np.array(filtered(t, x, y))
    x[400], y[401] = x[400] + 50, np.nan  # an outlier, and a hole
    x[600:602], y[600:602] = x[599], y[599]  # copies
    velocity = np.array(filtered(t, x, y))
    assert np.isnan(velocity[:, [400, 401, 600, 601]]).all()
    fine = np.isfinite(velocity).all(0)
    assert fine.sum() == len(t) - 4 - np.isnan(clean).any(0).sum()
    np.testing.assert_allclose(velocity[:, fine], clean[:, fine], atol=0.15)
    x[800:] += 300.0  # the position jumps, and stays there
    velocity = np.array(filtered(t, x, y))
    np.testing.assert_allclose(velocity[:, 850:], clean[:, 850:], atol=0.05)


def test_no_speed_and_no_pair_is_told():
    channels = {name: {"name": "a"} for name in ("command_left", "command_right", "heading", "latitude")}
    message = refused(ConfigError, read_recordings, ".", Table("t"), channels)
    assert "found no surge" in message and "latitude and longitude" in message


def test_a_pair_without_a_heading_beside_it_is_told(tmp_path):
    path = write(tmp_path / "a.csv", "t,L,psi,x,y\n" + "".join(f"{k},1,,{k},0\n" for k in range(9)) + "60,1,0,,\n")
    channels = {name: {"name": "L"} for name in ("command_left", "command_right")}
    channels |= {"heading": {"name": "psi"}, "north": {"name": "x"}, "east": {"name": "y"}}
    message = refused(LogFormatError, read_recordings, path, Table("t"), channels)
    assert "found no speed in north and east (9 no_heading)" in message


def test_runs_have_the_position_of_each_step(tmp_path):
    _, rows = voyage()
    pair = {"latitude": {"name": "lat", "unit": "deg"}, "longitude": {"name": "lon", "unit": "deg"}}
    fleet = align_fleet([read(tmp_path, rows, **pair)], patience=0)
    (run,) = fleet.runs
    time = run.time[:, 0] + 0.4  # the first step is that at 0.4 s
    at = np.stack([np.interp(time, rows[:, 0], rows[:, k]) for k in (-2, -1)], 1)
    known = np.isfinite(run.position[:, 0]).all(1)
    assert run.position.shape == (len(run.time), 1, 2) and known.mean() > 0.99
    np.testing.assert_allclose(run.position[known, 0], (at - rows[0, -2:])[known], atol=0.02)  # m in 300 m


def test_a_log_without_the_positions_of_a_track_is_read_without_a_track(tmp_path):
    _, rows = voyage()
    given = {"velocity_north": {"name": "vn"}, "velocity_east": {"name": "ve"}}
    with pytest.warns(UserWarning, match="no track: .*no channel 'nothing'"):
        recording = read(tmp_path, rows, **given, latitude={"name": "nothing"}, longitude={"name": "lon"})
    (run,) = align_fleet([recording]).runs
    assert run.position is None and "surge" in recording.channels


def test_metres_agree_with_the_length_of_a_degree():
    north, east = local(np.radians([0.0, 1.0]), np.radians([10.0, 11.0]))
    assert north[1] == pytest.approx(110574, abs=5) and east[1] == pytest.approx(111320, abs=5)  # m, at the equator
