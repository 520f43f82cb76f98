"""Where numbers are: what an estimator makes is on the device to which it was moved.

The device `meta` stands for an accelerator. It has shapes and no values: an operation there that mixes devices fails,
and so does one that reads a value. Whether an accelerator computes the right numbers, these tests cannot tell.
"""

import numpy as np
import pytest
import torch
from torch.utils._pytree import tree_leaves

from tests.support import ESTIMATORS, at, few, layers, over, random_samples, unaided
from tests.support.kernel_cases import VARIANTS
from tests.support.placement import on_device, read_as_ones
from usvlearn import AID, BOA, RNN, Ensemble, Inputs, Online, Persistence, Sample, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.errors import ShapeError
from usvlearn.estimators.least_squares.sift import sift_step

STEPS = 2


CASES = {name: lambda make=make: unaided(make()) for name, make in layers(ESTIMATORS).items()}
KINDS = ("sift", "aid", "rnn_replay", "weighted", "rnn", "persistence")
some_cases = pytest.mark.parametrize(  # one by default, the rest of KINDS thorough, all others slow
    "name", [*few(KINDS, KINDS[:1], "thorough"), *few([name for name in CASES if name not in KINDS], ())]
)
CALLS = {  # of an estimator with its state and a run
    "learn": lambda estimator, state, run: estimator.learn(state, at(run, 0).inputs, run.surge[0]),
    "predict": lambda estimator, state, run: estimator.predict(state, at(run, 0).inputs),
    # Values are unknown on `meta`, so that each step of a rollout there calls `start`, `predict` and `update`.
    "rollout": lambda estimator, state, run: rollout(estimator, state, run, lambda state: state, "torch"),
}


def away(tree):
    return tree_map(lambda x: x.to("meta"), tree)


def described(tree) -> list[tuple]:
    return [(x.shape, x.dtype) for x in tree_leaves(tree) if isinstance(x, torch.Tensor)]


def assert_away(found, expected) -> None:
    """Everything is on `meta`, and of the shapes and dtypes that it has on the CPU."""
    assert {x.device.type for x in tree_leaves(found) if isinstance(x, torch.Tensor)} <= {"meta"}
    assert described(found) == described(expected)


@some_cases
def test_every_step_stays_on_the_device_of_the_state(name):
    batch = (2, 3)
    here, there, run = CASES[name](), CASES[name]().to("meta"), random_samples(STEPS, *batch)
    state = here.init(batch)
    with on_device():
        state_there = there.init(batch)
    assert_away(state_there, state)
    for call in CALLS.values():
        expected = call(here, state, run)
        with on_device():
            result = call(there, state_there, away(run))
        assert_away(result, expected)


@some_cases
def test_diagnostics_are_on_the_device_of_the_state(name):
    here, there = CASES[name](), CASES[name]().to("meta")
    with read_as_ones():
        assert_away(there.monitor(there.init((2,))), here.monitor(here.init((2,))))


@over("make", {**CASES, **VARIANTS}.values())
def test_every_number_of_an_estimator_moves_with_it(make):
    """A tensor that is neither a parameter nor a buffer would stay behind."""
    for path, part in make().named_modules():
        assert not [key for key, x in vars(part).items() if isinstance(x, torch.Tensor)], path


@some_cases
@torch.enable_grad()
def test_gradients_are_on_the_device_of_the_hyperparameters(name):
    estimator, run = CASES[name]().to("meta"), away(random_samples(STEPS, 2))
    parameters = [x for x in estimator.parameters() if x.requires_grad]
    if not parameters:
        return
    with on_device():
        loss = rollout(estimator, estimator.init((2,)), run)[1].square().mean()
        gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    assert any(x is not None for x in gradients)
    assert all(x is None or (x.is_meta and x.shape == p.shape) for x, p in zip(gradients, parameters, strict=True))


def test_samples_on_another_device_than_the_state_are_refused():
    aid, run = AID(28.0), random_samples(STEPS, 2)
    with pytest.raises(
        ShapeError, match=r"samples are on meta, the state's theta is on cpu: move the estimator with \.to"
    ):
        rollout(aid, aid.init((2,)), away(run))
    with pytest.raises(
        ShapeError, match=r"samples: inputs.heading is on meta, surge on cpu: move all with \.to\(cpu\)"
    ):
        rollout(aid, aid.init((2,)), run._replace(inputs=run.inputs._replace(heading=run.inputs.heading.to("meta"))))


@pytest.mark.thorough
def test_a_boat_learns_on_the_device_of_its_estimator(tmp_path):
    ensemble = Ensemble({"aid": AID(28.0), "rnn": RNN(6)}, {"boa": BOA()}, watched=False, conditional=False)
    with read_as_ones():
        boat = Online(ensemble.to("meta"), (2,))
        assert boat.step(Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 1.0, True, True)).tolist() == [1.0, 1.0]
        assert boat.predict_members(Inputs(0.5, 0.5, 0.0, 0.0, 0.4))["aid"][0].tolist() == [1.0, 1.0]
        boat.restore(boat.save(tmp_path / "boat.safetensors"))
        assert {leaf.device.type for _, leaf in named_leaves(boat.state)} == {"meta"}


@pytest.mark.thorough
def test_stretches_of_arrays_are_sent_to_the_device_of_the_state():
    ensemble = Ensemble({"aid": AID(28.0)}, watched=False, conditional=False).to("meta")
    parts = [tree_map(lambda x: x.numpy(), random_samples(STEPS, 2))] * 2
    with read_as_ones():
        for state, arrays in chunked_rollout(ensemble, ensemble.init((2,)), parts, ["predictions"]):
            assert state.predictions.is_meta and isinstance(arrays["predictions"], np.ndarray)


def test_a_step_of_sift_alone_takes_every_sample_as_informative():
    given = torch.zeros(2), torch.eye(2), torch.ones(2), torch.tensor(1.0), torch.tensor(0.5)
    expected, there = sift_step(*given, torch.tensor(True)), [x.to("meta") for x in given]
    torch.testing.assert_close(sift_step(*given), expected, rtol=0, atol=0)
    with on_device():
        assert_away(sift_step(*there), expected)


class Faulty(Persistence):
    """Predicts what a function makes of the speed."""

    def __init__(self, wrong):
        super().__init__()
        self.wrong, self.shift = wrong, torch.zeros(2)  # a number that does not move with it

    def predict(self, state, inputs):
        return state, self.wrong(self, state.surge, inputs)


FAULTS = {
    "expected device meta": lambda own, surge, inputs: surge + own.shift,
    "the index": lambda own, surge, inputs: surge[..., [1, 0]],
    "on the CPU": lambda own, surge, inputs: surge * float(torch.zeros(2).sum()),
    "copied": lambda own, surge, inputs: surge + surge.new_tensor(1.0),
    "item": lambda own, surge, inputs: surge * float(inputs.dt.max()),
}


@pytest.mark.parametrize("said", FAULTS)
def test_each_fault_of_placement_is_found(said):
    estimator, run = Faulty(FAULTS[said]).to("meta"), away(random_samples(STEPS, 2))
    with pytest.raises((AssertionError, RuntimeError), match=said), on_device():
        rollout(estimator, estimator.init((2,)), run)
