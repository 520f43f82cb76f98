"""What a node finds wrong: steps that are lost because of a channel, and what the data check of a replay would say."""

import math
import re
import time

import numpy as np
import pytest

from tests.support.live import boat, messages, ready
from usvlearn.live.session import Session
from usvlearn.live.start import channel_options
from usvlearn.logs.channels.channel import REQUIRED


def slowed(part: str, every: float, begin: float = 0.0, end: float = math.inf):
    """The messages of a boat, of which one part comes seldom between two times, s."""
    last = -math.inf
    for name, stamp, value in messages(boat(0.05), 0.0):
        if name == part and begin <= stamp < end:
            if stamp - last < every:
                continue
            last = stamp
        yield name, 1.7e9 + stamp, value


def told(session: Session, posts, ages: bool = False) -> list[tuple[float, str, str, tuple[str, ...]]]:
    """Time, state, sentence and warnings, once a second of the stamps; with ages, by which channels are silent, too."""
    rows, heard, begin = [], {}, time.monotonic()
    for name, stamp, value in posts:
        session.push(name, stamp, value)
        heard[name] = begin + stamp - 1.7e9
        if stamp - 1.7e9 >= len(rows) + 1:
            clock = begin + len(rows) + ages
            session._listening.heard = dict(heard) if ages else dict.fromkeys(session._listening.heard, clock)
            health = session.tick(clock=clock)
            rows.append((stamp - 1.7e9, health.state, health.sentence, health.warnings))
    return rows


@pytest.mark.thorough
@pytest.mark.parametrize("part, every", [("heading", 0.25), ("heading", 1.0), ("command_left", 0.9), ("surge", 0.9)])
def test_a_node_that_loses_many_steps_says_so_within_a_minute(tmp_path, start, part, every):
    """A fixed window of 0.01 s; the automatic one learns from the same messages."""
    changes = channel_options({f"{part}.window": "0.01"})
    with ready(tmp_path / "fixed", start, channels=changes) as session:
        rows = told(session, slowed(part, every))
        learned = session._node.learned
        session._background.wait()
    late, _, sentence, warnings = next(row for row in rows if row[1] == "sparse")
    assert late < 60 and sentence.startswith(f"many steps are lost, because of {part} ({part.upper()})")
    (warning,) = warnings
    assert "of the last 75 steps had" in warning and warning.endswith(f"its window is 0.01 s: set {part}.window=auto")
    assert every <= float(re.search(r"comes every ([\d.]+) s", warning)[1]) < every + 0.3
    assert {row[2].partition(";")[0] for row in rows if row[0] > late} == {sentence.partition(";")[0]}, "said once"
    with ready(tmp_path / "auto", start) as session:
        rows = told(session, slowed(part, every))
        assert session._node.learned > (3 if part != "surge" else 1.5) * learned
    assert {row[1] for row in rows} <= {"waiting", "ok"}


@pytest.mark.thorough
def test_a_channel_that_comes_too_seldom_is_never_ok(tmp_path, start):
    """It was ok after each heading, and stale before the next one."""
    with ready(tmp_path, start) as session:
        rows = told(session, slowed("heading", 6.7))
        assert session._node.learned == 0 and session.warnings == ()
    wanted = "waiting for a second message within 5 s of heading (HEADING)"
    assert {(state, sentence.partition(";")[0]) for at, state, sentence, _ in rows if at > 2} == {("waiting", wanted)}


def test_a_channel_that_becomes_too_seldom_stays_so_between_its_messages(tmp_path, start):
    """It was ok after each heading, and stale before the next one, because two of them had once come quickly."""
    with ready(tmp_path, start) as session:
        rows = told(session, slowed("heading", 6.7, begin=40.0), ages=True)
    assert {state for at, state, *_ in rows if 5 < at < 40} == {"ok"}
    late = [row for row in rows if row[0] > 80]
    assert {row[1] for row in late} == {"stale", "sparse"}
    assert all("heading (HEADING) fell silent 3 times within a minute" in str(row[3]) for row in late)
    assert {s.partition(";")[0] for _, state, s, _ in late if state == "sparse"} == {
        "many steps are lost, because of heading (HEADING)"
    }


@pytest.mark.thorough
def test_a_rate_that_changes_again_and_again_is_told_with_a_window_that_spans_its_silences(tmp_path, start):
    """The advice was twice the window of the fast times, 0.4 s, which the slow ones exceed as before."""

    def posts():
        last = -math.inf
        for name, stamp, value in messages(boat(0.05), 0.0):
            if name == "heading" and stamp % 10 >= 5 and stamp - last < 2.0:
                continue
            last = stamp if name == "heading" else last
            yield name, 1.7e9 + stamp, value

    with ready(tmp_path / "auto", start) as session:
        (warning,) = told(session, posts(), ages=True)[-1][3]
        learned = session._node.learned
        session._background.wait()
    window = re.search(r"rate changes again and again: set heading\.window=([\d.]+)$", warning)[1]
    assert 2.0 <= float(window) <= 5.0
    changes = channel_options({"heading.window": window})
    with ready(tmp_path / "wide", start, channels=changes) as session:
        assert told(session, posts(), ages=True)[-1][1] == "ok"
        assert session._node.learned > 1.4 * learned


@pytest.mark.thorough
def test_a_channel_that_slows_down_and_recovers_is_told_and_forgotten(tmp_path, start):
    changes = channel_options({"heading.window": "0.25"})
    with ready(tmp_path, start, channels=changes) as session:
        states = [(at, state) for at, state, *_ in told(session, slowed("heading", 0.9, 40.0, 100.0))]
    assert {state for at, state in states if 5 < at < 50} == {"ok"}
    assert {state for at, state in states if 70 < at < 100} == {"sparse"}
    assert {state for at, state in states if at > 130} == {"ok"}


def test_a_paused_channel_is_stale_and_not_sparse_when_it_is_back(tmp_path, start):
    with ready(tmp_path, start) as session:
        begin = time.monotonic()
        for name, stamp, value in messages(boat(0.05), 0.0):
            if name.startswith("command") and 40 < stamp < 100:
                continue
            session.push(name, 1.7e9 + stamp, value)
        clock = begin
        session._listening.heard = dict.fromkeys(session._listening.heard, clock)
        session.tick(clock=clock)
        assert "stale" == session.tick(clock=clock + 30).state and session.warnings == ()


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
