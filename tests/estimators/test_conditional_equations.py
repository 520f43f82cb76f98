"""Half-widths that know the manoeuvre against their equations, written out here with the numbers of the docstring."""

import math

import numpy as np
import pytest
import torch

from usvlearn.estimators.ensemble.manoeuvre_intervals import kernel, layer
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import HELD, PATH, _horizons, learned_leaves

ALPHA, OVERLAP = 0.1, 4.0


def plain(function):
    """A compiled function as Python runs it."""
    return getattr(function, "py_func", function)


def expected_error(state, spread, far):
    """s of (1)."""
    c, level = state["coefficients"], state["level"]
    return max(c[0] * level + c[1] * spread + c[2] * far, 0.4 * level, 0.001)


def share(state, k):
    """a of (3), after k errors."""
    own, before = state["scores"]
    sure = min(max((k - 100) / 200, 0), 1)
    x = 2 - 2 * math.sqrt(max(k - 10, 0)) * (before - own) / max(before, 0.005)
    return sure + (1 - sure) / (1 + math.exp(x))


def learned(state, k, e, width, spread, far, group):
    """(3) to (6) after the k-th error."""
    s, level = expected_error(state, spread, far), state["level"]
    own = max(state["factors"][group] * s, 0.005)
    scores = state["scores"].copy()
    if k > 10:
        score = np.array([2 * v + 2 / ALPHA * max(e - v, 0) for v in (own, width)])
        scores += max(1 / (k - 10), 1 / 200) * (score - scores)
    rate = 1 / (2 * (9 + OVERLAP)) + 0.05 * (np.arange(3) == group)
    factors = np.clip(state["factors"] * np.exp(rate * ((e > own) - ALPHA)), 0.1, 30)
    after = level + max(1 / k, 1 / 50) * (e - level)
    s, f = max(s, 0.4 * after), np.array([level, spread, far])
    A = 0.999 * state["gram"] + np.outer(f, f) / s**2
    b = 0.999 * state["moments"] + f * min(e, 6 * s) / s**2
    c = state["coefficients"].copy()
    for i in range(3):
        c[i] = max((b[i] - A[i] @ c + A[i, i] * c[i]) / A[i, i], 0)
    return {"coefficients": c, "gram": A, "moments": b, "level": after, "factors": factors, "scores": scores}


def samples(steps: int = 310) -> list[tuple[float, float, float, float, int]]:
    """Errors, their width, spread, far and group: with jumps of 40 times the usual size."""
    rng, rows = np.random.default_rng(5), []
    for k in range(steps):
        group = int(rng.choice(3, p=[0.7, 0.2, 0.1]))
        spread, far = float(rng.uniform(0, 0.1)), (0.0, 0.3, 1.0)[group] * float(rng.uniform(0.5, 1.0))
        e = abs(float(rng.standard_normal())) * (0.02 + 0.3 * spread + 0.2 * far) * (40 if k % 50 == 49 else 1)
        rows.append((e, 0.1 + 0.05 * float(rng.random()), spread, far, group))
    return rows


def same(found: dict, expected: dict, k: int) -> None:
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=1e-8, atol=1e-12, err_msg=f"{name} after {k} errors")


def first() -> dict:
    """A and b as if c = (1, 0, 0) had been seen ten times, with a ridge of 1."""
    return {
        "coefficients": np.array([1.0, 0, 0]), "gram": np.diag([10.0, 1, 1]), "moments": np.array([10.0, 0, 0]),
        "level": 0.0, "factors": np.full(3, 2.06), "scores": np.zeros(2),
    }  # fmt: skip


def test_the_kernel_learns_by_the_equations():
    expected, at = first(), np.array([0, 3, 12, 15, 16, 19])
    s = np.concatenate([np.ravel(each) for each in expected.values()])
    moves = plain(kernel.moves_of)(OVERLAP, ALPHA)
    for k, (e, width, *facts) in enumerate(samples(), 1):
        sure, own = share(expected, k - 1), expected_error(expected, *facts[:2])
        v = max(expected["factors"][facts[2]] * own, 0.005)
        now = kernel.halfwidth_now(s, at, 0, k - 1.0, width, *map(float, facts[:2]), facts[2])
        held = np.zeros(HELD)
        kernel.hold(s, at, 0, k - 1.0, held)
        stored = kernel.halfwidth_held(held, width, *map(float, facts[:2]), facts[2])
        assert now == pytest.approx(width ** (1 - sure) * v**sure, rel=1e-8) == stored
        kernel.learn_error(s, at, 0, float(k), e, width, *map(float, facts[:2]), facts[2], moves, ALPHA)
        expected = learned(expected, k, e, width, *facts)
        same(dict(zip(expected, np.split(s, at[1:]), strict=True)) | {"gram": s[3:12].reshape(3, 3)}, expected, k)


def test_a_mixed_width_is_a_geometric_mean_and_unknown_where_the_other_one_is():
    mix = plain(kernel.mix)
    assert mix(0.2, 0.8, 0.0) == pytest.approx(0.2) and mix(0.2, 0.8, 0.5) == pytest.approx(0.4)
    assert mix(0.2, 0.8, 1.0) == 0.8 and mix(math.inf, 0.8, 0.5) == mix(math.inf, 0.8, 1.0) == math.inf


def test_a_path_remembers_the_farthest_command_after_it_has_come_back():
    """far is that of either side, and the group that of the range of the mean command."""
    commands = [(0.5, 0.1), (0.5, 0.9), (0.2, 0.1), (0.5, 0.1), (0.5, 0.12)]
    far, low, high = [0.0, 0.8, 0.8, 0.8, 0.8], [0.3, 0.3, 0.15, 0.15, 0.15], [0.3, 0.7, 0.7, 0.7, 0.7]
    path = np.zeros(PATH)
    for k, (left, right) in enumerate(commands):
        plain(kernel.extend_path if k else kernel.begin_path)(path, left, right)
        np.testing.assert_allclose(path, [0.5, 0.1, low[k], high[k], far[k]], atol=1e-12)
    for moved, group in ((0.0, 0), (0.049, 0), (0.05, 1), (0.25, 1), (0.251, 2)):
        path[2], path[3] = 0.0, moved
        assert plain(kernel.group_of)(path) == group


def test_leaves_have_the_shapes_that_the_state_declares():
    like = torch.zeros((), dtype=torch.float64)
    for state, declared in (
        (layer.init((), 4, like), learned_leaves(4)), (layer.init_horizons((), 2, 4, like), _horizons((2, 4))),
    ):  # fmt: skip
        for name, leaf in state._asdict().items():
            if name != "learned":
                assert tuple(leaf.shape) == getattr(declared, name).shape, name
