"""A node that is killed at any moment leaves sets that can be read, and loses no more than a save period."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.support import ROOT
from tests.support.live import learned_set
from usvlearn.core import checkpoint
from usvlearn.live.node_folder import newest

LOST = 1.0  # s, of learning: the save period, and what a busy disk takes
NODE = """
import itertools, sys, time
from tests.support.live import boat, messages, ready
from pathlib import Path
with ready(Path(sys.argv[1]), Path(sys.argv[2]), save_period=0.2, keep=3) as session:
    print("ready", flush=True)
    shift = 0.0
    for turn in itertools.count():
        for k, (part, stamp, value) in enumerate(messages(boat(0.02))):
            session.push(part, stamp + 80.0 * turn, value)
            if k % 20 == 0:
                session.tick()
                print(time.monotonic(), session._node.steps, flush=True)
                time.sleep(0.001)
"""


def killed(folder, start, after: float) -> list[tuple[float, int]]:
    """Run a node, and kill it so many seconds after it is ready; returns clock and steps, as it said them."""
    process = subprocess.Popen(
        [sys.executable, "-c", NODE, str(folder), str(start)],
        cwd=ROOT,
        env=os.environ,
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        while not checkpoint.checkpoints(folder):
            time.sleep(0.01)
        time.sleep(after)
        process.send_signal(signal.SIGKILL)
        said = [line.split() for line in process.stdout.read().splitlines(True) if line.endswith("\n")]
    return [(float(clock), int(steps)) for clock, steps in said]


@pytest.mark.thorough
def test_checkpoints_survive_kills(tmp_path):
    folder, start = tmp_path / "node", learned_set(tmp_path)
    rng, before = np.random.default_rng(0), 0
    for _ in range(2):
        said = killed(folder, start, float(rng.uniform(0.8, 2.0)))
        _, facts, path, damaged = newest(folder)
        assert path == checkpoint.checkpoints(folder)[-1] and damaged == []
        number = int(path.stem.removeprefix("live_"))
        long_ago = [steps for clock, steps in said if clock < said[-1][0] - LOST]
        assert (facts["step"] if number > before else 0) >= max(long_ago, default=0)
        assert number >= before
        before = number
        assert len(checkpoint.checkpoints(folder)) <= 4
