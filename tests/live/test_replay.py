"""A recorded session that train.py replays gives the same predictions to the last bit."""

import math

import numpy as np
import pytest

from tests.support.live import PLAIN, boat, messages, ready, replayed, sail
from usvlearn.live.start import Middleware
from usvlearn.logs.channels.channel import AUTO
from usvlearn.logs.channels.derived_surge import VELOCITIES


def live(folder, start, posts, middleware=PLAIN) -> np.ndarray:
    """The predictions of a recorded session, `(steps, members and rules)`."""
    with ready(folder, start, middleware, record=True) as session:
        names = session._node.online.names
        steps = sail(session, posts) + session._node.finish()
    return np.array([[step.members.get(name, np.nan) for name in names] for step in steps])


def test_live_is_replay(tmp_path, start):
    """Also where messages come late: a record says for how long the node has waited for them."""
    posts = list(messages(boat()))
    late = [(k + 20.5 if part == "command_left" and k > 3000 else k) for k, (part, _, _) in enumerate(posts)]
    predicted = live(tmp_path, start, [posts[k] for k in np.argsort(late)])
    np.testing.assert_array_equal(replayed(tmp_path / "records"), predicted)
    assert np.isfinite(predicted).mean() > 0.3


@pytest.mark.thorough
def test_after_a_reboot_a_second_record_replays_what_follows(tmp_path, start):
    posts = list(messages(boat(0.05), 0.0))
    with ready(tmp_path, start, record=True) as session:
        names = session._node.online.names
        sail(session, posts[:2000])
        session.restart()
        steps = sail(session, posts) + session._node.finish()
    predicted = np.array([[step.members.get(name, np.nan) for name in names] for step in steps])
    np.testing.assert_array_equal(replayed(tmp_path / "records", 2), predicted)


@pytest.mark.thorough
@pytest.mark.parametrize("windows", [(0.5, 0.25, 0.3), (AUTO, AUTO, AUTO)])
def test_live_is_replay_where_the_node_mixes_commands_and_computes_the_surge(tmp_path, start, windows):
    """Throttle and steering make both commands, velocities to the north and east the surge; clocks jump."""
    command, heading, velocity = windows
    channels = {
        "command_left": {"name": ["throttle", "steering"], "weight": [1.0, 1.0], "window": command},
        "command_right": {"name": ["throttle", "steering"], "weight": [1.0, -1.0], "window": command},
        "heading": {"name": "psi", "unit": "deg", "window": heading},
        **{name: {"name": name, "unit": "cm/s", "window": velocity} for name in VELOCITIES},
    }
    predicted = live(tmp_path, start, steered(), Middleware("test", PLAIN.reader, channels))
    np.testing.assert_array_equal(replayed(tmp_path / "records"), predicted)
    assert np.isfinite(predicted).mean() > 0.8


def steered():
    """Messages of a boat with throttle and steering, in which the clock jumps and some values are no numbers."""
    now = {"command_left": 0.0, "command_right": 0.0, "heading": 0.0}
    for k, (part, stamp, value) in enumerate(messages(boat(0.05))):
        stamp += 3600.0 * (k > 1500)
        now[part] = value
        if part.startswith("command"):
            throttle = (now["command_left"] + now["command_right"]) / 2
            steering = (now["command_left"] - now["command_right"]) / 2
            for side in ("command_left", "command_right"):
                yield f"{side}[0]", stamp, throttle if k % 97 else math.nan
                yield f"{side}[1]", stamp, steering
        elif part == "heading":
            yield "heading", stamp, math.degrees(value)
        else:
            yield "velocity_north", stamp, 100.0 * value * math.cos(now["heading"])
            yield "velocity_east", stamp + 0.004, 100.0 * value * math.sin(now["heading"])
