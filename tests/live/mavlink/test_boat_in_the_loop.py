"""The whole node beside a boat that sails in a simulator and talks MAVLink over UDP."""

import argparse
import contextlib
import io
import math
import os
import pty
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support import ROOT, few
from tests.support.live import replayed
from tests.support.mavboat import HERE, MavBoat, Motion, OnTheAir, RecordingSession, free_port, mavlink, turning
from tests.support.voyages import voyage
from usvlearn.core import checkpoint
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.live.mavlink.shell import MIDDLEWARE, check_arguments, main, run
from usvlearn.live.session import Session
from usvlearn.live.start import Options
from usvlearn.live.status import StatusLine
from usvlearn.logs.channels.channel import Source

WARP = 40.0


def sailing(seed: int = 0):
    """The motion of a simulated boat on patrol."""
    made = voyage(seed=seed, minutes=6.0, lowest=0.0)
    names = "command_left", "command_right", "heading", "yaw_rate", "surge"
    time = np.arange(0.0, 360.0, 0.02)
    columns = [made.at(name, time) for name in names]

    def motion(at: float) -> Motion:
        k = min(round(at / 0.02), len(time) - 1)
        return Motion(*(float(column[k]) for column in columns))

    return motion


class Listening:
    """A session that listens in a thread of its own, in warped time."""

    def __init__(self, session: Session, connection: str, warp: float = 1.0):
        self.session, self.stopped, self.error = session, threading.Event(), None
        self.said = io.StringIO()
        self._given = argparse.Namespace(connection=connection, system=None, rate=None, peer=None)
        self._warp = warp
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        try:
            clock = lambda: self._warp * time.monotonic()  # noqa: E731
            run(
                self.session,
                self._given,
                check_arguments(self._given),
                self.stopped,
                StatusLine("node", self.said),
                clock,
            )
        except BaseException as error:
            self.error = error

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.stopped.set()
        self._thread.join(10)
        assert not self._thread.is_alive() and self.error is None, self.error


def sailed(session: Session, boat: MavBoat, seconds: float, meddle=lambda time, air: []) -> list:
    """The steps of a session beside a boat; `meddle` takes the boat's time and the boat on the air."""
    port, steps, took = free_port(), [], session._took
    session._took = lambda found: (steps.extend(found), took(found))
    air = OnTheAir(boat, port, seconds, WARP, lambda time: meddle(time, air))
    with session, Listening(session, f"udpin:{HERE}:{port}", WARP):
        air.start()
        air.join(60)
        time.sleep(0.3)
    return steps


def begun(folder, start, **options) -> Session:
    session = Session(Options(folder, start, warp=WARP, **options), MIDDLEWARE)
    session.start()
    assert session.wait(300)
    return session


def errors_of(steps) -> np.ndarray:
    return np.array([abs(step.measured - step.speed) for step in steps])


@pytest.mark.thorough
def test_a_boat_in_the_loop_is_learned_as_in_a_replay(tmp_path, start):
    session, boat = begun(tmp_path / "node", start, record=True), MavBoat(sailing(), booted=-100.0)
    steps = sailed(session, boat, 300.0)
    names = session._node.online.names
    predicted = np.array([[step.members.get(name, np.nan) for name in names] for step in steps])
    np.testing.assert_array_equal(replayed(tmp_path / "node" / "records"), predicted)
    errors = errors_of(steps[len(steps) // 2 :])
    assert np.nanmean(errors) < 0.1 and np.isfinite(errors).mean() > 0.9
    assert len(steps) > 0.9 * 300 / 0.4  # nothing was lost on the way
    told = {name for _, name, _ in boat.values}
    assert {"USV_PRED", "USV_NEXT", "USV_ERR", "USV_LOW", "USV_HIGH"} <= told and all(len(name) <= 10 for name in told)
    assert [text for _, text in boat.texts if "listening to system 1" in text]


@pytest.mark.slow
def test_a_boat_that_does_everything_wrong_is_learned_all_the_same(tmp_path, start):
    boat, rng, done = MavBoat(sailing(), booted=-100.0), np.random.default_rng(0), set()
    stranger = MavBoat(lambda time: Motion(1.0, 1.0, 1.0, 0.0, 9.0), sender=(9, 1))
    stranger.intervals = dict.fromkeys((30, 32, 36), 0.1)

    def once(name: str) -> bool:
        return name not in done and not done.add(name)

    def meddle(time: float, air: OnTheAir) -> list[bytes]:
        found = []
        if 40 < time < 60:  # garbage, cut frames, wrong checksums, numbers that are none
            frame = bytearray(boat.packed(boat.message(30, time)))
            frame[rng.integers(1, len(frame))] ^= 64
            nan = mavlink.MAVLink_attitude_message(round(1000 * (time - boat.booted)), 0, 0, math.nan, 0, 0, math.inf)
            found += [rng.bytes(rng.integers(1, 300)), bytes(frame), bytes(frame[: rng.integers(len(frame))])]
            found += [boat.packed(nan)]
        air.mute = 80 < time < 110
        if time > 140 and once("reboot"):
            boat.reboot(time)
        if 180 < time < 200:
            found += stranger.due(time)
        boat.armed = not 220 < time < 235
        if time > 255 and once("ahead"):
            boat.booted -= 3600.0
        if time > 285 and once("back"):
            boat.booted += 3600.0
        return found

    session = begun(tmp_path / "node", start)
    steps = sailed(session, boat, 340.0, meddle)
    assert done == {"reboot", "ahead", "back"}
    health = session.tick()
    assert health.counts["heading"]["not_a_number"] > 100 and health.counts["command_left"]["disarmed"] > 100
    times = np.array([step.time for step in steps if np.isfinite(step.speed)])
    (breaks,) = np.nonzero(np.abs(np.diff(times)) > 5.0)
    assert len(breaks) >= 5  # silence, reboot, disarmed, ahead, back; and steps after each
    assert np.nanmean(errors_of(steps[-60:])) < 0.15 and max(step.measured for step in steps[20:]) < 4.0
    assert np.isfinite(errors_of(steps)).sum() > 0.6 * 340 / 0.4
    texts = " ".join(text for _, text in boat.texts)
    assert texts.count("the vehicle's clock began anew") == 2 and "system 9" in texts


@pytest.mark.slow
def test_a_boat_at_a_serial_line_is_heard_and_answered():
    other, own = pty.openpty()
    os.set_blocking(other, False)
    boat = MavBoat(turning, booted=-100.0)
    session = RecordingSession({part: Source(**each) for part, each in MIDDLEWARE.channels.items()})
    with Listening(session, f"{os.ttyname(own)},115200") as node:
        begun = time.monotonic()
        while (now := time.monotonic() - begun) < 120.0 and len(session.channel("command_left")[0]) < 20:
            frames = boat.due(now)
            with contextlib.suppress(BlockingIOError):
                frames += boat.hear(os.read(other, 4096))
            os.write(other, b"\xfd\x05noise".join(frames))
            time.sleep(0.005)
    os.close(own)
    os.close(other)
    time_of, share = session.channel("command_left")
    assert len(share) >= 20 and abs(share[-1] - turning(time_of[-1] - 100.0).left) < 0.01
    assert "listening to system 1" in node.said.getvalue() and any("listening to" in text for _, text in boat.texts)


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
            said, _ = node.communicate(timeout=20)
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
