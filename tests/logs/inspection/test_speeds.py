"""Which series is the speed, and how surely: scales that are a little wrong, and setpoints beside measured speeds."""

import numpy as np
import pytest

from tests.logs.inspection.test_strangers import driven
from tests.support.strangers import sail, told


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
