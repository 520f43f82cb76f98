"""Models of other libraries, modules of torch and numba functions as members: those of the documentation."""

import copy
import importlib.util
import math
import re
import shutil

import numpy as np
import pytest
import torch
from torch import nn

import certify
from tests.support import ROOT
from tests.support.commands import QUICK, assert_equal_runs, run
from usvlearn import BOA, Ensemble, Online, OnlineModule, Persistence, external, rollout
from usvlearn.errors import CheckpointError, ConfigError, ShapeError
from usvlearn.estimators.external.plain_state import packed, unpacked
from usvlearn.testing import CONTRACTS, at, check_estimator, random_samples

PAGE = (ROOT / "docs/estimators.md").read_text().partition("{#own}")[2].partition("\n## ")[0]
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.S)
SWEEPS = re.findall(r"^usvlearn train -m my_boat.yaml ((?:.*\\\n)*.*)", PAGE.replace("$MINE", "+estimators.mine"), re.M)
LIBRARIES = all(map(importlib.util.find_spec, ("river", "sklearn")))
needs_libraries = pytest.mark.skipif(not LIBRARIES, reason="river and scikit-learn are not installed")


@pytest.fixture(scope="module")
def own():
    """The names of the documentation's code."""
    names = {"__name__": "own"}
    for block in BLOCKS:
        if "certify" not in block and (LIBRARIES or "river" not in block):
            exec(compile(block, "docs/estimators.md", "exec"), names)
    return names


class Plain:
    """A model of no library: recursive mean and slope, with nested plain attributes."""

    def __init__(self):
        self.held = {("a", 1): [0.0, np.zeros(2)], "rule": math.sqrt}
        self.rate = 0.1

    def predict(self, x):
        return x.speed + self.held["a", 1][0] + self.held["a", 1][1] @ [x.mean, x.speed]

    def learn(self, x, y):
        error = y - self.predict(x)
        self.held["a", 1][0] += self.rate * error
        self.held["a", 1][1] += self.rate * error * np.array([x.mean, x.speed])


def test_an_object_keeps_the_contracts():
    check_estimator(lambda: external(Plain()))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["NLMS", "gru", "contracting", "echo"])
def test_kernels_and_modules_keep_the_contracts(own, name):
    check_estimator(own[name] if name == "NLMS" else lambda: copy.deepcopy(own[name]))


@needs_libraries
@pytest.mark.parametrize("name", ["bayes", "sgd"])
def test_models_of_libraries_keep_the_contracts(own, name):
    check_estimator(lambda: copy.deepcopy(own[name]))


def test_a_module_learns_as_torch_does_and_contracts():
    """One step of SGD on a linear module is the textbook's; the projection holds, and is proved."""
    linear = nn.Linear(9, 1).double()
    net = type("Net", (nn.Module,), {"forward": lambda self, x, u: self.layer(torch.cat([x, u], -1))})()
    net.layer = linear
    module, samples = OnlineModule(net, optimizer="sgd", lr=0.1, window=1), random_samples(1)
    state, one = module.start(module.init(), torch.tensor(0.4).double()), at(samples, 0)
    after, predicted = module.learn(state, one.inputs, one.surge)
    u = torch.cat([torch.tensor([0.4]).double(), after.inputs[0]])
    with torch.enable_grad():
        (linear(u)[0] - one.surge).square().backward()
    expected = torch.cat([p.detach().reshape(-1) - 0.1 * p.grad.reshape(-1) for p in linear.parameters()])
    torch.testing.assert_close(after.weights, expected)
    assert predicted == linear(u)[0]


def test_a_contracting_network_is_proved_to_contract(own):
    module, samples = own["contracting"], random_samples(20)
    with torch.no_grad():
        state, _, _ = rollout(module, module.init(), samples)
    assert not torch.equal(state.weights, module.init().weights)
    assert certify.certify(module.trained(state)).contracting


class Closed(Plain):
    """Holds what is not plain."""

    def __init__(self):
        super().__init__()
        self.held["file"] = memoryview(b"")

    def __deepcopy__(self, memo):
        return type(self)()


class Told(Closed):
    """The same, with the documented pair."""

    def get_state(self):
        return {"a": self.held["a", 1]}

    def set_state(self, state):
        self.held["a", 1] = state["a"]


def test_an_object_that_cannot_be_saved_is_said_to_be_one_and_runs_on(tmp_path):
    with pytest.warns(
        UserWarning, match=r"Closed cannot be resumed \(builtins.memoryview is not plain\): give it get_state"
    ):
        closed = external(Closed())
    model = Ensemble({"mine": closed, "still": Persistence()}, {"boa": BOA()})
    samples = random_samples(8)
    with pytest.warns(UserWarning, match="estimators.mine: Closed cannot be resumed"):
        online = Online(model)
    for k in range(6):
        online.step(at(samples, k))
    assert np.isfinite(online.leaf("predictions")).all()
    path = online.save(tmp_path / "a.safetensors")
    with pytest.warns(UserWarning, match="cannot be resumed"):
        again = Online(Ensemble({"mine": external(Closed()), "still": Persistence()}, {"boa": BOA()}))
    again.restore(path)
    with pytest.warns(UserWarning, match="a state of another session"):
        again.step(at(samples, 6))
    assert np.isnan(again.leaf("predictions")[0])
    CONTRACTS["resume_from_disk_is_exact"](lambda: external(Told()))


def test_a_state_is_plain_and_of_the_same_object():
    model, x = Plain(), np.zeros(3)
    content = packed(model, 4096)
    assert unpacked(content, Plain()).held["rule"] is math.sqrt
    model.turned = np.arange(6.0).reshape(3, 2).T  # a library may change it in place by its order
    turned = unpacked(packed(model, 4096), Plain()).turned
    assert turned.flags.f_contiguous and not turned.flags.c_contiguous and (turned == model.turned).all()
    for value, words in (
        ([x, x], "held twice"),
        ([x, x[:2]], "share memory"),
        (np.ones((4, 4))[::2], "not plain"),
        (object(), "is not plain"),
        (lambda: 0, None),
    ):
        model.shared = value
        if words is not None:
            with pytest.raises(TypeError, match=words):
                packed(model, 4096)
    with pytest.raises(ValueError, match="larger state_size"):
        packed(np.random.default_rng(0).random(100), 64)
    for damaged in (content[::-1].copy(), np.full(64, 255, np.uint8), packed([1.0, 2.0], 64)):
        with pytest.raises(CheckpointError, match="does not fit Plain"):
            unpacked(damaged, Plain())


def test_what_is_no_model_is_refused(own):
    with pytest.raises(ConfigError, match="found int, expected an object with predict_one and learn_one"):
        external(3)
    with pytest.raises(ConfigError, match="speed: found no such setting, expected rate"):
        own["NLMS"](speed=1.0)
    with pytest.raises(ConfigError, match="found no parameters that are trained"):
        OnlineModule(nn.ReLU())
    module = OnlineModule(nn.Bilinear(1, 8, 2))
    with pytest.raises(ShapeError, match=r"net: found a result of the shape \(1, 2\), expected \(1, 1\)"):
        module.predict(module.init(), at(random_samples(1), 0).inputs)


@pytest.mark.thorough
@pytest.mark.parametrize("sweep", SWEEPS, ids=lambda sweep: re.findall(r"_target_=\S*?(\w+) ", sweep)[-1])
def test_a_class_of_ones_own_is_in_runs_sweeps_and_resumes(sweep, tmp_path, monkeypatch):
    if not LIBRARIES and ("river" in sweep or "sklearn" in sweep):
        pytest.skip("river and scikit-learn are not installed")
    (tmp_path / "mine.py").write_text("\n".join(block for block in BLOCKS if "class" in block))
    monkeypatch.syspath_prepend(str(tmp_path))
    *mine, swept = sweep.replace("\\", " ").split()
    quick = [each.replace("members=[aid,sift_map,joint]", "members=[aid,joint,mine]") for each in [*QUICK, *mine]]
    done = run(*quick, "--all", "hydra.run.dir=whole", folder=tmp_path)
    assert done.returncode == 0 and re.search(r"^ensemble.*\n(?:.*\n)*mine", done.stdout, re.M), done.stderr
    shutil.copytree(tmp_path / "whole", tmp_path / "part")
    for kind in ("checkpoints/heron", "predictions"):
        for late in sorted((tmp_path / "part" / kind).iterdir())[2:]:
            late.unlink()
    (tmp_path / "part" / "results.json").unlink()
    done = run(*quick, "hydra.run.dir=part", "resume=latest", folder=tmp_path)
    assert done.returncode == 0 and "resuming after step" in done.stdout, done.stderr
    assert_equal_runs(tmp_path / "part", tmp_path / "whole")
    done = run("-m", *quick, swept, "hydra.sweep.dir=sweep", folder=tmp_path)
    assert done.returncode == 0 and "2 of 2 done" in done.stdout, done.stderr
