"""Grids, gradients and cross-validation keep to the device of the estimator; `meta` stands for an accelerator.

Values that are read there are 1, so that each method runs to its end (`tests/support/placement.py`).
"""

import pytest
import torch

from tests.support import few
from tests.support.configured import request
from tests.support.placement import read_as_ones
from usvlearn import AID
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine import lanes
from usvlearn.evaluation.objective import Measure
from usvlearn.sweeps.tuning.batches import Objective, element_errors
from usvlearn.sweeps.tuning.methods import descend, grid

pytestmark = pytest.mark.thorough


@pytest.fixture
def short(fleet):
    """Two missions of 24 s."""
    cut = [run._replace(time=run.time[:60], samples=tree_map(lambda x: x[:60], run.samples)) for run in fleet.runs[:2]]
    return fleet._replace(runs=tuple(cut))


@pytest.fixture
def meta():
    """The builder of a member, there, and its tuned hyperparameters."""

    def made(member, *overrides):
        asked = request(f"learn={member}", *overrides)
        return (lambda values: asked.build(values).to("meta")), asked.parameters

    return made


@pytest.mark.parametrize(
    "measure", few([Measure(""), Measure("", "forecast", 2.0), Measure("", "free")], [Measure("")])
)
def test_errors_of_elements_are_on_the_device_of_the_estimator(short, measure):
    with read_as_ones():
        errors = element_errors(AID(28.0, gain=[[0.1], [1.0], [10.0]]).to("meta"), short, (3,), measure=measure)
    assert errors.errors.is_meta and errors.errors.shape == errors.steps.shape == (2, 3, 2)
    assert errors.steps.is_meta and errors.mae.is_meta
    assert {leaf.device.type for _, leaf in named_leaves(errors.state)} == {"meta"}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of the simulated GPU, whose numbers are Python's
@pytest.mark.parametrize(
    "measure", few([Measure(""), Measure("", "forecast", 2.0), Measure("", "free")], [Measure("")])
)
def test_errors_on_a_gpu_are_those_of_the_cpu(short, measure, monkeypatch):
    monkeypatch.setattr(lanes, "LAUNCH", (1, 25, 10**6))
    aid = AID(28.0, gain=[[0.1], [1.0], [10.0]])
    found, expected = (element_errors(aid, short, (3,), measure=measure, device=each) for each in ("cuda", "cpu"))
    for x, y in zip(found[:2], expected[:2], strict=True):
        torch.testing.assert_close(x, y, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found.state.theta, expected.state.theta, rtol=1e-12, atol=1e-14)


def test_a_grid_runs_on_the_device_of_its_estimators(short, meta):
    build, parameters = meta("aid")
    with read_as_ones():
        assert [each.mae for each in grid(Objective(build, short), parameters, 3, 1)[0]] == [1.0] * 3


@pytest.mark.slow
def test_the_gradient_runs_on_the_device_of_the_estimator(short, meta):
    build, parameters = meta("aid")
    with read_as_ones():
        assert descend(Objective(build, short), parameters, 10).used >= 5
