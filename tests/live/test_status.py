"""The status of a node: what it tells, files of others in its place, and that nothing malformed is told."""

import json
import os
import time

import pytest

from tests.support.live import boat, messages, ready, sail
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.live.node_folder import STATUS, NodeFolder
from usvlearn.live.status import status_lines

MINUTE = list(messages(boat(0.02)))


@pytest.mark.parametrize(
    "status",
    ['{"warnings": 5}', '{"written": 1%s}' % ("0" * 400), '{"written": -1e300, "last": {"speed": 1%s}}' % ("0" * 400),
     '{"identified": {"a": [1e999, 1, 2, "m"]}, "contraction": {"rnn": {"equilibrium": 1%s}}}' % ("0" * 400),
     '{"last": {"speed": NaN}, "warnings": ["\\u001b[2J"]}'],
)  # fmt: skip
def test_a_status_from_others_is_shown_without_harm(tmp_path, status):
    (tmp_path / "status.json").write_text(status)
    assert all(len(line) < 400 and line.isprintable() for line in status_lines(tmp_path))


def test_a_pipe_is_no_status(tmp_path):
    os.mkfifo(tmp_path / "status.json")
    with pytest.raises(CheckpointError, match="it is no regular file"):
        status_lines(tmp_path)


def test_the_status_of_another_program_is_not_replaced(tmp_path):
    (tmp_path / STATUS).write_text('{"orders": 3}')
    with pytest.raises(ConfigError, match="is not the status of a node: choose another folder"):
        NodeFolder(tmp_path)
    assert (tmp_path / STATUS).read_text() == '{"orders": 3}'
    (tmp_path / STATUS).write_text('{"orders":')  # cut short by a disk: a node starts
    NodeFolder(tmp_path)


def test_the_status_is_json(tmp_path, start):
    with ready(tmp_path, start) as session:
        session.push(*MINUTE[0])
        session.tick()
    assert "NaN" not in (tmp_path / "status.json").read_text()


def test_the_status_of_a_folder_is_told(tmp_path, start):
    folder = tmp_path / "node"
    with pytest.raises(ConfigError, match="found no folder"):
        status_lines(folder)
    folder.mkdir()
    assert status_lines(folder) == [f"{folder}: no node has written here"]
    with ready(folder, start) as session:
        sail(session, MINUTE)
        session.tick()
        session._background.wait()
        lines = "\n".join(status_lines(folder))
        assert "Node        running" in lines and "Network     rnn: contracting by" in lines
    lines = "\n".join(status_lines(folder))
    assert "Node        ended" in lines and "Identified  steady_speed_full" in lines and "Checkpoints 1," in lines
    (sets,) = checkpoint.checkpoints(folder)
    newer = sets.with_name("live_00000002.safetensors")
    newer.write_bytes(sets.read_bytes())
    assert f"Checkpoints 2, the newest readable is {newer.name}" in "\n".join(status_lines(folder))
    assert "cannot be read" not in "\n".join(status_lines(folder))
    newer.write_bytes(sets.read_bytes()[:-7])
    assert f"Checkpoints 2, the newest readable is {sets.name}" in "\n".join(status_lines(folder))
    assert "; 1 newer cannot be read" in "\n".join(status_lines(folder))
    (folder / "status.json").write_text("[1]")
    with pytest.raises(CheckpointError, match="is not the status of a node"):
        status_lines(folder)


TOLD = {
    "boat": "heron", "middleware": "moos", "sentence": "It learns.", "loss": "", "state": "ended",
    "last": {"speed": 1.234},
    "contraction": {
        "rnn": {"contracting": True, "condition": "simple", "equilibrium": 0.5}, "other": {"contracting": False},
        "bad": 3,
    },
    "identified": {
        "drag_linear": [1.5, 1.25, 1.75, "kg/s"], "mass": [None, None, None, "kg"], "short": [1.0, 2.0], "text": "1.5",
    },
    "notes": ["One.", 2], "warnings": ["Two."],
}  # fmt: skip


def test_every_fact_is_told_and_what_is_malformed_is_not(tmp_path):
    (tmp_path / "status.json").write_text(json.dumps(TOLD | {"written": time.time() - 120}))
    node, *lines = status_lines(tmp_path)
    assert node.startswith("Node        ended; its status is 2 min")
    assert lines == [
        "Boat        heron",
        "Middleware  moos",
        "State       It learns.",
        "Predicted   1.23 m/s at its last step",
        "Network     rnn: contracting by simple, at rest 0.50 m/s",
        "Network     other: not certified",
        "Identified  drag_linear 1.5 (1.25 ... 1.75) kg/s",
        "Identified  mass not known yet",
        "Note        One.",
        "Warning     Two.",
        "Checkpoints none",
    ]


@pytest.mark.parametrize("key", [key for key in TOLD if key != "state"])
def test_a_fact_that_is_missing_or_something_else_is_left_out(tmp_path, key):
    (tmp_path / "status.json").write_text(json.dumps(TOLD))
    whole = status_lines(tmp_path)
    for status in ({k: x for k, x in TOLD.items() if k != key}, TOLD | {key: 7}):
        (tmp_path / "status.json").write_text(json.dumps(status))
        lines = status_lines(tmp_path)
        assert set(lines) <= set(whole) and (len(lines) < len(whole)) == (TOLD[key] != "")
