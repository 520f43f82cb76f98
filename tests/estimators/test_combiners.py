"""The rules: against the papers' own formulas and bounds, with inactive members, spikes, and no active one."""

import math

import numpy as np
import pytest
import torch

from usvlearn import BOA, Average, ExponentialWeights, FixedWeights, RecursiveWeights
from usvlearn.estimators.ensemble.combiners.layer import fill_inactive

NAMES = ["a", "b", "c", "d"]
ZERO = torch.zeros((), dtype=torch.float64)
ADAPTIVE = [BOA, ExponentialWeights, RecursiveWeights]
each_rule = pytest.mark.parametrize("rule", ADAPTIVE)


def bound(rule, names=NAMES):
    rule.bind(names)
    return rule


def series(steps: int, kind: str = "noise", seed: int = 0):
    """Members' predictions `(time, 4)` and the truth, m/s."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(0, 2, steps)
    noise = rng.standard_normal((steps, 4))
    if kind == "one is good":
        return y[:, None] + noise * [0.02, 0.5, 0.5, 0.5] + [0, 0.5, 0.5, 0.5], y
    if kind == "turns":  # the best changes, and each is bad where another is good
        best = np.arange(steps) * 8 // steps % 4
        return y[:, None] + noise * np.where(best[:, None] == np.arange(4), 0.02, 0.4), y
    if kind == "alternate":  # two that err by turns and in opposite ways
        sign = (-1.0) ** np.arange(steps)[:, None]
        return y[:, None] + sign * [0.5, -0.5, 0.3, -0.2] + 0.01 * noise, y
    return y[:, None] + 0.1 * noise * [1, 2, 3, 4], y


def run(rule, x, y, dt: float = 0.4):
    """The rule's predictions, `(time,)`, its weights before each and its last state."""
    x, y, step = torch.as_tensor(x), torch.as_tensor(y), torch.tensor(dt, dtype=torch.float64)
    state, said, weights = rule.init((), ZERO), [], []
    for k in range(len(y)):
        said.append(rule.combine(state, x[k]))
        weights.append(state.weights)
        state = rule.learn(state, x[k], y[k], step)
    return torch.stack(said).numpy(), torch.stack(weights).numpy(), state


def wintenberger(x, y, loss, scale, prior):
    """Algorithm 2 of the paper with the gradient trick, one member and one sample at a time."""
    members = len(prior)
    L, V, E, eta, said, history = [0.0] * members, [0.0] * members, [scale] * members, [1 / scale] * members, [], []
    weights = list(prior)
    for row, target in zip(x, y, strict=True):
        mix = sum(w * v for w, v in zip(weights, row, strict=True))
        said.append(mix)
        slope = float(np.sign(mix - target)) if loss == "absolute" else 2 * (mix - target)
        for j in range(members):
            linear = slope * (row[j] - mix)
            E[j] = max(E[j], abs(linear))
            rate = min(eta[j], 1 / E[j])  # the paper has eta[j], which does not know the new E
            L[j] += 0.5 * (linear * (1 + rate * linear) + (E[j] if rate * linear > 0.5 else 0.0))
            V[j] += linear**2
            eta[j] = min(1 / E[j], math.sqrt(math.log(1 / prior[j]) / V[j]) if V[j] else math.inf)
        exponents = [math.log(prior[j] * eta[j]) - eta[j] * L[j] for j in range(members)]
        raw = [math.exp(e - max(exponents)) for e in exponents]
        weights = [r / sum(raw) for r in raw]
        history.append(weights)
    return np.array(said), np.array(history)


@pytest.mark.parametrize("loss", ["absolute", "square"])
@pytest.mark.parametrize("kind", ["noise", "one is good", "turns", "alternate"])
def test_boa_is_the_published_rule(loss, kind):
    x, y = series(400, kind)
    rule = bound(BOA(memory=None, share=0.0, loss=loss, scale=0.05, prior={"a": 0.5, "d": 2.0}))
    said, weights, state = run(rule, x, y)
    expected, history = wintenberger(x, y, loss, 0.05, np.array([0.5, 1, 1, 2]) / 4.5)
    np.testing.assert_allclose(said, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(weights[1:], history[:-1], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(state.weights, history[-1], rtol=1e-7, atol=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["noise", "one is good", "turns", "alternate"])
@pytest.mark.parametrize("loss", ["absolute", "square"])
def test_regret_stays_within_the_second_order_bound(kind, loss):
    """Σ ℓ(ŷ) − Σ ℓ(x_k) ≤ 5 Σ η l² + 2 (log(1/w0) + log(1 + B))/η_T, where E bounds all |l| from the start.

    By Wintenberger's argument: e^(−u−2u²) ≤ 1 − u for u = ηl/2 ≤ ½, so W = Σ w0 exp(−ηL) grows by the changes of η
    alone: B = Σ_t Σ_k w0 (η_(t−1)/η_t − 1)/e (Gaillard, Stoltz & van Erven 2014, lemma 13). From w0 exp(−ηL) ≤ 1 + B
    follows −L ≤ log((1+B)/w0)/η; the surcharge E, only where ηl > ½, is at most 4ηl². η ~ √(c/V), so this is O(√(cV)).
    """
    x, y = series(1500, kind)
    prior = np.full(4, 0.25)
    largest = 6.0 if loss == "absolute" else 60.0
    rule = bound(BOA(memory=None, share=0.0, loss=loss, scale=largest))
    said, _, state = run(rule, x, y)
    assert torch.equal(state.ranges, torch.full_like(state.ranges, largest))  # E was known
    slope = np.sign(said - y) if loss == "absolute" else 2 * (said - y)
    linear = slope[:, None] * (x - said[:, None])
    V = np.cumsum(linear**2, 0)
    eta = np.minimum(1 / largest, np.sqrt(np.log(4) / V))
    before = np.concatenate([np.full((1, 4), 1 / largest), eta[:-1]])
    B = (prior * (before / eta - 1)).sum() / math.e
    limit = 5 * (before * linear**2).sum(0) + 2 * (np.log(1 / prior) + math.log1p(B)) / eta[-1]
    measure = np.abs if loss == "absolute" else np.square
    regret = measure(said - y).sum() - measure(x - y[:, None]).sum(0)
    assert (regret <= -linear.sum(0) + 1e-9).all() and (-linear.sum(0) <= limit).all()
    assert limit.min() < measure(x - y[:, None]).sum(0).max()  # the bound says something


@pytest.mark.parametrize(
    "rule", [BOA(), BOA(memory=None, loss="square", scale=1.0), BOA(memory=None, share=0.0), ExponentialWeights()]
)
def test_finds_the_one_good_member(rule):
    x, y = series(1000, "one is good")
    said, _, state = run(bound(rule), x, y)
    error, best, mean = (np.abs(v - y)[300:].mean() for v in (said, x[:, 0], x.mean(1)))
    assert error < best + 0.1 * mean and error < 0.2 * mean
    assert state.weights[0] > 0.9


@pytest.mark.thorough
def test_memory_follows_the_best_of_the_day():
    x, y = series(4000, "turns")
    forgets, never = (np.abs(run(bound(BOA(memory=m)), x, y)[0] - y).mean() for m in (20.0, None))
    best = np.abs(x - y[:, None]).mean(0).min()
    assert forgets < 0.5 * best and forgets < never


def test_exponential_weights_have_their_closed_form():
    x, y = series(50)
    prior, kappa = np.array([3, 1, 1, 1]) / 6, math.exp(-0.4 / 5.0)
    rule = bound(ExponentialWeights(rate=7.0, memory=5.0, loss="square", prior={"a": 3.0}))
    _, _, state = run(rule, x, y)
    losses = (kappa ** np.arange(49, -1, -1)[:, None] * (x - y[:, None]) ** 2).sum(0)
    raw = prior * np.exp(-7.0 * losses)
    np.testing.assert_allclose(state.weights, raw / raw.sum(), rtol=1e-10)
    _, _, state = run(bound(ExponentialWeights(rate=7.0, memory=None)), x, y)
    raw = np.exp(-7.0 * np.abs(x - y[:, None]).sum(0))
    np.testing.assert_allclose(state.weights, raw / raw.sum(), rtol=1e-9, atol=1e-300)


def test_steps_forget_by_the_time_that_passed():
    x, y = series(2)
    for rule in (bound(BOA(memory=3.0)), bound(ExponentialWeights(memory=3.0))):
        _, _, state = run(rule, x, y)
        steps = [torch.tensor(t, dtype=torch.float64) for t in (0.4, 2.6)]
        nothing = torch.full((4,), 1.0, dtype=torch.float64)
        for dt in (*steps, sum(steps)):  # all agree with the truth: only forgetting is left
            after = rule.learn(state, nothing, nothing[0], dt)
            torch.testing.assert_close(after.losses, state.losses * math.exp(-float(dt) / 3.0))


@pytest.mark.parametrize("rule", [BOA(memory=None, share=0.0), ExponentialWeights(memory=None)])
def test_a_sleeper_is_neither_praised_nor_blamed(rule):
    x, y = series(60)
    x = torch.as_tensor(x)
    _, _, state = run(bound(rule), x, y)
    slept = x[5].clone()
    slept[1] = math.nan
    combined = rule.combine(state, slept)
    others = [0, 2, 3]
    torch.testing.assert_close(combined, (state.weights * slept)[others].sum() / state.weights[others].sum())
    after = rule.learn(state, slept, torch.tensor(y[5]), ZERO)
    torch.testing.assert_close(after.weights.sum(), torch.ones_like(ZERO))
    mixed = (combined - y[5]).abs() if isinstance(rule, ExponentialWeights) else ZERO  # it says what the others say
    torch.testing.assert_close(after.losses[1], state.losses[1] + mixed, rtol=1e-9, atol=1e-9)
    if isinstance(rule, BOA):
        assert after.squares[1] - state.squares[1] < 1e-20 and after.ranges[1] == state.ranges[1]
    alone = torch.tensor([math.nan, math.nan, 1.7, math.nan], dtype=torch.float64)
    torch.testing.assert_close(rule.combine(state, alone), alone[2])


@pytest.mark.parametrize("rule", [BOA(), ExponentialWeights(), RecursiveWeights(forgetting=0.95)])
def test_a_member_that_wakes_comes_back(rule):
    """The best is inactive for half the time; then it is soon heard again."""
    x, y = series(1200, "one is good")
    x[:600, 0] = math.nan
    said, weights, _ = run(bound(rule), x, y)
    assert np.isfinite(said).all() and np.isfinite(weights).all()
    assert np.abs(said - y)[-300:].mean() < 0.15 * np.abs(said - y)[300:600].mean()


@each_rule
def test_where_all_sleep_nothing_is_said_or_learned(rule):
    x, y = series(200, "one is good")
    gap = x.copy()
    gap[90:100] = math.nan
    said, weights, _ = run(bound(rule()), gap, y)
    assert np.isnan(said[90:100]).all() and np.isfinite(np.delete(said, range(90, 100))).all()
    np.testing.assert_allclose(weights[91:101].sum(-1), weights[90].sum(), rtol=0.2)
    assert np.abs(said - y)[-50:].mean() < 0.1
    state = run(bound(rule()), x[:90], y[:90])[2]
    after = bound(rule()).learn(state, torch.full((4,), math.nan, dtype=torch.float64), ZERO + 1.0, ZERO)
    for name in set(after._fields) - {"weights"}:  # dt = 0: nothing is forgotten either
        torch.testing.assert_close(getattr(after, name), getattr(state, name), rtol=0, atol=1e-12)


@each_rule
@torch.enable_grad()
def test_gradients_pass_by_sleepers(rule):
    rule = bound(rule())
    x = torch.rand(5, 4, dtype=torch.float64)
    x[1, 0], x[2] = math.nan, math.nan
    x.requires_grad_()
    state, total = rule.init((), ZERO), ZERO
    for k in range(5):
        total = total + (rule.combine(state, x[k]).square() if k != 2 else 0.0)
        state = rule.learn(state, x[k], ZERO + 1.0, ZERO + 0.4)
    total.backward()
    assert x.grad.isfinite().all() and (x.grad[[0, 3, 4]] != 0).all()
    assert all(p.grad.isfinite().all() for p in rule.parameters() if p.grad is not None)


@each_rule
def test_one_member_alone_has_all_the_weight(rule):
    x, y = series(20)
    said, _, state = run(bound(rule(), ["a"]), x[:, :1], y)
    if rule is not RecursiveWeights:
        np.testing.assert_allclose(said, x[:, 0])
        np.testing.assert_allclose(state.weights, [1.0])
    assert all(leaf.isfinite().all() for leaf in state)


def test_recursive_weights_keep_their_covariance_in_bounds():
    """Collinear members: what is not informed is forgotten until the limit of the trace."""
    rule = bound(RecursiveWeights(forgetting=0.9, trace_max=50.0))
    x = np.full((500, 4), 1.0)
    _, _, state = run(rule, x, np.full(500, 1.2))
    trace = rule.monitor(state)["covariance_trace"]
    assert 50 * 0.9 <= trace <= 50.0
    torch.testing.assert_close(rule.combine(state, torch.as_tensor(x[0])), ZERO + 1.2, rtol=1e-4, atol=0)


@pytest.mark.parametrize("rule", [BOA(prior={"b": 3.0}), ExponentialWeights(prior={"b": 3.0})])
def test_priors_are_the_first_weights_and_batches_have_their_own(rule):
    state = bound(rule).init((2, 3), ZERO)
    assert state.weights.shape == (2, 3, 4)
    torch.testing.assert_close(state.weights[1, 2], torch.tensor([1, 3, 1, 1], dtype=torch.float64) / 6)
    assert list(rule.monitor(state)) == [f"weight_{name}" for name in NAMES]
    x = torch.rand(2, 3, 4, dtype=torch.float64)
    one = x.new_ones(2, 3)
    after = rule.learn(state, x, one, 0.4 * one)
    alone = rule.learn(rule.init((), ZERO), x[1, 2], one[1, 2], 0.4 * one[1, 2])
    torch.testing.assert_close(after.weights[1, 2], alone.weights)


def test_share_keeps_everybody_in_play():
    x, y = series(500, "one is good")
    _, _, state = run(bound(BOA(memory=None, share=0.04)), x, y)
    torch.testing.assert_close(state.weights[1:], torch.full((3,), 0.01, dtype=torch.float64), rtol=1e-2, atol=0)


def test_sleepers_of_the_fixed_rules():
    x = torch.tensor([1.0, 2.0, math.nan, 4.0], dtype=torch.float64)
    torch.testing.assert_close(bound(Average()).combine({}, x), ZERO + 7 / 3)
    fixed = FixedWeights({"a": 0.5, "b": 0.2, "c": 0.2, "d": 0.1})
    torch.testing.assert_close(bound(fixed).combine({}, x), (ZERO + 0.5 + 0.4 + 0.4) / 0.8)
    assert fill_inactive(x, torch.zeros(4))[2] == pytest.approx(7 / 3)  # where the active ones have no weight at all
