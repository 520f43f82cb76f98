"""Experience replay of the RNN: what is kept, what is learned again, and that its weights stay contracting."""

import math
from collections import deque
from fractions import Fraction

import numpy as np
import pytest
import torch
from torch.func import grad

from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.proofs.box_planes import Box, interval_rate
from tests.support import at, few, random_samples
from tests.support.kernel_cases import CONDITIONS, difference, mission
from tests.support.recurrent import loss
from usvlearn import RNN, rollout
from usvlearn.core.samples import masks, named_leaves, tree_map
from usvlearn.estimators.rnn.layer import clipped, network_inputs
from usvlearn.estimators.rnn.state import STRIDE, TURN


def plain_samples(samples, predictions, surge_max: float) -> list[list[float]]:
    """What is learned from, in order: u, the speed departed from, the speed learned, whether the step before led there.

    `predictions` are those of a network that learned from these samples, which a step without a speed departs from.
    """
    use, rows, surge, unbroken = masks(samples), [], 0.0, False
    for k in range(len(samples.surge)):
        x = at(samples.inputs, k)
        if use.starts[k]:
            surge, unbroken = float(samples.surge[k]), False
        elif use.learns[k]:
            angle, target = float(x.heading), float(samples.surge[k])
            u = [
                0.5 + 0.5 * math.sin(angle),
                0.5 + 0.5 * math.cos(angle),
                float(x.command_left),
                float(x.command_right),
            ]
            rows.append([*u, surge, target, float(unbroken)])
            surge, unbroken = target, True
        elif use.steps[k]:
            surge, unbroken = min(max(float(predictions[k]), -2 * surge_max), 2 * surge_max), False
    return rows


@pytest.mark.parametrize("backend", ["kernel", "torch"])
@pytest.mark.parametrize("steps", [20, 50, 300])
def test_the_last_samples_are_kept_in_a_ring(steps, backend):
    """Against a deque of plain Python, before and after the ring is full; nothing that is missing enters it."""
    rnn, samples, size = RNN(6, 2.0, replay_size=37, replay_steps=3), mission(steps, seed=3), 37
    end, predictions, _ = rollout(rnn, rnn.init(), samples, backend=backend)
    every = plain_samples(samples, predictions, 2.0)
    last, count = deque(every, maxlen=size), len(every)
    assert count < steps or steps == 20
    assert (count > 2 * size) == (steps == 300)
    assert end.replay.learned == (count if count < 2 * size else size + count % size)
    assert end.replay.turn == 3 * count * STRIDE % TURN
    first = count % size if count > size else 0  # the place of the oldest
    ring = end.replay.samples.roll(-first, 0)[: len(last)]
    torch.testing.assert_close(ring, torch.tensor(list(last), dtype=torch.float64), rtol=1e-12, atol=1e-12)
    assert (end.replay.samples[count:] == 0).all()


@pytest.mark.parametrize("unroll", [1, 2])
@pytest.mark.parametrize("steps", [9, 30])
def test_a_step_learns_the_new_sample_and_then_the_mean_of_some_kept_ones(unroll, steps):
    """Adam is written down once more, gradients are autograd's, and places are computed in fractions."""
    size, again, c, rate = 12, 5, 0.1, 0.01
    rnn = RNN(5, 2.0, "random", rate=rate, rate_ratio=(1,) * 5, decay=None, clip=c, stability="none", unroll=unroll,
              replay_size=size, replay_steps=again)  # fmt: skip
    samples, zero = random_samples(steps + 1), torch.zeros((), dtype=torch.float64)
    state = rollout(rnn, rnn.init(), tree_map(lambda x: x[:steps], samples))[0]
    inputs, target = at(samples.inputs, steps), samples.surge[steps]
    new = [*network_inputs(inputs).tolist(), float(state.surge), float(target), 1.0]
    speeds = [0.0, *samples.surge.tolist()]
    u = network_inputs(samples.inputs)
    memory = [[*u[k].tolist(), speeds[k], speeds[k + 1], float(k > 0)] for k in range(steps)] + [new]
    places = {k % size: k for k in range(max(0, steps + 1 - size), steps + 1)}  # place -> the sample that lies there
    theta = torch.cat([state.weights.a, state.weights.w1, state.weights.W2.flatten(), state.weights.b]).detach()
    v, updates = state.moment2.detach(), int(state.updates)

    def gradient(k: int) -> torch.Tensor:
        row = torch.tensor(memory[k], dtype=torch.float64)
        known = unroll == 2 and memory[k][6] > 0 and (k - 1 in places.values() or k == steps)
        before = torch.tensor(memory[max(k - 1, 0)], dtype=torch.float64)
        a, w1, W2, b = theta.split((5, 5, 20, 5))
        weights = ShallowWeights(a, w1, W2.reshape(5, 4), b)
        h = rnn.scale
        slopes = grad(loss)(weights, h * row[4], row[:4], h * row[5], zero, h * before[4], before[:4], known)
        return clipped(torch.cat([slopes.a, slopes.w1, slopes.W2.flatten(), slopes.b]), c)

    turn = Fraction(again * steps * STRIDE % TURN, TURN)
    chosen = []
    for _ in range(again):
        chosen.append(places[math.floor(turn * len(places))])
        turn = (turn + Fraction(STRIDE, TURN)) % 1
    assert len(set(chosen)) == again
    for group in ([steps], chosen):
        g = sum(gradient(k) for k in group) / len(group)
        v, updates = 0.999 * v + 0.001 * g * g, updates + 1
        theta = theta - rate * g / ((v / (1 - 0.999**updates)).sqrt() + 1e-8)
    end = rnn.update(state, inputs, target)
    result = torch.cat([end.weights.a, end.weights.w1, end.weights.W2.flatten(), end.weights.b])
    torch.testing.assert_close(result, theta, rtol=1e-10, atol=1e-12)
    assert end.updates == updates and end.surge == target


def test_all_kept_samples_are_learned_again_equally_often():
    """Over 2²⁰ turns of a full ring each place has its share, and successive places are far apart."""
    size = 1000
    places = np.arange(TURN, dtype=np.int64) * STRIDE % TURN * size // TURN
    counts = np.bincount(places, minlength=size)
    assert counts.min() >= TURN // size and counts.max() <= TURN // size + 1
    few = np.sort(places[:16])
    assert np.diff(few).min() > size / 16 / 2 and np.diff(few).max() < 2 * size / 16


def test_without_replay_nothing_is_new():
    """The leaves and the steps of before."""
    rnn, state = RNN(6, replay_steps=3), RNN(6).init()
    names = ["weights.a", "weights.w1", "weights.W2", "weights.b", "moment1", "moment2", "updates", "surge",
             "surge_before", "inputs_before", "dt", "unbroken"]  # fmt: skip
    assert [name for name, _ in named_leaves(state)] == names and rnn.description()["replay_size"] == 0
    found, expected = (rollout(each, each.init(), mission(100))[0] for each in (rnn, RNN(6)))
    assert difference(found, expected) == 0


HELD = [("interval", True), ("interval", False), *((each, True) for each in CONDITIONS if each != "interval")]


@pytest.mark.parametrize(("condition", "replay"), few(HELD, HELD[:1], "thorough"))
def test_projection_holds_exactly_after_every_step(condition, replay):
    """20 batch elements with rates up to 1, outliers and missing samples: no checkpoint beyond the rate, exactly."""
    rates = torch.logspace(-4, 0, 20, dtype=torch.float64)
    options = {"unroll": 2, "replay_size": 30, "replay_steps": 4} if replay else {}
    rnn = RNN(condition=condition, rate=rates, decay=None, **options)
    samples, generator = random_samples(60, 20), torch.Generator().manual_seed(0)
    wild = torch.rand(samples.surge.shape, generator=generator, dtype=torch.float64)
    surge = torch.where(wild < 0.05, 90 * (wild - 0.025).sign(), samples.surge)
    surge = torch.where(wild > 0.95, torch.nan, surge)
    _, _, weights = rollout(rnn, rnn.init((20,)), samples._replace(surge=surge), record=lambda s: s.weights)
    a, w1, W2, b = (w.flatten(0, 1).numpy() for w in weights)
    if condition == "interval":
        box = Box(*rnn.bounds.numpy())
        largest = [interval_rate(ShallowWeights(*each), box) for each in zip(a, w1, W2, b, strict=True)]
    else:
        largest = [exact.conditions(*pair)[condition].rate for pair in zip(a, w1, strict=True)]
    assert len(largest) == 1200 and all(rate is not None and rate <= Fraction(0.999) for rate in largest)
    assert max(largest) > 0.9
