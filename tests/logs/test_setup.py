"""The setup in a checkpoint: how the messages of its boat become samples."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import usvlearn
from usvlearn.core import checkpoint
from usvlearn.engine.online import Online
from usvlearn.errors import ConfigError
from usvlearn.logs.alignment.mixing import LiveMix, Mix, mix
from usvlearn.logs.channels.channel import Channel
from usvlearn.logs.setup import Setup

NAMES = {"command_left": "l", "command_right": "r", "heading": "psi", "surge": "v"}


def log(folder: Path, copies: int = 1) -> Path:
    rng, path = np.random.default_rng(0), folder / "heron.csv"
    speed = np.repeat(rng.normal(1.0, 0.1, 400), copies)
    rows = [f"{k / 10:.1f},1600,{1600 + k % 7},{k % 360},{v:.6f}" for k, v in enumerate(speed)]
    path.write_text("time,l,r,psi,v\n" + "\n".join(rows))
    return path


def read(folder: Path, copies: int = 1):
    channels = {name: {"name": each} for name, each in NAMES.items()}
    for side in ("command_left", "command_right"):
        channels[side] |= {"zero": 1500, "span": 400, "delay": 0.2}
    return usvlearn.read(log(folder, copies), channels=channels, mass=28.0, surge_max=3.0, align={"dt": 0.2})


def test_what_was_learned_from_a_log_knows_its_channels(tmp_path):
    saved = usvlearn.learn(read(tmp_path), usvlearn.AID(mass=28.0)).save(tmp_path / "a.safetensors")
    setup = Setup.of(checkpoint.load(saved)[1]["setup"])
    left = setup.channels["command_left"]
    assert (left.name, left.zero, left.span, left.delay) == ("l", 1500, 400, 0.2)
    assert setup.align["dt"] == 0.2 and (setup.mass, setup.surge_max) == (28.0, 3.0)
    assert setup.reader == "usvlearn.logs.formats.csv.table.Table"
    again = Online.open(saved)
    assert checkpoint.load(again.save(tmp_path / "b.safetensors"))[1]["setup"] == setup.json()


@pytest.mark.filterwarnings("ignore:heron")
def test_a_period_that_was_found_is_in_the_set(tmp_path):
    setup = read(tmp_path, copies=2).setups["heron"]
    assert setup.channels["surge"].period == 0.2 and setup.aligner() is not None


def test_a_setup_that_is_damaged_is_refused():
    good = Setup.of({"channels": {name: {"name": each} for name, each in NAMES.items()}}).json()
    for damage, message in (
        (None, "setup: found NoneType"), ({"channels": {}}, "found no command_left"),
        (good | {"align": {"dtt": 1}}, "align.dtt: found no such option"),
        (good | {"align": {"dt": -1.0}}, "align.dt: found -1.0"),
        (good | {"vehicle": {"mass": "heavy"}}, "vehicle.mass: found 'heavy'"),
        (good | {"channels": good["channels"] | {"surge": 3}}, "data.channels.surge: found 3"),
        (good | {"channels": good["channels"] | {"surge": {"name": "v", "period": "auto"}}}, "period: found auto"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            Setup.of(damage).aligner()


@given(
    held=st.booleans(), weights=st.sampled_from([None, [1.0, 1.0], [1.0, -1.0], [0.2, 0.8]]),
    posts=st.lists(st.tuples(st.integers(0, 1), st.floats(0, 0.4), st.floats(-1.5, 1.5)), max_size=30),
)  # fmt: skip
def test_a_mix_of_live_messages_is_that_of_the_log(held, weights, posts):
    given_ = Mix.of({"name": ["a", "b"], "held": held, "window": 0.3, "weight": weights})
    time, rows = 0.0, []
    for part, gap, value in posts:
        rows.append((part, time := time + gap, value))
    live = LiveMix(given_)
    sums = [(t, total) for part, t, value in rows if (total := live.push(part, t, value)) is not None]
    order = np.arange(len(rows))
    if len(Counter(part for part, _, _ in rows)) < 2:
        assert not sums
        return
    parts = [
        Channel(
            np.array([t for p, t, _ in rows if p == part]),
            np.array([v for p, _, v in rows if p == part]),
            order[[p == part for p, _, _ in rows]],
            held,
            0.3,
        )
        for part in (0, 1)
    ]
    whole, _ = mix(parts, given_.weights)
    assert sums == list(zip(whole.time.tolist(), whole.value.tolist(), strict=True))
