"""Who makes the steps, and what stands against the kernels; checkpoints by either."""

import json
import math

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from tests.support import ESTIMATORS, FAMILIES, each_dtype, over, random_samples
from tests.support.commands import python
from tests.support.kernel_cases import difference, mission
from usvlearn import (
    AID,
    ARX,
    BOA,
    RLS,
    Average,
    Ensemble,
    ForecastSettings,
    Inputs,
    JointEKF,
    Online,
    Persistence,
    Sample,
    SurgeDynamics,
    Trial,
    forecast,
    rollout,
)
from usvlearn.core import checkpoint as store
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine import rollouts
from usvlearn.engine.backend import choose
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.errors import ConfigError

every_family = pytest.mark.parametrize("name", FAMILIES)


class OwnAID(AID):
    """Whose steps may be others."""


class OwnModel(SurgeDynamics):
    """Likewise."""


class OwnRule(Average):
    """Likewise."""


def chosen(estimator, samples=None, batch=(), dtype=torch.float64, backend="auto"):
    samples = random_samples(2, *batch, dtype=dtype) if samples is None else samples
    return choose(estimator, estimator.init(batch), samples, backend)


@every_family
def test_the_kernels_where_no_gradient_is_asked_for(name):
    estimator, samples = ESTIMATORS[name](), random_samples(3)
    learnable = any(x.requires_grad for x in estimator.parameters())
    assert (chosen(estimator) is None) == learnable
    with torch.no_grad():
        description = chosen(estimator)
        assert json.loads(json.dumps(description)) == description
        by = {b: rollout(estimator, estimator.init(), samples, backend=b)[1] for b in ("auto", "kernel")}
        assert torch.equal(by["auto"], by["kernel"])
        assert chosen(estimator, backend="torch") is None
    estimator.requires_grad_(False)
    assert chosen(estimator) is not None
    by = [rollout(estimator, estimator.init(), samples, backend=b)[1] for b in ("auto", "torch")]
    assert difference(*by) < 1e-9 and not by[0].requires_grad


NO_KERNEL = "OBSTACLE, or a part of it, has no compiled kernel"
OBSTACLES = {
    "subclass": (lambda: OwnAID(), NO_KERNEL.replace("OBSTACLE", "OwnAID")),
    "model": (lambda: RLS(OwnModel()), NO_KERNEL.replace("OBSTACLE", "RLS")),
    "rule": (
        lambda: Ensemble({"a": AID()}, {"own": OwnRule()}, watched=False, conditional=False),
        NO_KERNEL.replace("OBSTACLE", "Ensemble"),
    ),
}


@pytest.mark.parametrize("what", OBSTACLES)
def test_torch_where_there_is_no_kernel(what):
    make, reason = OBSTACLES[what]
    with torch.no_grad():
        estimator = make()
        assert chosen(estimator) is None
        assert rollout(estimator, estimator.init(), random_samples(3))[1].isfinite().all()
        with pytest.raises(ConfigError, match=f"backend: found kernel, but {reason}.*use auto or torch"):
            rollout(estimator, estimator.init(), random_samples(3), backend="kernel")


def test_beside_a_member_without_a_kernel_the_others_step_by_theirs():
    """Members and combiners by torch, the rest by kernels, to rounding."""

    def make(aid):
        members = {"aid": aid, "joint": JointEKF(2.0, 28.0, trial=Trial()), "arx": ARX(), "still": Persistence()}
        return Ensemble(members, {"boa": BOA()}, forecasts=ForecastSettings((0.4, 1.2), ["joint", "still"]))

    samples, start = mission(120, 2), make(AID(28.0)).init((2,))
    with torch.no_grad():
        expected = rollout(make(AID(28.0)), start, samples, backend="kernel")
        mixed = rollout(make(OwnAID(28.0)), start, samples)
        assert difference(mixed[0], expected[0]) < 1e-9 and difference(mixed[1], expected[1]) < 1e-9
        plan = tree_map(lambda x: x.nan_to_num(0.0).clamp(-1, 1), mission(5, 2, faults=False)).inputs
        ahead = [forecast(make(aid), mixed[0], plan) for aid in (AID(28.0), OwnAID(28.0))]
    assert torch.equal(ahead[0].surge, ahead[1].surge) and torch.equal(ahead[0].high, ahead[1].high)
    with pytest.raises(ConfigError, match=r"combiners.own: found OwnRule, which has no kernel, expected watched"):
        Ensemble({"a": AID()}, {"own": OwnRule()})


def test_gradients_pass_through_members_and_combiners_of_torch_alone():
    aid, samples = AID(28.0), random_samples(12)
    mixed = Ensemble({"aid": aid, "arx": ARX()}, forecasts=ForecastSettings((0.4,)))
    slopes = []
    for ensemble in (mixed, Ensemble({"aid": aid, "arx": ARX()}, watched=False, conditional=False)):
        surge = rollout(ensemble, ensemble.init(), samples)[1]
        slopes += torch.autograd.grad(surge.sum(), aid.gain.log)
    assert slopes[0] != 0 and torch.isclose(*slopes)
    for estimator in (ARX(), mixed):
        wanted = samples._replace(surge=samples.surge.clone().requires_grad_())
        with pytest.raises(ConfigError, match=r"ARX: a gradient is asked for .*only its kernel makes its steps"):
            rollout(estimator, tree_map(torch.Tensor.detach, estimator.init()), wanted)
    with (
        pytest.raises(ConfigError, match="torch transforms this function, and kernels make this step"),
        torch.no_grad(),
    ):
        aided = Ensemble({"aid": AID(28.0)})
        torch.vmap(lambda x: rollout(aided, aided.init(), samples._replace(surge=x))[1])(samples.surge[None])


@pytest.mark.filterwarnings("ignore:.torch.jit.script:DeprecationWarning")  # of torch's own forward mode
def test_torch_where_a_derivative_is_asked_for():
    aid, rest, samples = AID(), Persistence(), random_samples(3)
    assert chosen(rest) is not None
    with pytest.raises(ConfigError, match=r"a gradient is asked for \(inside torch.no_grad\(\) none is\)"):
        chosen(aid, backend="kernel")
    wanted = samples._replace(surge=samples.surge.requires_grad_())
    assert chosen(rest, wanted) is None
    assert torch.autograd.grad(rollout(rest, rest.init(), wanted)[1].sum(), wanted.surge)[0].tolist() == [1, 1, 0]
    state = tree_map(lambda x: x.clone().requires_grad_(), rest.init())
    assert choose(rest, state, random_samples(3), "auto") is None
    with torch.no_grad():
        assert choose(rest, state, wanted, "auto") is not None
        assert rollout(rest, state, wanted, backend="kernel")[1].tolist() == [0.0, *wanted.surge[:2].tolist()]
    plain = random_samples(3)
    with torch.no_grad(), forward_ad.dual_level():
        dual = plain._replace(surge=forward_ad.make_dual(plain.surge, torch.ones(3).double()))
        with pytest.raises(ConfigError, match="a forward derivative is asked for"):
            chosen(rest, dual, backend="kernel")
        assert forward_ad.unpack_dual(rollout(rest, rest.init(), dual)[1]).tangent.tolist() == [0, 1, 1]


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # torch's own, at its first jvp
def test_torch_where_torch_transforms():
    rest, samples = Persistence(), random_samples(3)
    speeds = torch.tensor([0.5, 1.5], dtype=torch.float64)

    def predictions(surge, backend="auto"):
        return rollout(rest, rest.init()._replace(surge=surge), samples, backend=backend)[1]

    expected = torch.stack([predictions(speed, "torch") for speed in speeds])
    assert torch.equal(torch.vmap(predictions)(speeds), expected)
    assert torch.func.jvp(predictions, (speeds[0],), (speeds[1],))[1].tolist() == [1.5, 0, 0]
    with pytest.raises(ConfigError, match="torch transforms this function"):
        torch.vmap(lambda x: predictions(x, "kernel"))(speeds)
    torch.compiler.reset()
    assert torch.equal(torch.compile(predictions, backend="eager")(speeds[1]), expected[1])


def test_other_devices_and_dtypes_are_torch_s():
    half = Persistence().to(torch.float16)
    assert chosen(half, dtype=torch.float16) is None
    with pytest.raises(ConfigError, match=r"found kernel, but the numbers are torch\.float16"):
        chosen(half, dtype=torch.float16, backend="kernel")
    with pytest.raises(ConfigError, match="not all tensors are on the CPU"):
        chosen(Persistence().to("meta"), backend="kernel")
    with pytest.raises(ConfigError, match="backend: found 'numba', expected one of auto, torch, kernel"):
        chosen(Persistence(), backend="numba")


def test_without_numba_torch_makes_the_steps(monkeypatch):
    real = __import__("importlib.util").util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *rest: None if name == "numba" else real(name, *rest))
    rest, samples = Persistence(), random_samples(3)
    assert chosen(rest) is None and Online(rest).step(tree_map(lambda x: x[0], samples)) == 0.0
    for ask in (lambda: chosen(rest, backend="kernel"), lambda: Online(rest, backend="kernel")):
        with pytest.raises(ConfigError, match="numba is not installed"):
            ask()


def test_hyperparameters_that_do_not_fit_the_batch_are_refused():
    aid, samples = AID(gain=torch.ones(5, 1)), random_samples(3, 5, 2)
    state, narrow = aid.init((5, 2)), AID(gain=torch.ones(4, 1))
    with torch.no_grad():
        for backend in ("kernel", "torch"):
            with pytest.raises((ValueError, RuntimeError)):
                rollout(narrow, state, samples, backend=backend)


@every_family
@over("batch", [(), (2,)])
def test_checkpoints_are_the_same_from_either(name, batch, tmp_path):
    """Names, shapes, dtypes and what is said of them; numbers to rounding. Either goes on from the other's."""
    samples = mission(60, *batch, seed=7)
    at = [tree_map(lambda x, k=k: x[k], samples) for k in range(60)]
    boats = {backend: Online(ESTIMATORS[name](), batch, backend) for backend in ("kernel", "torch")}
    for online in boats.values():
        for sample in at[:30]:
            online.step(sample)
    paths = {
        backend: online.save(tmp_path / f"{backend}.safetensors", boat="heron") for backend, online in boats.items()
    }
    contents = {backend: path.read_bytes() for backend, path in paths.items()}
    headers = {b: json.loads(x[8 : 8 + int.from_bytes(x[:8], "little")]) for b, x in contents.items()}
    facts = [json.loads(header.pop("__metadata__")["usvlearn"]) for header in headers.values()]
    assert all(one.pop("sha256") for one in facts) and facts[0] == facts[1]
    assert headers["kernel"] == headers["torch"] and len(contents["kernel"]) == len(contents["torch"])
    loaded = [tree_map(torch.from_numpy, store.load(path)[0]) for path in paths.values()]
    assert difference(*loaded) <= 1e-9
    boats["kernel"].restore(paths["torch"])
    boats["torch"].restore(paths["kernel"])
    surges = [torch.tensor([online.step(sample) for sample in at[30:40]]) if batch == () else
             torch.stack([torch.from_numpy(online.step(sample)) for sample in at[30:40]])
             for online in boats.values()]  # fmt: skip
    assert difference(*surges) <= 1e-9 and difference(*(online.state for online in boats.values())) <= 1e-9


PLAIN = """
import torch
from tests.support import ESTIMATORS
from tests.support.kernel_cases import difference, mission
from usvlearn import Online, rollout
from usvlearn.core.samples import tree_map
torch.set_grad_enabled(False)
for make in ESTIMATORS.values():
    estimator, samples = make(), mission(8, 2, seed=1)
    found, expected = (rollout(estimator, estimator.init((2,)), samples, backend=b) for b in ("kernel", "torch"))
    assert max(difference(x, y) for x, y in zip(found[:2], expected[:2])) < 1e-9
    one = tree_map(lambda x: x[0, 0], samples)
    kernel, eager = (Online(estimator, backend=b).step(one) for b in ("kernel", "torch"))
    assert abs(kernel - eager) < 1e-12
print(len(ESTIMATORS))
"""


@pytest.mark.thorough
def test_plain_python_makes_the_same_steps():
    """As a debugger sees them."""
    assert python(PLAIN, NUMBA_DISABLE_JIT="1").stdout == f"{len(ESTIMATORS)}\n"


def test_a_gradient_of_a_constant_is_asked_for_too():
    aid = AID(28.0).requires_grad_(False)
    aid.model.mass.requires_grad_(True)
    assert rollout(aid, aid.init(), random_samples(3))[1].requires_grad


def test_a_method_that_was_replaced_is_heard():
    aid = AID(28.0)
    aid.learn = lambda state, inputs, surge: (state, surge)
    with torch.no_grad():
        samples = random_samples(3)
        assert torch.equal(rollout(aid, aid.init(), samples)[1], samples.surge)


def test_no_elements_are_no_steps():
    aid = AID(28.0)
    with torch.no_grad():
        assert rollout(aid, aid.init((0,)), random_samples(4, 0))[1].shape == (4, 0)


@pytest.mark.parametrize("make", [
    lambda: AID(28.0), lambda: Ensemble({"aid": AID(28.0), "rls": RLS()}, watched=False, conditional=False),
], ids=["aid", "ensemble"])  # fmt: skip
def test_hyperparameters_are_mapped_over(make):
    """vmap hands over parameters that no kernel can read."""

    samples = random_samples(5)

    class Errors(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.estimator = make()

        def forward(self):
            return rollout(self.estimator, self.estimator.init(), samples)[1]

    module = Errors()
    stacked = {name: torch.stack([x.detach(), x.detach() + 1]) for name, x in module.named_parameters()}
    with torch.no_grad():
        both = torch.vmap(lambda each: torch.func.functional_call(module, each, ()))(stacked)
        torch.testing.assert_close(both[0], module(), rtol=1e-12, atol=1e-12)
    assert not torch.equal(both[0], both[1])


def test_results_and_samples_are_tensors_like_any():
    aid, samples = AID(28.0), random_samples(5, 3)
    with torch.no_grad():
        expected = rollout(aid, aid.init((3,)), samples)[1]
        assert expected.view(-1).shape == (15,)
        negated = torch.complex(samples.surge, -samples.surge).conj().imag  # a view that only says that it is negated
        assert torch.equal(rollout(aid, aid.init((3,)), samples._replace(surge=negated))[1], expected)


@over("name", ["robust_sift", "joint", "boa"])
def test_one_number_fits_every_batch_by_either(name):
    one = Sample(Inputs(0.5, 0.4, 0.1, 0.0, 0.4), 1.0, True, True)
    elements = Sample(Inputs(*(np.full(3, x) for x in one.inputs)), np.ones(3), np.ones(3, bool), np.ones(3, bool))
    by_torch, expected = Online(ESTIMATORS[name](), (3,), "torch"), Online(ESTIMATORS[name](), (3,), "kernel")
    for _ in range(3):
        assert difference(torch.from_numpy(by_torch.step(one)), torch.from_numpy(expected.step(elements))) < 1e-9
    assert (
        difference(torch.from_numpy(by_torch.predict(one.inputs)), torch.from_numpy(expected.predict(elements.inputs)))
        < 1e-9
    )


@pytest.mark.parametrize("backend", ["kernel", "torch"])
@each_dtype
def test_a_member_that_is_not_finite_begins_again_and_the_others_go_on(monkeypatch, backend, dtype):
    ensemble = Ensemble({"aid": AID(28.0), "rls": RLS(), "persistence": Persistence()}).to(dtype)
    if backend == "torch":
        monkeypatch.setattr(rollouts, "choose", lambda *_: None)
    parts = [tree_map(lambda x: x.numpy(), random_samples(5, 2, seed=seed)) for seed in range(3)]
    sound = [state for state, _ in chunked_rollout(ensemble, ensemble.init((2,)), parts, [])]
    broken = tree_map(torch.clone, ensemble.init((2,)))
    broken.members["aid"].theta[1, 0] = math.nan
    with pytest.warns(UserWarning, match=r"^the state of aid is not finite in 1 of 2 vehicles: it begins again there$"):
        states = [state for state, _ in chunked_rollout(ensemble, broken, parts, [])]
    first = dict(named_leaves(ensemble.init((2,)).members["aid"]))
    assert all(torch.equal(leaf[1], first[name][1]) for name, leaf in named_leaves(states[0].members["aid"]))
    for after, wanted in zip(states, sound, strict=True):
        for name, leaf in named_leaves(after.members):
            same = dict(named_leaves(wanted.members))[name]
            assert leaf.isfinite().all() and torch.equal(leaf[0], same[0]), name
            assert name.startswith("aid") or torch.equal(leaf, same), name
    again = [state for state, _ in chunked_rollout(ensemble, states[0], parts[1:], [])]
    ends = (dict(named_leaves(each[-1].members)) for each in (again, states))
    assert all(torch.equal(x, y) for x, y in zip(*(end.values() for end in ends), strict=True))
