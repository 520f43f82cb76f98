"""Which series is the speed, and how surely: scales that are a little wrong, and setpoints beside measured speeds."""

import math

import numpy as np
import pytest

from tests.support.strangers import driven, sail, tell, told
from usvlearn.logs.channels.position_rates import speed_on_positions


def placed(boat, noise=0.0):
    """Degrees of a receiver with so much noise, m."""
    rng, metre = np.random.default_rng(0), 1 / 111195
    north, east = (noise * metre * rng.normal(size=len(boat["lat"])) for _ in range(2))
    return {"lat": boat["lat"] + north, "lon": boat["lon"] + east / np.cos(np.radians(42.3))}


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("factor", [1.0, 0.93, 1.07])
def test_a_scale_that_is_a_little_wrong_is_found_where_the_boat_turns(factor, noise):
    boat = sail(8, lowest=0.0)
    found = driven(boat, speed=factor * boat["u"], **placed(boat, noise=noise))
    assert told(found)["surge", "unit"] == ("m/s", "certain" if factor == 1 else "unsure")


def steered(seed=0, minutes=6, rate=math.inf):
    """A boat whose speed is controlled, with its setpoint `ref`, that changes by `rate`, m/s², at most."""
    rng, step = np.random.default_rng(seed), 0.25
    goal = np.concatenate([np.full(int(rng.uniform(10, 25) / step), rng.uniform(0.3, 2)) for _ in range(50)])
    turn = np.repeat(rng.uniform(-0.3, 0.3, 600), 20)
    rows, ref, u, psi, n, e, push = [], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(int(minutes * 60 / step)):
        ref += float(np.clip(goal[k] - ref, -rate * step, rate * step))
        push += 0.1 * rng.normal() - 0.1 * push
        thrust = 0.4 * ref + 0.6 * (ref - u)
        u += step * (2.5 * thrust - u + 0.2 * push) / 2.5
        psi += step * turn[k]
        n, e = n + step * u * np.cos(psi), e + step * u * np.sin(psi)
        rows.append((k * step, thrust + turn[k], thrust - turn[k], psi, ref, u + 0.02 * rng.normal(), n, e))
    boat = dict(zip(("time", "l", "r", "psi", "ref", "u", "n", "e"), np.array(rows).T, strict=True))
    boat["hdg"] = np.degrees(boat["psi"]) % 360
    return boat | {"lat": 42.3 + boat["n"] / 111195, "lon": -71.1 + boat["e"] / 111195 / np.cos(np.radians(42.3))}


@pytest.mark.parametrize("rate", [math.inf, 0.2])
@pytest.mark.parametrize("name", ["speed", "vitesse", "v"])
def test_a_setpoint_is_no_speed_beside_a_position(name, rate):
    boat = steered(rate=rate)
    found = driven(boat, **{name: boat["ref"]}, **placed(boat))
    assert "surge" not in found.channels
    (told_of,) = (each for each in found.decisions if each.channel == "surge")
    assert told_of.reason.startswith(f"{name} is constant for long")


@pytest.mark.parametrize("factor", [1.0, 1.944])
def test_a_setpoint_without_a_position_is_asked(factor):
    boat = steered(1)
    assert tell(boat, "surge series", geschwindigkeit=factor * boat["ref"]) == ("geschwindigkeit", "unsure")


@pytest.mark.parametrize(("name", "measured"), [("speed", "v_filt"), ("velocity", "gps_v"), ("spd", "dvl_x")])
def test_what_follows_a_setpoint_is_the_speed_and_both_are_named(name, measured):
    boat = steered(2)
    found = driven(boat, **{name: boat["ref"], measured: boat["u"]})
    (series,) = (each for each in found.decisions if each[:2] == ("surge", "series"))
    assert (series.value, series.certainty, series.alternatives) == (measured, "unsure", (name,))
    named = driven(boat, **{name: boat["ref"]}, ist_speed=boat["u"])
    assert told(named)["surge", "series"] == ("ist_speed", "probable")


@pytest.mark.parametrize("held", [1, 4, 12])
def test_a_coarse_or_slow_speed_is_no_setpoint(held):
    boat = steered(3)
    speed = np.round(boat["u"][np.arange(len(boat["u"])) // held * held], 1)
    assert tell(boat, "surge series", speed=speed, other_ref=boat["ref"]) == ("speed", "probable")


@pytest.mark.parametrize("factor", [1.0, 1.944, 0.93])
@pytest.mark.parametrize("current", [0.8, 1.0])
def test_the_unit_of_a_speed_over_ground_is_known_in_a_current(current, factor):
    time, rng = np.arange(0, 600, 0.2), np.random.default_rng(0)
    turn = np.repeat(0.4 * rng.choice([-1, 0, 1], 60), 50)
    heading, speed = np.cumsum(0.2 * turn), 1.3 + 0.5 * np.sin(time / 11)
    rate = speed * np.exp(1j * heading) + current
    places = [(time, np.cumsum(0.2 * part)) for part in (rate.real, rate.imag)]
    found = speed_on_positions(*places, (time, factor * np.abs(rate)), (time, heading))
    assert abs(found.slope / factor - 1) < 0.02


@pytest.mark.parametrize(
    ("name", "factor", "place"),
    [("speed", -1, ("lat", "lon")), ("stw_kn", -1.944, ("north", "east")), ("fart", -3.6, ("lat", "lon"))],
)
def test_a_speed_that_is_negative_ahead_is_read_with_a_span(name, factor, place):
    boat = sail(6)
    own = {**boat, "north": boat["n"], "east": boat["e"]}
    track = {each: own[each] for each in place}
    found = driven(boat, **{name: factor * boat["u"]}, **track)
    assert (found.channels["surge"]["span"], told(found)["surge", "span"]) == (-1, ("-1", "probable"))
    assert told(found)["command_left", "sign"] == ("positive ahead", "certain")
    assert "span" not in driven(boat, **{name: -factor * boat["u"]}, **track).channels["surge"]
