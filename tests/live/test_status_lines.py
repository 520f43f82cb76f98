"""What `usvlearn live status` says of a folder: every fact of its status, and nothing malformed."""

import json
import time

import pytest

from usvlearn.live.status import status_lines

STATUS = {
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
    (tmp_path / "status.json").write_text(json.dumps(STATUS | {"written": time.time() - 120}))
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


@pytest.mark.parametrize("key", [key for key in STATUS if key != "state"])
def test_a_fact_that_is_missing_or_something_else_is_left_out(tmp_path, key):
    (tmp_path / "status.json").write_text(json.dumps(STATUS))
    whole = status_lines(tmp_path)
    for status in ({k: x for k, x in STATUS.items() if k != key}, STATUS | {key: 7}):
        (tmp_path / "status.json").write_text(json.dumps(status))
        lines = status_lines(tmp_path)
        assert set(lines) <= set(whole) and (len(lines) < len(whole)) == (STATUS[key] != "")
