"""In which unit a heading is: what a full turn is, by the range of one that goes round."""

import math

import numpy as np
import pytest

from tests.support.strangers import concluded, sail, told


@pytest.mark.parametrize(
    ("turn", "low", "step"),
    [(256, 0, 1), (256, -128, 1), (400, -200, 0.1), (3600, -1800, 1), (6400, 0, 1), (6400, -3200, 1), (36000, 0, 1),
     (65536, 0, 1), (65536, -32768, 1)],
)  # fmt: skip
@pytest.mark.parametrize("placed", [False, True])
def test_a_heading_that_goes_round_tells_what_a_full_turn_is(turn, low, step, placed):
    boat = sail(4, lowest=0.0)
    raw = (np.round(boat["psi"] / (2 * math.pi) * turn / step) * step - low) % turn + low
    found = concluded(
        boat,
        left=boat["l"],
        right=boat["r"],
        heading=raw,
        speed=boat["u"],
        **({"lat": boat["lat"], "lon": boat["lon"]} if placed else {}),
    )
    own = found.channels["heading"]
    assert (own["unit"], own.get("span", 1.0)) == ("deg", float(f"{turn / 360:.6g}"))
    assert told(found)["heading", "unit"] == ("deg", "certain" if placed else "unsure")


@pytest.mark.parametrize("low", [0, -180])
@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_a_heading_in_whole_degrees_stays_in_degrees(low, noise):
    boat = sail(4)
    raw = np.round((boat["hdg"] - low) % 360 + low) + noise * np.random.default_rng(0).normal(size=len(boat["hdg"]))
    own = concluded(boat, left=boat["l"], right=boat["r"], heading=raw, speed=boat["u"]).channels["heading"]
    assert (own["unit"], own.get("span", 1.0)) == ("deg", 1.0)


@pytest.mark.parametrize("name", ["yaw_enu_rad", "heading_ENU", "att.enu.yaw"])
def test_a_name_tells_that_a_heading_counts_from_east(name):
    boat = sail(4)
    yaw = (math.pi / 2 - boat["psi"] + math.pi) % (2 * math.pi) - math.pi
    found = concluded(boat, left=boat["l"], right=boat["r"], speed=boat["u"], **{name: yaw})
    assert told(found)["heading", "unit"] == ("enu_rad", "probable")
    assert told(found)["command_left", "series"] == ("left", "certain")
