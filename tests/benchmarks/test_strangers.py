"""The benchmark of boats with other equations: its own boat, least squares, and its page."""

import math

import numpy as np
import other_boat
import pytest
import strangers


def test_without_other_boats_there_is_one_whose_log_has_its_truth(monkeypatch, tmp_path):
    monkeypatch.setenv("USVLEARN_STRANGERS", str(tmp_path / "none.py"))
    boats, boat = strangers.strangers(), other_boat.BOATS["without_gyro"]
    assert boats is other_boat
    rows = np.array(boats.mission(boat, 60.0, np.random.default_rng(0)))
    boats.write(tmp_path / "a.csv", boat, rows)
    head, *lines = (tmp_path / "a.csv").read_text().splitlines()
    assert "yaw rate" not in head and len(lines) == len(rows) == 300 and len(lines[0].split(",")) == 8
    truth = boats.truth(boat)
    assert truth["steady_speed_quarter"] < truth["steady_speed_half"] < truth["steady_speed_full"]
    u = truth["steady_speed_full"]
    assert 2 * other_boat.thrust(boat, 1.0, u) == pytest.approx(other_boat.drag(u), rel=1e-3)


def test_the_page_counts_what_is_told_and_what_holds():
    rows = [
        strangers.Row(missions, "gyro", name, method, 0.02, half, holds)
        for missions in strangers.KINDS
        for name in ("time_constant", "dead_zone")
        for method, half, holds in (("fit", 0.1, True), ("fit", 0.2, False), ("fit", math.nan, False))
    ]
    text = "\n".join(strangers.page(rows, {"a": {"ours, online": [0.5] * 4, "jax-sysid": []}}, ["said"], "command"))
    assert "| time_constant | 2 of 3 | 50% | 2.0% | 15.0% | – | – | – | – |" in text
    assert "| all | surge | 2 of 3, 50% | 2 of 3, 50% | 15.0% | 15.0% |" in text
    assert "| jax-sysid | not installed |" in text and text.endswith("- said")
