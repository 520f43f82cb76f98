"""RNN: its gradient equals autograd's, its Adam torch's; it starts as persistence, or warm, and stays contracting."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch.func import grad

from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from tests.support import at, random_samples
from tests.support.recurrent import boat, loss
from usvlearn import AID, RNN, Ensemble, rollout
from usvlearn.core.checkpoint import save
from usvlearn.core.samples import tree_map
from usvlearn.errors import ConfigError
from usvlearn.estimators.rnn.layer import RNNState, clipped, element_weights, gradient, network, network_inputs
from usvlearn.report.sections.network import stability


def case(n: int, batch=(), seed: int = 0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn((*batch, *shape), generator=generator, dtype=torch.float64)

    weights = ShallowWeights(normal(n) / n, normal(n), normal(n, 4), normal(n))
    return weights, normal(), normal(4), normal(), normal(), normal(4)


def flatten(w: ShallowWeights) -> torch.Tensor:
    return torch.cat([w.a, w.w1, w.W2.flatten(-2), w.b], -1)


@pytest.mark.parametrize("unbroken", [False, True])
@pytest.mark.parametrize("n", [1, 6, 20])
def test_gradient_equals_autograd_and_differences(n, unbroken):
    weights, x, u, target, x_before, u_before = case(n)
    penalty, flag = torch.tensor(0.3, dtype=torch.float64), torch.tensor(unbroken)
    slopes = gradient(weights, x, u, target, penalty, (x_before, u_before, flag))
    arguments = (x, u, target, penalty, x_before, u_before, unbroken)
    torch.testing.assert_close(slopes, flatten(grad(loss)(weights, *arguments)), rtol=1e-12, atol=1e-12)
    h, flat = 1e-6, flatten(weights)
    for k in range(7 * n):
        costs = []
        for sign in (1, -1):
            moved = flat.clone()
            moved[k] += sign * h
            a, w1, W2, b = moved.split((n, n, 4 * n, n))
            costs.append(loss(ShallowWeights(a, w1, W2.reshape(n, 4), b), *arguments))
        torch.testing.assert_close(slopes[k], (costs[0] - costs[1]) / (2 * h), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("decay", [None, 7])
@pytest.mark.parametrize(
    ("momentum", "ratio"), [(0.9, (1, 1, 1, 1, 1)), (0.0, (1, 2, 0.3, 1.5, 0.5))], ids=["paper's", "default"]
)
@torch.enable_grad()
def test_adam_equals_torch(momentum, ratio, decay):
    rnn = RNN(6, initial="random", rate=0.01, rate_ratio=ratio, decay=decay, momentum=momentum, clip=None,
              stability="penalty", penalty=1e-3)  # fmt: skip
    samples = random_samples(40)
    end, _, _ = rollout(rnn, rnn.init(), samples)
    a, w1, W2, b = rnn.init().weights
    parts = [w.detach().clone().requires_grad_() for w in (a, w1, W2[:, :2], W2[:, 2:], b)]
    groups = [{"params": [part], "lr": 0.01 * each} for part, each in zip(parts, ratio, strict=True)]
    optimizer = torch.optim.Adam(groups, betas=(momentum, 0.999))
    v = torch.zeros((), dtype=torch.float64)
    for k in range(40):
        for group, each in zip(optimizer.param_groups, ratio, strict=True):
            group["lr"] = each * (0.01 if decay is None else 0.01 / (1 + k // decay) ** 0.5)
        u = network_inputs(at(samples.inputs, k))
        optimizer.zero_grad()
        weights = ShallowWeights(parts[0], parts[1], torch.cat(parts[2:4], -1), parts[4])
        loss(weights, rnn.scale * v, u, rnn.scale * samples.surge[k], 1e-3, None, None, False).backward()
        optimizer.step()
        v = samples.surge[k]
    weights = ShallowWeights(parts[0], parts[1], torch.cat(parts[2:4], -1), parts[4])
    for weight, expected in zip(end.weights, weights, strict=True):
        torch.testing.assert_close(weight, expected.detach(), rtol=1e-10, atol=1e-12)


def test_it_is_persistence_at_first_and_better_later():
    samples, rnn = boat(2000), RNN(surge_max=2.0)
    _, surge, _ = rollout(rnn, rnn.init(), samples)
    error = (surge - samples.surge).abs()[1:]
    steady = (samples.surge[1:] - samples.surge[:-1]).abs()
    assert error[:100].mean() < 1.2 * steady[:100].mean()
    assert error[1000:].mean() < 0.5 * steady[1000:].mean()


@pytest.mark.parametrize(
    ("options", "expected"),
    [({}, 0.999), ({"contraction_rate": 0.6}, 0.6), ({"condition": "interval"}, 0.999), ({"condition": "lmi"}, 0.4995),
     ({"stability": "penalty", "contraction_rate": 0.9}, 0.9), ({"stability": "none"}, 0.999)],
    ids=str,
)  # fmt: skip
def test_the_initial_network_is_persistence(options, expected):
    rnn = RNN(surge_max=2.5, **options)
    inputs = random_samples(1, 50).inputs
    inputs = at(inputs, 0)
    speeds = torch.linspace(-2.4, 5.0, 50, dtype=torch.float64)
    _, surge = rnn.predict(rnn.start(rnn.init((50,)), speeds), inputs)
    torch.testing.assert_close(surge.detach(), expected * speeds, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("condition", ["simple", "gershgorin", "lmi", "exact"])
@pytest.mark.parametrize("gauge", ["literal", "best"])
def test_the_initial_network_is_certified_exactly(condition, gauge):
    rnn = RNN(condition=condition, gauge=gauge, contraction_rate=0.9)
    weights = element_weights(rnn.init(), ())
    rates = exact.conditions(weights.a, weights.w1)
    name = condition if gauge == "literal" else "exact"
    assert 0 < rates[name].rate <= Fraction(0.9)


def test_clipping_shortens_each_element_alone():
    generator = torch.Generator().manual_seed(0)
    long = torch.randn((4, 140), generator=generator).double() * torch.tensor([[1e-6], [1.0], [1e6], [1e300]])
    short = clipped(long, 0.1)
    norm = short.norm(dim=-1)
    assert (norm <= 0.1).all() and (norm[1:] > 0.099).all()
    assert short.isfinite().all()
    torch.testing.assert_close(short[0], long[0], rtol=1e-8, atol=0.0)
    torch.testing.assert_close(short[1:3] / norm[1:3, None], long[1:3] / long[1:3].norm(dim=-1, keepdim=True))
    for element in range(4):
        assert torch.equal(short[element], clipped(long[element], 0.1))


def test_an_outlier_fills_no_memory_of_adam():
    """One batch element in two meets 99 m/s: the other is untouched, and its own mean of g² stays below c²."""
    rnn, samples = RNN(), random_samples(60, 2)
    surge = samples.surge.clone()
    surge[30, 1] = 99.0  # the fastest that counts as a measurement
    clean, _, _ = rollout(rnn, rnn.init((2,)), samples)
    hit, _, _ = rollout(rnn, rnn.init((2,)), samples._replace(surge=surge))
    assert all(x.isfinite().all() for x in (*hit.weights, hit.moment1, hit.moment2))
    assert (hit.moment2[1] <= 0.1**2).all() and not torch.equal(hit.weights.a[1], clean.weights.a[1])
    assert all(torch.equal(x[0], y[0]) for x, y in zip(hit.weights, clean.weights, strict=True))
    loose = RNN(clip=math.inf)
    hit, _, _ = rollout(loose, loose.init((2,)), samples._replace(surge=surge))
    assert hit.moment2[1].max() > 5 * 0.1**2  # which is what it is for


def trained() -> RNNState:
    """What a season left."""
    rnn = RNN(surge_max=2.0)
    return rollout(rnn, rnn.init(), boat(200))[0]


def test_warm_start_from_every_kind_of_file(tmp_path):
    state = trained()
    a, w1, W2, b = element_weights(state, ())
    np.savez(tmp_path / "set.npz", a=a, w1=w1, W2=W2, b=b)
    layers = {"0.weight": torch.from_numpy(np.column_stack([w1, W2])), "0.bias": torch.from_numpy(b)}
    torch.save({**layers, "2.weight": torch.from_numpy(a)[None]}, tmp_path / "set.pt")
    save(tmp_path / "set.safetensors", {"members": {"aid": AID().init(), "rnn": state}})
    for name in ("set.npz", "set.pt", "set.safetensors"):
        warm = RNN(surge_max=2.0, pretrained=tmp_path / name).init((3,))
        for weight, expected in zip(warm.weights, state.weights, strict=True):  # on the edge `project` moves an ulp
            torch.testing.assert_close(weight, expected.expand(3, *expected.shape), rtol=1e-12, atol=1e-12)
        assert (warm.moment2 == 0).all() and (warm.updates == 0).all()


def test_warm_start_is_projected_and_learns_on(tmp_path):
    n = 3
    np.savez(tmp_path / "wild.npz", a=np.ones(n), w1=np.ones(n), W2=np.zeros((n, 4)), b=np.ones(n))
    rnn = RNN(n, pretrained=str(tmp_path / "wild.npz"))
    _, _, weights = rollout(rnn, rnn.init(), random_samples(30), record=lambda s: s.weights)
    assert exact.conditions(*element_weights(rnn.init(), ())[:2])["exact"].rate <= Fraction(0.999)
    assert all(
        exact.conditions(*pair)["exact"].rate <= Fraction(0.999)
        for pair in zip(weights.a.numpy(), weights.w1.numpy(), strict=True)
    )


def test_warm_start_from_one_of_several_networks(tmp_path):
    state = trained()
    path, other = tmp_path / "both.safetensors", RNN(20, initial="random").init()
    save(path, {"members": {"first": state, "second": other}})
    one = RNN(surge_max=2.0, pretrained=f"{path}:members.second.weights")
    torch.testing.assert_close(one.init().weights.a, other.weights.a, rtol=1e-12, atol=1e-12)
    elements = save(tmp_path / "lanes.safetensors", tree_map(lambda x: torch.stack([x, 0.5 * x]), state.weights))
    torch.testing.assert_close(RNN(pretrained=f"{elements}[1]").init().weights.a, 0.5 * state.weights.a)


def test_a_wrong_warm_start_is_refused(tmp_path):
    state = trained()
    both = save(tmp_path / "both.safetensors", {"first": state, "second": state})
    np.savez(tmp_path / "narrow.npz", a=np.ones(20), w1=np.ones(20), W2=np.ones((20, 3)), b=np.ones(20))
    np.savez(tmp_path / "nan.npz", a=np.full(20, np.nan), w1=np.ones(20), W2=np.ones((20, 4)), b=np.ones(20))
    (tmp_path / "noise.safetensors").write_bytes(b"noise")
    wrong = {
        str(tmp_path / "none.npz"): r"pretrained: .*cannot be read",
        str(tmp_path): r"pretrained: .*expected a file that ends in",
        str(tmp_path / "noise.safetensors"): r"pretrained: .*cannot be read",
        str(tmp_path / "nan.npz"): r"pretrained: .*expected finite weights",
        str(both): r"found 2 networks .*give one of .*:first.weights, .*:second.weights",
        f"{both}:third.weights": r"found 0 networks .*give one of .*:first.weights, .*:second.weights",
        str(tmp_path / "narrow.npz"): r"found 20 neurons and 3 inputs .*expected 20 and 4",
    }
    for given, message in wrong.items():
        with pytest.raises(ConfigError, match=message):
            RNN(pretrained=given)
    with pytest.raises(ConfigError, match=r"found 20 neurons and 4 inputs .*expected 6 and 4: set neurons"):
        RNN(6, pretrained=f"{both}:first.weights")


def test_paper_size_and_seeded_weights():
    assert sum(w.numel() for w in RNN().init().weights) == 140
    same, other = RNN(seed=1).init().weights, RNN(seed=2).init().weights
    assert torch.equal(RNN(seed=1).init().weights.W2, same.W2) and not torch.equal(same.W2, other.W2)


def test_two_networks_that_learn_alike_forget_how_they_started():
    """Equal updates and inputs from two speeds: the difference shrinks by κ at every step, while the weights move."""
    rnn, samples = RNN(feedback="estimate", rate=0.1, contraction_rate=0.9), random_samples(30, 2)
    state = rnn.init((2,))
    inputs = type(samples.inputs)(*(x[:, :1].expand(-1, 2) for x in samples.inputs))
    state = state._replace(surge=torch.tensor([-0.5, 1.5], dtype=torch.float64))
    before = 2.0
    for k in range(30):
        learned = rnn.update(state, at(inputs, k), samples.surge[k, :1].expand(2))
        weights = tree_map(lambda w: w[:1].expand_as(w), learned.weights)  # the first batch element's, for both
        state = state._replace(weights=weights)
        coasted, _ = rnn.predict(state, at(inputs, k))
        after = float((coasted.surge[1] - coasted.surge[0]).detach().abs())
        assert after <= 0.9 * before + 1e-12
        state, before = coasted, after


def test_monitor_tells_margins_rate_time_constant_and_rest():
    rnn, samples = RNN(surge_max=2.0), random_samples(50, 3)
    state, _, _ = rollout(rnn, rnn.init((3,)), samples)
    values = rnn.monitor(state)
    K = values["contraction_rate"]
    torch.testing.assert_close(values["margin_exact"], 1 - K)
    torch.testing.assert_close(values["time_constant"], -state.dt / K.log())
    rest = torch.cat([state.inputs_before[:, :2], torch.zeros(3, 2).double()], -1)
    x = rnn.scale * values["equilibrium"].double()
    torch.testing.assert_close(network(state.weights, x, rest)[0], x)
    assert (values["equilibria"] == 1).all()  # a contraction has one
    broken = state._replace(weights=tree_map(lambda w: w * torch.nan, state.weights))
    assert rnn.monitor(broken)["equilibrium"].isnan().all()
    zero, one = torch.zeros(20).double(), torch.eye(20)[0].double()  # x⁺ = 2 relu(x − ¼): at rest at 0 and ½
    tooth = tree_map(
        lambda w: w.expand(3, *w.shape), ShallowWeights(2 * one, one, zero[:, None].expand(20, 4), -one / 4)
    )
    values = rnn.monitor(state._replace(weights=tooth, surge=torch.tensor([-0.2, 0.1, 0.4]) / rnn.scale))
    assert (values["equilibria"] == 2).all() and (rnn.scale * values["equilibrium"]).tolist() == [0.0, 0.0, 0.5]


def test_a_rate_just_below_one_is_not_told_as_one():
    ensemble = Ensemble({"rnn": RNN(contraction_rate=0.999999)})
    (line,) = stability(ensemble, ensemble.init((1,)), ["heron"])
    assert "certified contracting by exact, K = 0.999999 a step" in line
    free = {"heron": {"rnn": 0.41, "average": 0.2, "persistence": 0.9}}  # a proof is not praise
    (beside,) = stability(ensemble, ensemble.init((1,)), ["heron"], free)
    assert (
        beside == f"{line}; open-loop simulations are far off: they err by 0.410 m/s (average 0.200, persistence 0.900)"
    )
    for errors, far in (((0.39, 0.2, 0.9), False), ((0.9, 0.5, 0.9), True), ((0.41, None, None), False)):
        free = {"heron": dict(zip(("rnn", "average", "persistence"), errors, strict=True))}
        (beside,) = stability(ensemble, ensemble.init((1,)), ["heron"], free)
        assert ("far off" in beside) is far and f"err by {errors[0]:.3f} m/s" in beside
    ensemble = Ensemble({"rnn": RNN(stability="none", contraction_rate=0.5)})
    state = ensemble.init((1,))
    learned = state.members["rnn"]
    grown = learned._replace(weights=learned.weights._replace(a=learned.weights.a * 2.00002))
    (line,) = stability(ensemble, state._replace(members={"rnn": grown}), ["heron"])
    assert "not certified contracting, K = 1 (≥ 1)" in line
