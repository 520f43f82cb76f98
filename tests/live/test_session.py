"""A session in use: what it starts from, what it saves, what it says, and what goes wrong aboard."""

import math
import time
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pytest

from tests.support.live import PLAIN, boat, messages, ready, sail
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.live.session import Session
from usvlearn.live.start import Middleware, Options, add_arguments, channel_options, options_of
from usvlearn.logs.channels.channel import REQUIRED
from usvlearn.logs.setup import Setup

MINUTE = list(messages(boat(0.02)))


def test_a_node_continues_from_the_newest_set_that_can_be_read(tmp_path, start):
    with ready(tmp_path, start) as session:
        assert str(start) in session.sentence
        sail(session, MINUTE)
        first, newest = session.save(), session.save()
        before = checkpoint.load(first)[0]
    newest.write_bytes(newest.read_bytes()[:-7])
    with ready(tmp_path, None) as session:
        assert session.sentence == f"continuing from {first.name} of {tmp_path}"
        assert any("damaged" in each for each in session.tick().warnings)
        after = session._node.online.state
    assert all(np.array_equal(before[name], after[name], equal_nan=True) for name in before)
    facts = checkpoint.load(first)[1]
    assert Setup.of(facts["setup"]).channels["surge"].name == "SURGE"


def test_without_a_set_a_node_starts_from_the_prior_of_a_mass_and_a_top_speed(tmp_path):
    with pytest.raises(ConfigError, match=r"found no checkpoint.*give a checkpoint.*or mass in kg and surge_max"):
        Session(Options(tmp_path), PLAIN)
    with ready(tmp_path, None, mass=28.0, surge_max=2.74) as session:
        assert checkpoint.load(session.save())[1]["setup"]["align"]["dt"] == 0.4  # which `usvlearn controller` needs
        steps = sail(session, messages(boat(0.05)))
    errors = [abs(step.measured - step.speed) for step in steps[len(steps) // 2 :] if math.isfinite(step.speed)]
    assert np.nanmean(errors) < 0.1


@pytest.mark.parametrize("top, limit", [(2.74, 10.0), (14.0, 17.5)])
def test_the_limit_of_a_fast_boat_holds_aboard(tmp_path, top, limit):
    with ready(tmp_path, None, mass=300.0, surge_max=top) as session:
        start = session._begin
    assert start.setup.align.get("surge_max", 10.0) == limit
    kernel = start.facts["kernel"]
    kernel = kernel.get("surge", kernel)
    members = {name: each["numbers"].get("surge_max") for name, each in kernel["members"].items()}
    assert kernel["numbers"]["surge_max"] == members["aid"] == members["arx"] == limit and members["rnn"] == top


def test_what_is_saved_is_bounded_and_the_last_is_of_the_end(tmp_path, start):
    with ready(tmp_path, start, save_period=0.01, keep=3) as session:
        for k, message in enumerate(MINUTE):
            session.push(*message)
            if k % 50 == 0:
                session.tick()
                session._background.wait()  # what the thread had to write is written
        steps = session._node.steps
    saved = checkpoint.checkpoints(tmp_path)
    assert 2 <= len(saved) <= 3
    assert checkpoint.load(saved[-1])[1]["step"] >= steps
    assert not list(tmp_path.glob(".*.tmp"))


def test_a_member_that_is_not_finite_begins_again_where_a_set_is_saved(tmp_path, start):
    with ready(tmp_path, start) as session:
        sail(session, MINUTE)
        leaves = session._node.online.state
        leaves["members.aid.theta"][:] = math.nan
        session._node.online.state = leaves
        saved = checkpoint.load(session.save())[0]
        first = session._begin.leaves
        assert np.array_equal(saved["members.aid.theta"], first["members.aid.theta"])
        assert np.array_equal(saved["members.arx.theta"], leaves["members.arx.theta"])
        assert np.array_equal(session._node.online.state["members.aid.theta"], first["members.aid.theta"])
        health = session.tick()
        assert health.counts["members"] == {"not_finite": 1} and "begins again" in " ".join(health.warnings)


def test_an_outage_saves_once(tmp_path, start):
    with ready(tmp_path, start) as session:
        sail(session, MINUTE)
        clock = time.monotonic()
        for k in range(30):
            health = session.tick(clock=clock + k)
            session._background.wait()
        assert len(checkpoint.checkpoints(tmp_path)) == 1
        assert health.state == "stale" and health.sentence.startswith("no command_left (COMMAND_LEFT) for 29 s, no")


def test_what_is_missing_is_said(tmp_path, start):
    with ready(tmp_path, start) as session:
        for part, stamp, value in MINUTE:
            if part != "heading":
                session.push(part, stamp, value)
        health = session.tick()
        assert health.state == "waiting" and "waiting for heading (HEADING)" in health.sentence
        assert health.ages["heading"] == math.inf


@pytest.mark.thorough
def test_the_end_waits_for_a_save_that_is_being_made(tmp_path, start, monkeypatch):
    """As when SIGTERM comes while a checkpoint is written to a slow disk."""
    write = checkpoint.write_atomically

    def slow(path, content):
        time.sleep(0.3)
        write(path, content)

    with ready(tmp_path, start) as session:
        sail(session, MINUTE[:300])
        monkeypatch.setattr(checkpoint, "write_atomically", slow)
        session.tick(clock=time.monotonic() + 400.0)
        sail(session, MINUTE[300:])
    saved = [checkpoint.load(path)[1]["step"] for path in checkpoint.checkpoints(tmp_path)]
    assert len(saved) == 2 and saved[0] < saved[1] and saved[1] >= session._node.learned
    assert not list(tmp_path.glob(".*.tmp"))


def test_two_nodes_do_not_share_a_folder(tmp_path, start):
    with ready(tmp_path, start):
        with pytest.raises(ConfigError, match="is writing there"):
            Session(Options(tmp_path, start), PLAIN)
    ready(tmp_path, start).close()


def test_a_disk_that_is_full_ends_no_learning(tmp_path, start, monkeypatch):
    with ready(tmp_path, start, save_period=0.001, record=True) as session:
        sail(session, MINUTE[:200])
        good = session.save()

        def full(path, content):
            raise OSError(28, "No space left on device", str(path))

        monkeypatch.setattr(checkpoint, "write_atomically", full)
        session._recorder._file.close()
        session._recorder._file = open("/dev/full", "w")
        sail(session, MINUTE[200:])
        for k in range(3):
            health = session.tick(clock=time.monotonic() + k)
            session._background.wait()
        learned = health.learned
        assert any("no checkpoint can be saved" in each and "make room" in each for each in health.warnings)
        assert any("record_0001.alog ends here" in each for each in health.warnings)
        assert learned > 50
        monkeypatch.undo()
        session.tick(clock=time.monotonic() + 100)
        session._background.wait()
        assert not any("no checkpoint" in each for each in session.tick(clock=time.monotonic() + 101).warnings)
    assert checkpoint.load(good) and len(checkpoint.checkpoints(tmp_path)) >= 2


@pytest.mark.parametrize("jump", [3600.0, -3600.0])
def test_a_clock_that_jumps_begins_a_new_segment(tmp_path, start, jump):
    with ready(tmp_path, start) as session:
        steps = sail(session, MINUTE)
        later = sail(session, MINUTE, jump + 80.0)
        assert len(later) > 0.9 * len(steps)
        assert all(math.isfinite(step.speed) for step in later[-20:])
        assert abs(later[-1].time - steps[-1].time - jump - 80.0) < 2.0


def test_a_reboot_is_a_new_segment_and_a_new_record(tmp_path, start):
    with ready(tmp_path, start, record=True) as session:
        for repeat in range(2):
            steps = [step for part, stamp, value in MINUTE for step in session.push(part, stamp % 1e5, value)]
            if not repeat:
                session.restart()
        assert math.isnan(steps[0].speed) and math.isfinite(steps[-1].speed)
    names = sorted(path.name for path in (tmp_path / "records").iterdir())
    assert names == [f"record_000{k}.{kind}" for k in (1, 2) for kind in ("alog", "safetensors", "yaml")]


def test_bad_messages_are_counted(tmp_path, start):
    with ready(tmp_path, start) as session:
        sail(session, MINUTE)
        before = session._node.online.state["members.aid.theta"]
        stamp = MINUTE[-1][1]
        for value in (math.nan, math.inf, 1e308, -1e308, 50.0):
            session.push("surge", stamp + 0.01, value)
        session.push("heading", math.nan, 1.0)
        session.push("command_left", math.inf, 1.0)
        session.drop("surge", "wrong_type")
        counts = session.tick().counts
        assert counts["surge"]["not_a_number"] == 2 and counts["surge"]["out_of_range"] == 3
        assert counts["surge"]["wrong_type"] == 1
        assert counts["heading"]["no_time"] == counts["command_left"]["no_time"] == 1
        assert np.array_equal(before, session._node.online.state["members.aid.theta"])


def test_a_number_that_is_too_large_to_convert_or_means_unknown_is_one_more_bad_message(tmp_path, start):
    changes = channel_options({"command_left.span": "0.001", "heading.missing": "511,655"})
    with ready(tmp_path, start, channels=changes) as session:
        session.push("command_left", 1.0, 1e308)
        session.push("heading", 1.0, 511.0)
        bad = {"not_a_number": 1}
        assert session.tick().counts == {"command_left": bad, "heading": bad}


@pytest.mark.parametrize("stamp", [1e12, -1e13, 1e18, 1e308])
def test_a_first_stamp_that_is_none_does_not_shift_all_others(tmp_path, start, stamp):
    with ready(tmp_path, start) as session:
        session.push("surge", stamp, 1.0)
        steps = sail(session, MINUTE)
        assert len(steps) > 100 and session.tick().counts["surge"]["no_time"] == 1


def test_a_channel_of_which_no_message_can_be_used_is_told(tmp_path, start):
    """Commands in percent that are taken for shares: all are out of range."""
    with ready(tmp_path, start) as session:
        for part, stamp, value in MINUTE:
            session.push(part, stamp, 100.0 * value + 50.0 if part == "command_left" else value)
        health = session.tick()
    assert health.state == "stale" and "no message can be used of command_left (out_of_range)" in health.sentence


@pytest.mark.parametrize(
    "setup", [3, {"channels": 3}, {"align": {"dt": -1}}, {"align": {"dt": 5.0}}, {"align": {"dt": 0.001}}]
)
def test_a_set_whose_setup_is_not_legal_is_passed_over(tmp_path, start, setup):
    leaves, facts = checkpoint.load(start)
    good = checkpoint.save(tmp_path / "live_00000001.safetensors", leaves, **facts)
    changed = facts["setup"] | setup if isinstance(setup, dict) else setup
    checkpoint.save(tmp_path / "live_00000002.safetensors", leaves, **(facts | {"setup": changed}))
    with Session(Options(tmp_path), PLAIN) as session:
        assert good.name in session.sentence
        assert any("live_00000002" in each and "setup" in each for each in session.warnings)


@pytest.mark.parametrize("boat_name", ["", "..", "a/b", "a\nb", "${x}"])
def test_a_name_that_no_run_can_have_is_refused(tmp_path, boat_name):
    with pytest.raises(ConfigError, match="boat: found"):
        Options(tmp_path, boat=boat_name)
    with pytest.raises(ConfigError, match="folder: found"):
        Options(Path(""))
    with pytest.raises(ConfigError, match="folder: found"):
        Options(Path("a\0b"))


def test_what_to_start_from_is_named_where_there_is_no_set(tmp_path, start):
    leaves, facts = checkpoint.load(start)
    for name in ("anna", "bert"):
        checkpoint.save(tmp_path / "boats" / name / "a.safetensors", leaves, **facts)
    for place, message in (("boats", "start: .*found no checkpoint there: give .*anna or .*bert"),
                           ("none", "start: .*there is no such file or folder")):  # fmt: skip
        with pytest.raises(CheckpointError, match=message):
            Session(Options(tmp_path / "new" / "node", tmp_path / place), PLAIN)
        assert not (tmp_path / "new").exists()  # a folder that is left behind would be taken for that of a node
    (tmp_path / "old").mkdir()
    with pytest.raises(CheckpointError):
        Session(Options(tmp_path / "old", tmp_path / "none"), PLAIN)
    assert (tmp_path / "old").is_dir()


def test_the_end_says_what_was_saved(tmp_path, start, monkeypatch):
    assert ready(tmp_path / "a", start).close() == "ends; it has learned nothing"
    assert checkpoint.checkpoints(tmp_path / "a") == []
    assert Session(Options(tmp_path / "b", start), PLAIN).close() == "ends; it was not ready yet"
    session = ready(tmp_path / "c", start)
    sail(session, MINUTE)
    assert session.close() == "saved; ends"
    session = ready(tmp_path / "d", start)
    sail(session, MINUTE)

    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(checkpoint, "write_atomically", full)
    assert session.close().startswith("ends; no checkpoint can be saved")


def test_names_of_another_kind_of_log_are_not_taken_from_a_set(tmp_path, start):
    """A checkpoint that was learned from CSV says nothing about the variables of a MOOSDB, but its delays hold."""
    leaves, facts = checkpoint.load(start)
    channels = facts["setup"]["channels"]
    for side in ("command_left", "command_right"):
        channels[side] |= {"name": "pwm", "span": 400.0, "delay": 0.3}
    facts["setup"]["reader"] = "usvlearn.logs.formats.csv.table.Table"
    path = checkpoint.save(tmp_path / "csv.safetensors", leaves, **facts)
    names = {name: {"name": name.upper(), "held": True} for name in REQUIRED} | {"surge": {"name": "NAV_SPEED"}}
    middleware = Middleware("test", "usvlearn.logs.formats.moos.alog.Alog", names)
    changes = channel_options({"command_left.span": "-100", "surge.unit": "knots"})
    with Session(Options(tmp_path / "node", path, channels=changes), middleware) as session:
        left, surge = session.sources["command_left"], session.sources["surge"]
    assert (left.name, left.span, left.delay, left.held) == ("COMMAND_LEFT", -100.0, 0.3, True)
    assert (surge.name, surge.unit) == ("NAV_SPEED", "knots")
    same = Middleware("test", "usvlearn.logs.formats.csv.table.Table", middleware.channels)
    with Session(Options(tmp_path / "node2", path), same) as session:
        assert session.sources["command_left"].name == "pwm" and session.sources["command_left"].span == 400.0


def test_what_was_guessed_is_a_warning_until_a_file_of_channels_confirms_it(tmp_path, start):
    leaves, facts = checkpoint.load(start)
    written = {"data.channels.surge.unit": "knots"}
    facts["setup"]["unconfirmed"] = {"surge.unit": {"certainty": "unsure", "written": written}}
    path = checkpoint.save(tmp_path / "guessed.safetensors", leaves, **facts)
    with ready(tmp_path / "node", path) as session:
        (warning,) = session.tick().warnings
        assert warning.startswith("1 guess unconfirmed: surge.unit (unsure).")
        saved = session.save()
    assert Setup.of_set(checkpoint.load(saved)[1]).unconfirmed.keys() == {"surge.unit"}
    file = tmp_path / "my boat.yaml"
    for section, options, count in (
        ("", [], 0),
        ("unconfirmed: {surge.unit: {written: {data.channels.surge.unit: knots}}}", [], 1),
        ("unconfirmed: {surge.unit: {written: {data.channels.surge.unit: knots}}}", ["--channel", "surge.unit=m/s"], 0),
        ("unconfirmed: {time_unit: {written: {data.reader.time_unit: s}}}", [], 0),
    ):
        file.write_text(f"data: {{channels: {{surge: {{unit: knots}}}}}}\n{section}\n")
        parser = ArgumentParser()
        add_arguments(parser)
        arguments = ["--folder", str(tmp_path / "node"), "--channels", str(file), *options]
        with Session(options_of(parser.parse_args(arguments)), PLAIN) as session:
            assert len(session.warnings) == count
            assert all("--confirm KEY '" in each and "my boat.yaml'" in each for each in session.warnings)


def test_tensorboard_shows_a_session(tmp_path, start, monkeypatch):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = tmp_path / "board"
    with ready(tmp_path / "node", start, tensorboard=board) as session:
        for k, message in enumerate(MINUTE):
            session.push(*message)
            if k % 100 == 0:
                session.tick()
    shown = EventAccumulator(str(board / "members" / "ensemble"))
    shown.Reload()
    assert len(shown.Scalars("1 overview/MAE (m/s)")) >= 8
    assert (board / "identified").is_dir() and (board / "members" / "rnn").is_dir()
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="tensorboard: it is not installed here"):
        Session(Options(tmp_path / "other", start, tensorboard=board), PLAIN)
