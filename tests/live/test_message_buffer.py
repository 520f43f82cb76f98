"""The data check aboard: it warns of what a replay's would, and is silent about regular messages."""

import time

import numpy as np
import pytest

from tests.support.live import boat, messages, ready
from usvlearn.live.start import channel_options
from usvlearn.logs.channels.channel import REQUIRED


@pytest.mark.thorough
def test_the_data_check_of_a_replay_watches_the_live_data(tmp_path, start):
    """Speeds in km/h that are taken for m/s."""
    with ready(tmp_path, start) as session:
        for part, stamp, value in messages(boat(0.2)):
            session.push(part, stamp, 3.6 * value if part == "surge" else value)
        clock = time.monotonic()
        assert session.tick(clock=clock + 301.0).warnings == ()
        session._background.wait()
        (warning,) = session.tick(clock=clock + 302.0).warnings
    assert "surge" in warning and "km/h" in warning


def test_the_data_check_needs_many_measurements_but_few_commands_that_are_held(tmp_path, start):
    """A command may come at its changes alone. Speeds in km/h, as above."""
    changes = channel_options({f"command_{side}.held": "true" for side in ("left", "right")})
    with ready(tmp_path, start, channels=changes) as session:
        for part, stamp, value in messages(boat(0.2)):
            session.push(part, stamp, 3.6 * value if part == "surge" else value)
        columns = session._recent.copy()
        held = [name for name in columns if session.setup.channels[name].held]
        assert sorted(held) == ["command_left", "command_right"]
        for name in held:
            time_, value, order = columns[name]
            new = np.flatnonzero(np.diff(value, prepend=np.nan) != 0)[:250]
            columns[name] = time_[new], value[new], order[new]
            assert len(new) < 300
        (warning,) = session._recent.findings(columns, "heron")
        assert "km/h" in warning
        columns["surge"] = tuple(each[:250] for each in columns["surge"])
        assert session._recent.findings(columns, "heron") == []


@pytest.mark.thorough
@pytest.mark.parametrize("rate", [5.0, 10.0, 100.0])
def test_the_data_check_is_silent_about_regular_messages(tmp_path, start, rate):
    """Also where a speed comes just as often as its window is long."""
    log = boat(0.1)
    times = np.arange(0.0, 300.0, 1 / rate)
    values = []
    for name in REQUIRED:
        each = log.channels[name]
        values.append(np.interp(times, each.time, np.unwrap(each.value) if name == "heading" else each.value).tolist())
    with ready(tmp_path, start) as session:
        for time_, *row in zip(times.tolist(), *values, strict=True):
            for name, value in zip(REQUIRED, row, strict=True):
                session.push(name, 1.7e9 + time_, value)
        columns = session._recent.copy()
        assert session._recent.findings(columns, "heron", (2.0,)) == []
