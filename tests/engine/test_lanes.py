"""The kernels on a GPU make the steps of those on the CPU. Here numba simulates the GPU, in Python."""

import importlib.util
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.support import FAMILIES, few
from tests.support.lanes import EVERY, compared
from usvlearn import Persistence
from usvlearn.core import on_device
from usvlearn.core.protocol import spec_of
from usvlearn.engine import lanes
from usvlearn.engine.program import program_for
from usvlearn.errors import ConfigError

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers of Python warn where compiled ones do not
SOME = [*FAMILIES, "default", "fitted", "joint_trial", "rnn_box", "robust_rnn_refuses"]
FEW = ("aid_estimate",)


@pytest.mark.parametrize("name", few(SOME, FEW, "thorough"))
def test_lanes_are_elements_on_the_cpu(name):
    error, same = compared(name, torch.float64, 12)
    assert error < 1e-11 and same


@pytest.mark.slow
@pytest.mark.parametrize("name", EVERY)
def test_every_setting(name):
    error, same = compared(name, torch.float64, 30)
    assert error < 1e-9 and same


def test_functions_that_mean_the_same_there():
    pairs = [(1.0, 2.0), (np.nan, 1.0), (1.0, np.nan), (0.0, -0.0)]
    for x, y in pairs:
        values = [on_device.FUNCTIONS[name](x, y) for name in ("min", "max")]
        np.testing.assert_array_equal([*values, on_device.FUNCTIONS["sign"](x)], [min(x, y), max(x, y), np.sign(x)])


def test_without_a_gpu_it_is_said_what_to_do(monkeypatch):
    assert lanes.chosen_device("auto") == "cuda"  # the simulated one
    monkeypatch.setattr(on_device, "SIMULATED", False)
    monkeypatch.setitem(sys.modules, "numba_cuda", None)
    assert lanes.chosen_device("cpu") == "cpu"
    with pytest.raises(ConfigError, match=r'found cuda, but no GPU .*numba_cuda.*pip install "usvlearn\[cuda\]"'):
        lanes.chosen_device("cuda")
    with pytest.warns(UserWarning, match="the CPU is used, because no GPU can be used"):
        assert lanes.chosen_device("auto") == "cpu"
    with pytest.raises(ConfigError, match="found 'gpu', expected one of cpu, cuda, auto"):
        lanes.chosen_device("gpu")


def test_a_launch_has_a_bounded_number_of_steps():
    plan = program_for(spec_of(Persistence()), (2,), np.dtype(float))
    assert lanes.Lanes(plan, np.zeros((2, plan.size))).steps == 20_000 < 10**6 // (plan.size + plan.work)


def test_a_track_stays_on_the_cpu():
    with pytest.raises(ConfigError, match="use the CPU"):
        lanes.Lanes(SimpleNamespace(head=[0, 0, 0, 0]), np.zeros((1, 1)))
    assert lanes.most_lanes(spec_of(Persistence())) == lanes.MOST_LANES


@pytest.mark.thorough
@pytest.mark.skipif(importlib.util.find_spec("numba_cuda") is None, reason="needs the extra cuda")
def test_it_compiles_for_a_gpu_that_is_not_there():
    command = [sys.executable, "-m", "tests.support.lanes", "ptx", "aid", "sift"]
    done = subprocess.run(command, env={**os.environ, "NUMBA_ENABLE_CUDASIM": "0"}, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.count("bytes of PTX") == 2, done.stderr
