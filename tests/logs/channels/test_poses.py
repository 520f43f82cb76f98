"""What a log says at the end of each step beside the surge."""

import math

import numpy as np
import pytest

from usvlearn.core.samples import Inputs, Sample
from usvlearn.logs.channels.channel import AUTO, Channel
from usvlearn.logs.channels.poses import poses

AT = np.arange(0.0, 20.0, 0.4)
HEADING, TURN, SWAY, NORTH, EAST = range(5)


def samples(surge=1.0) -> Sample:
    zero, yes = np.zeros(len(AT)), np.ones(len(AT), bool)
    return Sample(Inputs(zero, zero, zero, zero, zero + 0.4), zero + surge, yes, yes)


def channel(time, value, begin=0, step=1, **options) -> Channel:
    time = np.asarray(time, float)
    return Channel(time, np.broadcast_to(np.asarray(value, float), time.shape).copy(),
                   begin + step * np.arange(len(time)), **{"window": 0.5, **options})  # fmt: skip


def test_a_boat_on_a_circle():
    """At 1 m/s ahead and 0.2 m/s aside, with 0.1 rad/s: heading, rate, sway and way in closed form."""
    fine = np.arange(0.0, 20.0, 0.01)
    psi = 3.0 + 0.1 * fine
    u, v, r = 1.0, 0.2, 0.1
    north = (u * (np.sin(psi) - np.sin(psi[0])) + v * (np.cos(psi) - np.cos(psi[0]))) / r
    east = (-u * (np.cos(psi) - np.cos(psi[0])) + v * (np.sin(psi) - np.sin(psi[0]))) / r
    velocities = u * np.cos(psi) - v * np.sin(psi), u * np.sin(psi) + v * np.cos(psi)
    channels = {
        "heading": channel(fine, np.remainder(psi, 2 * math.pi)),
        "velocity_north": channel(fine, velocities[0]), "velocity_east": channel(fine, velocities[1]),
        "north": channel(fine, north + 500.0, 0, 2), "east": channel(fine, east - 70.0, 1, 2),
    }  # fmt: skip
    pose = poses(channels, AT, samples())
    expected = np.interp(AT, fine, psi), np.full(len(AT), r), np.full(len(AT), v)
    np.testing.assert_allclose(pose[:, HEADING], np.remainder(expected[0], 2 * math.pi), atol=1e-9)
    np.testing.assert_allclose(pose[1:, TURN], r, atol=1e-9)
    np.testing.assert_allclose(pose[:, SWAY], v, atol=1e-9)
    moved = np.column_stack([np.interp(AT, fine, north), np.interp(AT, fine, east)])
    np.testing.assert_allclose(pose[1:, NORTH:] - pose[1, NORTH:], moved[1:] - moved[1], atol=2e-3)
    course = {"ground_speed": channel(fine, math.hypot(u, v)), "course": channel(fine, psi + math.atan2(v, u)),
              "heading": channels["heading"]}  # fmt: skip
    np.testing.assert_allclose(poses(course, AT, samples())[:, SWAY], v, atol=1e-9)
    reckoned = poses(course, AT, samples())[:, NORTH:]
    np.testing.assert_allclose(reckoned, moved, atol=2e-3)  # the trapezoid's error


def test_until_two_fixes_have_come_the_boat_is_reckoned_and_the_fixes_go_on_from_there():
    fixes = np.arange(8.0, 20.0, 1.0)
    channels = {
        "heading": channel(AT, 0.0),
        "latitude": channel(fixes, np.radians(48.0) + 2 * fixes / 6_362_000, 0, 2),
        "longitude": channel(fixes, np.radians(9.0), 1, 2),
    }
    pose = poses(channels, AT, samples())
    np.testing.assert_allclose(pose[:23, NORTH], AT[:23], atol=1e-12)  # at 1 m/s, until 9 s
    assert pose[23, NORTH] == pytest.approx(AT[23])
    np.testing.assert_allclose(np.diff(pose[23:, NORTH]) / 0.4, 2.0, rtol=2e-3)  # the fixes say 2 m/s
    none = channels | {"latitude": channels["latitude"]._replace(value=np.zeros(12)),
                       "longitude": channels["longitude"]._replace(value=np.zeros(12))}  # fmt: skip
    np.testing.assert_allclose(poses(none, AT, samples())[:, NORTH], AT, atol=1e-12)


def test_what_is_old_is_not_known():
    stop = AT[AT < 10.0]
    channels = {
        "heading": channel(stop, 0.3), "yaw_rate": channel(AT[::10], 0.1, window=AUTO), "sway": channel(AT, np.nan),
        "north": channel(stop, stop, 0, 2), "east": channel(stop, 0.0, 1, 2),
    }  # fmt: skip
    pose = poses(channels, AT, samples())
    assert np.isfinite(pose[:26, HEADING]).all() and np.isnan(pose[27:, HEADING]).all()
    assert np.isfinite(pose[10:, TURN]).all() and np.isnan(pose[:10, TURN]).sum() == 9  # the window is not known yet
    assert np.isnan(pose[:, SWAY]).all()
    assert np.isfinite(pose[:37, NORTH]).all() and np.isnan(pose[38:, NORTH]).all()  # 5 s


def test_a_jump_is_no_motion_and_a_repeated_fix_no_new_one():
    time = np.arange(0.0, 20.0, 0.2)
    way = np.where(time < 10.0, time, time + 500.0)
    place = np.repeat(way[::2], 2)  # each fix is posted twice
    channels = {"heading": channel(time, 0.0), "north": channel(time, place, 0, 2), "east": channel(time, 0.0, 1, 2)}
    pose = poses(channels, AT, samples())[:, NORTH]
    assert pose[25] - pose[24] == pytest.approx(500.4) and np.abs(np.diff(pose) - 0.4)[[*range(3, 24)]].max() < 1e-9
    assert np.abs(np.diff(pose[26:]) - 0.4).max() < 1e-9


def test_numbers_that_are_stamped_apart_are_no_fix():
    """Two in a row, at most 0.02 s apart, are one; each number is used once."""
    time = np.arange(0.0, 20.0, 0.2)
    channels = {"heading": channel(time, 0.0), "north": channel(time, 2 * time, 0, 2)}
    near = channels | {"east": channel(time + 0.01, 0.0, 1, 2)}
    far = channels | {"east": channel(time + 0.1, 0.0, 1, 2)}
    assert np.diff(poses(near, AT, samples())[5:, NORTH]) == pytest.approx(0.8)
    assert np.diff(poses(far, AT, samples())[5:, NORTH]) == pytest.approx(0.4)  # reckoned at 1 m/s


def test_a_message_that_came_after_the_step_is_not_used():
    time = AT - 0.1
    heading = channel(time, np.arange(len(time)), 10, 10, window=1.0)
    came = heading.order - 1.0  # each step was made just before the last message that is stamped before its end
    pose = poses({"heading": heading}, AT, samples(), came)
    assert pose[1:, HEADING].tolist() == list(range(len(AT) - 1)) and np.isnan(pose[0, HEADING])
    assert poses({"heading": heading}, AT, samples())[:, HEADING].tolist() == list(range(len(AT)))


def test_a_channel_without_messages_is_not_known():
    channels = {"heading": channel([], 0.0), "sway": channel([], 0.0, window=AUTO), "north": channel([], 0.0),
                "east": channel([0.0], 0.0)}  # fmt: skip
    assert np.isnan(poses(channels, AT, samples())).all()


def test_a_gyro_that_is_stuck_gives_way_to_the_heading():
    gyro = np.where(AT < 4, 0.3 * np.sin(AT), 0.1)
    channels = {
        "heading": Channel(AT, 0.5 * AT % 6.28, np.arange(len(AT)), window=0.5),
        "yaw_rate": Channel(AT, gyro, np.arange(len(AT)), window=0.5),
    }
    pose = poses(channels, AT, samples())[:, TURN]
    begin = int(np.searchsorted(AT, 4)) + 2
    assert np.array_equal(pose[1:begin], gyro[1:begin])
    step = AT[1] - AT[0]
    assert np.allclose(pose[begin:][np.diff(0.5 * AT % 6.28)[begin - 1 :] > 0], 0.5, atol=1e-9), step
