"""The whole node beside a boat that sails in a simulator and talks MAVLink over UDP."""

import argparse
import io
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support import ROOT, few
from tests.support.live import replayed
from tests.support.mavboat import HERE, MavBoat, Motion, OnTheAir, free_port, turning
from tests.support.voyages import voyage
from usvlearn.core import checkpoint
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.live.mavlink.shell import MIDDLEWARE, check_arguments, main, run
from usvlearn.live.session import Session
from usvlearn.live.start import Options
from usvlearn.live.status import StatusLine

WARP = 40.0


def sailing(seed: int = 0):
    """The motion of a simulated boat on patrol."""
    course = voyage(seed=seed, minutes=6.0, lowest=0.0)
    names = "command_left", "command_right", "heading", "yaw_rate", "surge"
    time = np.arange(0.0, 360.0, 0.02)
    columns = [course.at(name, time) for name in names]

    def motion(at: float) -> Motion:
        k = min(round(at / 0.02), len(time) - 1)
        return Motion(*(float(column[k]) for column in columns))

    return motion


def sailed(session: Session, boat: MavBoat, seconds: float) -> list:
    """The steps of a session that listens in a thread of its own, in warped time, beside a boat."""
    port, steps, took, stopped = free_port(), [], session._took, threading.Event()
    session._took = lambda more: (steps.extend(more), took(more))
    given = argparse.Namespace(connection=f"udpin:{HERE}:{port}", system=None, rate=None, peer=None)
    air, line = OnTheAir(boat, port, seconds, WARP), StatusLine("node", io.StringIO())
    with session, ThreadPoolExecutor(1) as pool:
        listening = pool.submit(
            run, session, given, check_arguments(given), stopped, line, lambda: WARP * time.monotonic()
        )
        try:
            air.start()
            air.join(60)
            time.sleep(0.3)
        finally:
            stopped.set()
        listening.result(10)
    return steps


@pytest.mark.thorough
def test_a_boat_in_the_loop_is_learned_as_in_a_replay(tmp_path, start):
    options = Options(tmp_path / "node", start, warp=WARP, record=True, refit=False)
    session, boat = Session(options, MIDDLEWARE), MavBoat(sailing(), booted=-100.0)
    session.start()
    assert session.wait(300)
    steps = sailed(session, boat, 300.0)
    names = session._node.online.names
    predicted = np.array([[step.members.get(name, np.nan) for name in names] for step in steps])
    np.testing.assert_array_equal(replayed(tmp_path / "node" / "records"), predicted)
    errors = np.array([abs(step.measured - step.speed) for step in steps[len(steps) // 2 :]])
    assert np.nanmean(errors) < 0.1 and np.isfinite(errors).mean() > 0.9
    assert len(steps) > 0.9 * 300 / 0.4  # nothing was lost on the way
    sent = {name for _, name, _ in boat.values}
    assert {"USV_PRED", "USV_NEXT", "USV_ERR", "USV_LOW", "USV_HIGH"} <= sent and all(len(name) <= 10 for name in sent)
    assert [text for _, text in boat.texts if "listening to system 1" in text]


@pytest.mark.thorough
@pytest.mark.parametrize("number", few([signal.SIGTERM, signal.SIGINT], [signal.SIGTERM]))
def test_a_signal_saves_and_ends_with_code_0(tmp_path, number):
    port, folder = free_port(), tmp_path / "node"
    command = [sys.executable, "-m", "usvlearn", "live", "mavlink", f"udpin:{HERE}:{port}", "--folder", str(folder),
               "--mass", "28", "--surge-max", "2.7"]  # fmt: skip
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
    boat = OnTheAir(MavBoat(turning, booted=-20.0), port, 120.0)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as node:
        boat.start()
        try:
            end = time.monotonic() + 90
            while not any(name == "USV_PRED" for _, name, _ in boat.boat.values) and time.monotonic() < end:
                assert node.poll() is None
                time.sleep(0.1)
            node.send_signal(number)
            said, _ = node.communicate(timeout=120)
        finally:
            boat.ended.set()
            node.kill()
    assert node.returncode == 0, said
    for sentence in ("starting from the prior", "listening to system 1, component 1", "saved; ends"):
        assert f"usvlearn: {sentence}" in said
    assert len(checkpoint.checkpoints(folder)) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tcp:a:1"], "connection: found 'tcp:a:1', expected udpin"),
        (["udpin:a:1", "--system", "0"], "--system: found 0, expected an id of 1 to 255"),
        (["udpin:a:1", "--rate", "1000"], "--rate: found 1000, expected 0.5 to 200"),
    ],
)
def test_options_outside_their_range_are_refused(arguments, message):
    with pytest.raises(ConfigError) as caught:
        main(arguments)
    assert str(caught.value).startswith(message)


def test_without_pymavlink_the_extra_is_named(monkeypatch, tmp_path):
    for name in [name for name in sys.modules if name.partition(".")[0] == "pymavlink"] + ["pymavlink"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"live mavlink needs the package pymavlink.*\[mavlink\]"):
        main(["udpin:127.0.0.1:14550", "--folder", str(tmp_path)])
