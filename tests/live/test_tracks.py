"""A node that makes tracks: the same samples, states and tracks as a replay, and what it publishes of them."""

import json
import math

import numpy as np
import pytest
import torch

from tests.support import commands
from tests.support.live import PLAIN, TURNING, messages, planar, planar_set, planar_setup, ready, turning
from usvlearn.core import checkpoint
from usvlearn.core.samples import tree_map
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.online import Online
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.live.health import COMPILING
from usvlearn.live.moos.block import MIDDLEWARE, interface
from usvlearn.live.node import Node
from usvlearn.live.node_folder import NodeFolder
from usvlearn.live.start import Options, begin
from usvlearn.live.status import of_step, page
from usvlearn.logs.channels.channel import AUXILIARY
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs import files


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return planar_set(tmp_path_factory.mktemp("run"))


def node() -> Node:
    return Node(planar_setup(turning()), Online(planar()))


@pytest.fixture(scope="module")
def sailed():
    """A node after six minutes, its steps, and the tracks' errors that each step has learned from."""
    one, steps, due = node(), [], []
    for message in messages(turning(), 0.0):
        for step in one.push(*message):
            steps.append(step)
            due.append(one.online.leaf("track.due"))
    for step in one.finish():
        steps.append(step)
        due.append(one.online.leaf("track.due"))
    return one, steps, np.array(due)


@pytest.mark.thorough
def test_live_is_replay(sailed):
    """To the last bit: what is learned, the tracks that have become due, and so all samples."""
    one, steps, due = sailed
    (replayed,) = align_fleet([turning()], dt=0.4).runs
    samples = tree_map(lambda x: x[:, 0], replayed.planar)
    model = planar()
    with torch.no_grad():
        ((state, record),) = chunked_rollout(model, model.init(), [samples], ["track.due"])
    np.testing.assert_array_equal(due, record["track.due"])
    assert len(steps) == len(due) == 901 and np.isfinite(due[:, 0, 0]).sum() > 100
    for name, leaf in arrays_of(state).items():
        np.testing.assert_array_equal(one.online.leaf(name), leaf, err_msg=name)


def test_it_publishes_places_under_the_commands_in_force(sailed):
    one, steps, _ = sailed
    last = steps[-1]
    assert one.track_horizons == (2.0, 5.2, 10.0, 30.0) == tuple(last.places)
    ahead = one._aligner.ahead(75)
    track = one.online.forecast(np.stack([ahead.command_left, ahead.command_right], -1), dt=0.4)
    np.testing.assert_array_equal(track.north, last.track.north)
    ten, major = last.places[10.0], track.ellipse()[0][24]
    assert ten[:2] == (track.north[24], track.east[24]) and major < ten.major < math.inf  # commands change
    assert tuple(last.places_if_held) == one.track_horizons and last.places_if_held[10.0].major < ten.major
    assert ten.heading == pytest.approx(math.degrees(track.heading[24]) % 360) and 0 <= ten.bearing < 180
    (post,) = [post.value for post in of_step(last) if post.name == "TRACK"]
    rows = dict(row.split("=") for row in post.split(","))
    assert list(rows) == ["2", "5.2", "10", "30"]
    np.testing.assert_allclose([float(x) for x in rows["10"].split(":")], ten, atol=0.051)
    (first,) = [post.value for post in of_step(steps[3]) if post.name == "TRACK"]
    assert first.count(":") == 8, "an ellipse that is not known yet is left out"
    (line,) = [line for line in page(COMPILING, last) if line.startswith("Track 10 s")]
    assert f"{ten.north:.1f} m north" in line and f"within {ten.major:.1f} x" in line


def test_a_plan_of_commands_is_answered_by_a_track(sailed):
    one, _, _ = sailed
    reply = json.loads(one.answer('{"id": 3, "t": [0, 4], "left": [0.5, 0.8], "right": [0.5, 0.6]}'))
    commands = np.where(np.arange(75)[:, None] < 10, [0.5, 0.5], [0.8, 0.6])
    track = one.online.forecast(commands, dt=0.4)
    for name in ("north", "east", "surge", "sway"):
        np.testing.assert_allclose(reply[name], getattr(track, name), atol=6e-4)
    assert reply["id"] == 3 and reply["t"][-1] == 30.0 and len(reply["major"]) == len(reply["heading"]) == 75
    rows = dict(row.split("=") for row in one.answer("0,0.5,0.5; 4,0.8,0.6").split(","))
    np.testing.assert_allclose(
        [float(x) for x in rows["10"].split(":")][:2], [track.north[24], track.east[24]], atol=6e-3
    )
    headed = one.answer("0,0.5,0.5,1.0")
    assert headed.count(":") < 2 * 75 + 1 and "=" in headed, "with headings it is answered by speeds"


BAD = {
    "no heading for 6 s": lambda name, time, value: None if name == "heading" and 60 < time < 66 else value,
    "a frozen gyro": lambda name, time, value: 0.3 if name == "yaw_rate" and time > 60 else value,
    "jumps of 100 m": lambda name, time, value: value + 1.6e-5 * (name == "latitude" and 60 < time < 90),
    "no position": lambda name, time, value: None if name == "latitude" and time > 60 else value,
    "positions that are none": lambda name, time, value: math.inf if name == "longitude" and time > 60 else value,
    "velocities that are none": lambda name, time, value: 1e30 if name == "velocity_east" and 60 < time else value,
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_survived(name):
    one, steps, spoil = node(), [], BAD[name]
    for part, stamp, value in messages(turning(), 0.0):
        if stamp < 100 and (given := spoil(part, stamp, value)) is not None:
            steps += one.push(part, stamp, given)
    for leaf, values in one.online.state.items():
        if ".members." in leaf or leaf in ("track.before", "track.covariance", "track.error", "track.quantile"):
            assert np.isfinite(values).all() or values.dtype == bool, leaf
    assert np.isfinite(steps[-1].speed) and np.isfinite([point[:3] for point in steps[-1].places.values()]).all()
    assert not any("nan" in str(post.value) or "inf" in str(post.value) for step in steps for post in of_step(step))


def test_of_a_run_the_checkpoint_that_makes_tracks_comes_first(tmp_path, run):
    start = begin(NodeFolder(tmp_path), Options(tmp_path, run), PLAIN)
    assert start.facts["kernel"]["kind"] == "planar" and "planar/checkpoints" in start.sentence
    assert {"latitude", "velocity_east"} <= set(start.setup.channels) and files.PLANAR == "planar"
    plain = begin(NodeFolder(tmp_path), Options(tmp_path, run / "checkpoints" / "planar"), PLAIN)
    assert plain.facts["kernel"]["kind"] != "planar" and not set(AUXILIARY) & set(plain.setup.channels)
    moos = begin(NodeFolder(tmp_path), Options(tmp_path, run), MIDDLEWARE._replace(reader="another"))
    assert moos.setup.channels["north"].name == "NAV_Y" and "NAV_X" in interface()


def test_damaged_checkpoints_of_tracks_leave_those_of_the_speed(tmp_path):
    run = planar_set(tmp_path / "run")
    (path,) = (run / "planar").glob("*/*/*.safetensors")
    path.write_bytes(path.read_bytes()[:-9])
    start = begin(NodeFolder(tmp_path), Options(tmp_path, run), PLAIN)
    assert start.facts["kernel"]["kind"] == "ensemble" and start.warnings[0].startswith("no tracks: ")


def test_a_session_saves_tracks_and_waits_for_no_position(tmp_path, run):
    with ready(tmp_path, run, record=True) as session:
        for part, stamp, value in messages(turning()):
            if not part.startswith("l") and stamp < 1.7e9 + 30:
                session.push(part, stamp, value)
        health = session.tick()
        assert health.state == "ok" and "latitude" not in health.ages and session.last.places
        path = session.save()
    again = Online.open(path)
    assert again.description["kind"] == "planar"
    assert (tmp_path / "records" / "record_0001" / "planar").is_dir()


@pytest.mark.thorough
def test_a_record_is_replayed_with_its_tracks(tmp_path):
    """By train.py, from a run and the record, though the first position came after half a minute."""
    quick = [each for each in commands.QUICK[1:] if each != "tracks=null"]
    commands.ran("data=planar", "data.hours=0.05", "hydra.run.dir=run", *quick, folder=tmp_path)
    with ready(tmp_path / "node", tmp_path / "run", TURNING, record=True) as session:
        for part, stamp, value in messages(turning()):
            if stamp < 1.7e9 + 100 and (not part.startswith("l") or stamp > 1.7e9 + 30):
                session.push(part, stamp, value)
        session._node.finish()
        learned = session._node.online.state
    records = tmp_path / "node" / "records"
    overrides = ("data=record_0001.yaml", "resume=record_0001", "hydra.run.dir=again", *quick)
    commands.ran(*overrides, folder=records)
    leaves, _ = checkpoint.load(checkpoint.checkpoints(records / "again" / "planar" / "checkpoints" / "boat")[-1])
    for name, leaf in learned.items():
        np.testing.assert_array_equal(leaves[name], leaf, err_msg=name)
