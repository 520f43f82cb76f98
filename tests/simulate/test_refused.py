"""What a simulation is given and cannot be: refused by the name of the argument."""

import numpy as np
import pytest

from usvlearn.errors import ConfigError
from usvlearn.simulate.example_logs import example_logs
from usvlearn.simulate.fault import Fault
from usvlearn.simulate.fleet import fleet
from usvlearn.simulate.gusts import Gusts
from usvlearn.simulate.planar import HERON, simulate_planar
from usvlearn.simulate.sensors import Sensors

WRONG = (
    (Fault, {"drag": 0.0, "over": -1.0, "side": "bow", "share": 2.5, "minute": -1.0}),
    (fleet, {"hours": 0.0, "plant": "canoe", "missions": ["race"], "current": -1.0}),
    (Gusts, {"per_hour": -1.0, "seconds": (5.0, 1.0), "minute": -1.0}),
    (Sensors, {"commands": "often", "surge_hz": 0, "jitter": 0.2, "lost_share": 2.0, "outage": [3.0, 1.0],
               "stuck": (1.0, -1.0)}),
    *((example_logs, {"minutes": minutes}) for minutes in (0.0, -1.0, float("nan"), 1e9)),
    (lambda dt: simulate_planar(HERON, np.zeros((1, 2)), dt), {"dt": 0.0}),
)  # fmt: skip


@pytest.mark.parametrize(("make", "name", "value"), [(make, *each) for make, wrong in WRONG for each in wrong.items()])
def test_what_is_out_of_range_is_refused_by_name(make, name, value):
    with pytest.raises(ConfigError, match=name):
        make(**{name: value})
