"""Two clocks in one log: the heading's and the receiver's."""

import numpy as np
import pytest

from tests.support.strangers import sail
from usvlearn.logs.channels.channel import Channel, Recording
from usvlearn.logs.checks.data_check import check_data

CHANNELS = {"heading": {"unit": "deg"}, "surge": {"unit": "m/s"}} | {key: {"unit": "m"} for key in ("north", "east")}


def found(late: float, off: float = 0.0, minutes: float = 8.0) -> list[str]:
    """Kinds of findings where the receiver is so many s late, and the compass off by so many degrees."""
    boat = sail(minutes)
    angle = np.radians(boat["hdg"] + off)
    values = {"command_left": boat["l"], "command_right": boat["r"], "heading": angle, "surge": boat["u"]}
    values |= {"north": boat["n"], "east": boat["e"]}
    lag = {"north": late, "east": late}
    order = np.arange(len(angle))
    channels = {name: Channel(boat["time"] + lag.get(name, 0), each, order) for name, each in values.items()}
    return [each.kind for each in check_data([Recording("a", "b", channels, {})], None, {}, 3.0, CHANNELS)]


@pytest.mark.parametrize("late", [18.0, -18.0, 8.0, -30.0])
def test_a_receiver_with_another_clock_is_found_in_both_directions(late):
    assert "clocks" in found(late)


@pytest.mark.parametrize(("late", "off"), [(0, 0), (2, 0), (0, 30), (-1, -40)])
def test_a_late_receiver_and_a_wrong_compass_are_no_other_clock(late, off):
    assert "clocks" not in found(late, off)
