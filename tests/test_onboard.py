"""Aboard: what a boat's computer does, in an environment with numpy, numba and safetensors alone.

Where `USVLEARN_RUN` names the folder of a run, its checkpoints are taken, and torch must not be there; else one is made
here.
"""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from usvlearn import Aligner, Inputs, Online, Sample
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError
from usvlearn.live.diagnostics import networks
from usvlearn.live.prior import prior
from usvlearn.logs.channels.channel import Source

RUN = os.environ.get("USVLEARN_RUN")
REQUIRED = ("surge", "heading", "command_left", "command_right")


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> Path:
    """A folder of checkpoints."""
    if RUN:
        return next((Path(RUN) / "checkpoints").iterdir())
    from usvlearn import AID, BOA, RNN, Ensemble, Robust, SIFtRLS, SurgeDynamics

    members = {"aid": AID(28.0), "rnn": RNN(), "sift": Robust(SIFtRLS(SurgeDynamics(28.0)))}
    folder = tmp_path_factory.mktemp("sets")
    Online(Ensemble(members, {"ensemble": BOA()})).save(folder / "00000_0000000.safetensors", boat="heron")
    return folder


def voyage(steps: int = 600) -> list[Sample]:
    """Samples of a boat that follows its commands, aligned from messages."""
    aligner = Aligner({name: Source(name) for name in REQUIRED}, dt=0.4)
    rng, speed, samples = np.random.default_rng(0), 0.0, []
    for k in range(4 * steps):
        time, left, right = 0.1 * k, 0.5 + 0.4 * np.sin(0.01 * k), 0.5 + 0.4 * np.cos(0.013 * k)
        speed += 0.1 * (0.7 * (left + right) - 0.5 * speed * abs(speed))
        for name, value in zip(REQUIRED, (speed + 0.02 * rng.standard_normal(), 1.0, left, right), strict=True):
            samples += aligner.push(name, time, value)
    return [sample for _, sample in samples]


@pytest.mark.thorough
def test_nothing_here_imports_torch():
    code = (
        "import sys; sys.modules.update(torch=None, scipy=None, hydra=None, rich=None)\n"
        "import usvlearn.live.session, usvlearn.live.prior, usvlearn.cli.warm\n"
        "import usvlearn.logs.read, usvlearn.logs.formats.moos.alog, certify.analysis.assess\n"
        "import usvlearn.engine.single_steps, usvlearn.engine.run\n"
        "from usvlearn import Aligner, Inputs, Online, Sample"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not RUN or importlib.util.find_spec("torch") is None


def test_a_set_is_opened_predicts_learns_and_is_saved(sets, tmp_path):
    boat = Online.open(sets)
    samples = voyage()
    assert boat.names[-1] == "ensemble"
    errors = []
    for k, sample in enumerate(samples):
        if sample.fresh:
            foreseen = boat.predict(sample.inputs)
        predicted = boat.step(sample)
        assert isinstance(predicted, float)
        assert np.isnan(predicted) if not sample.fresh else predicted == foreseen, k
        if sample.measured:
            errors.append(abs(predicted - sample.surge))
    assert len(errors) > 500 and np.mean(errors[-100:]) < 0.04  # noise of 0.02 m/s on both speeds
    path = boat.save(tmp_path / "next.safetensors", boat="heron")
    again, rest = Online.open(path), samples[-1]
    assert again.predict(rest.inputs) == boat.predict(rest.inputs) == again.step(rest)
    assert checkpoint.load(path)[1]["boat"] == "heron"
    # NaN where none is due, infinite if unknown
    due = [f"forecasts.{name}" for name in ("predictions", "halfwidths", "widths", "conditional.due")]
    assert all(np.isfinite(leaf).all() for name, leaf in boat.state.items() if name not in due)
    if any(name in boat.state for name in due):  # after ten minutes, 30 s ahead
        ahead = boat.forecast([[0.5, 0.5]] * 75, 1.0)
        assert np.isfinite(ahead.low).all() and (ahead.high - ahead.low).max() < 1.0


def test_a_boat_without_a_set_starts_from_a_prior_whose_network_is_certified():
    boat = Online.of(*prior(mass=28.0, surge_max=2.7))
    errors = [abs(boat.step(sample) - sample.surge) for sample in voyage(300)]
    assert np.nanmean(errors[-100:]) < 0.1
    (network,) = networks(boat).values()
    assert network["contracting"] and 0 < network["rate"] < 1 and np.isfinite(network["equilibrium"])


def test_bad_samples_are_data(sets):
    boat = Online.open(sets)
    good = Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 1.0, True, True)
    boat.step(good)
    before = boat.state
    for inputs, surge in (
        ((np.nan, 0.5, 0.0, 0.0, 0.4), 1.0), ((0.5, np.inf, 0.0, 0.0, 0.4), 1.0), ((0.5, 0.5, 0.0, 0.0, -1.0), 1.0),
        ((0.5, 0.5, 0.0, 0.0, 0.0), np.nan),
    ):  # fmt: skip
        assert np.isnan(boat.step(Sample(Inputs(*inputs), surge, True, True)))
        assert all(np.array_equal(leaf, before[name], equal_nan=True) for name, leaf in boat.state.items())
    assert np.isfinite(boat.step(Sample(Inputs(1, 0, 0, 0, 1), 1, 1, 1)))  # whole numbers are numbers
    assert np.isfinite(boat.step(Sample(Inputs(*np.full(5, 0.4)), np.float32(1.0), np.True_, np.array(True))))


def test_what_is_no_set_or_does_not_say_how_it_is_built_is_refused(sets, tmp_path):
    with pytest.raises(CheckpointError, match="cannot be read"):
        Online.open(tmp_path / "none.safetensors")
    leaves, facts = checkpoint.load(sorted(sets.glob("*.safetensors"))[-1])
    del facts["kernel"]
    unsaid = checkpoint.save(tmp_path / "unsaid.safetensors", leaves, **facts)
    with pytest.raises(CheckpointError, match=r"does not say how .*: use Online\(ESTIMATOR\).restore"):
        Online.open(unsaid)
    facts["kernel"] = json.loads(json.dumps({"kind": "persistence", "size": 0, "numbers": {}}))
    other = checkpoint.save(tmp_path / "other.safetensors", leaves, **facts)
    with pytest.raises(CheckpointError, match="found a leaf that the estimator does not have"):
        Online.open(other)


@pytest.mark.thorough
def test_a_state_read_while_another_thread_steps_is_one_between_two_steps(sets):
    samples, done = voyage(3000), threading.Event()

    def sum_of(state: dict[str, np.ndarray]) -> str:
        return hashlib.sha256(b"".join(leaf.tobytes() for leaf in state.values())).hexdigest()

    alone, online = Online.open(sets), Online.open(sets)
    legal = {sum_of(alone.state)}
    for sample in samples:
        alone.step(sample)
        legal.add(sum_of(alone.state))

    def sail() -> None:
        for sample in samples:
            online.step(sample)
        done.set()

    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        thread = threading.Thread(target=sail)
        thread.start()
        states = []
        while not done.is_set():
            states.append(online.state)
        thread.join()
    finally:
        sys.setswitchinterval(before)
    assert set(map(sum_of, states)) <= legal
