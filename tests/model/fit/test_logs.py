"""A run's logs as missions to fit: what is refused."""

import warnings

import numpy as np
import pytest

from tests.support.strangers import sail
from usvlearn.errors import ConfigError
from usvlearn.logs.channels.channel import Channel, Recording
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.fit.logs import fine, missions_of


def missions(speed: str):
    boat = sail(6)
    own = {"command_left": boat["l"], "command_right": boat["r"], "heading": boat["psi"], "surge": boat[speed]}
    order = np.arange(len(boat["time"]))
    channels = {name: Channel(boat["time"], value, order, window=1.0) for name, value in own.items()}
    with warnings.catch_warnings(action="ignore"):
        return missions_of(align_fleet([Recording("a", "1", channels, {})], **fine({})), "a")


def test_minutes_astern_whose_speed_has_no_sign_are_refused():
    with pytest.raises(ConfigError, match=r"a: found 0\.\d min in which both commands push astern"):
        missions("sog")
    assert missions("u")
