"""Checkpoints whose checksum is right, but not what they say of their estimator, or its state.

Whatever is changed, a checkpoint is refused by one CheckpointError, or it is legal: then it opens and steps, and its
state stays finite.
"""

import copy
import time

import accuracy
import numpy as np
import pytest

from tests.support import ESTIMATORS
from tests.support.kernel_cases import mission
from usvlearn import Inputs, Online, Sample
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError

JUNK = (
    None, True, False, 0, 1, -1, 2, 3, 10**6, 10**9, -(10**6), 2**63, 10**30, 0.5, -0.0, 1e-30, 1e30, 1e-320, 1e308,
    float("nan"), float("inf"), -float("inf"), "", "aid", "robust", "inner", "1.0", [], {}, [[]], [None], [1.0] * 3,
    [[1.0, 2.0], [3.0]], [0.5] * 1000, {"kind": "persistence", "size": 0, "numbers": {}}, {"kind": "ensemble"},
)  # fmt: skip
WORDS = ("kind", "size", "numbers", "inner", "count", "terms", "signs", "iterations", "vector", "loss", "a.b", "")

# Leaves that may be infinite or NaN: where a member is inactive, no forecast was due, or no interval is known.
OPEN = (
    "predictions", "halfwidths", "forecasts.predictions", "forecasts.halfwidths", "forecasts.widths",
    "forecasts.conditional.due",
)  # fmt: skip


@pytest.fixture(scope="module")
def sets(tmp_path_factory) -> list[tuple[dict, dict]]:
    """The leaves and the facts of a checkpoint of every estimator, and of the default ensemble, after some steps."""
    path, loaded = tmp_path_factory.mktemp("sets") / "a.safetensors", []
    for make in [*ESTIMATORS.values(), lambda: accuracy.ensemble(())]:
        boat = Online(make(), backend="torch")
        for sample in samples(8, seed=1):
            boat.step(sample)
        loaded.append(checkpoint.load(boat.save(path)))
    Online.open(path)  # compiles, which is no stall
    return loaded


def samples(steps: int, seed: int = 0) -> list[Sample]:
    """A mission as numbers, one boat's."""
    run = mission(steps, seed=seed)
    inputs = zip(*(x.tolist() for x in run.inputs), strict=True)
    return [Sample(Inputs(*x), *y) for x, *y in zip(inputs, *(y.tolist() for y in run[1:]), strict=True)]


def places(tree) -> list[tuple]:
    """Every place in a description: what holds it, and its key."""
    items = list(tree.items() if isinstance(tree, dict) else enumerate(tree))
    deeper = (places(value) for _, value in items if isinstance(value, dict | list))
    return [(tree, key) for key, _ in items] + [place for each in deeper for place in each]


def one_of(rng, values):
    return copy.deepcopy(values[rng.integers(len(values))])


def wrapped(rng, value: dict) -> dict:
    """An estimator inside a wrapper, or what stands in its place."""
    robust = dict.fromkeys(("threshold", "patience", "inflation", "share", "variance_min", "moment"), 1.0)
    return one_of(rng, [
        {"kind": "robust", "inner": value, "numbers": robust},
        {"kind": "memory", "inner": value, "numbers": {"surge_dot_max": 2.0}},
    ])  # fmt: skip


def changed(rng, value):
    """A value a little, or far, beside."""
    if isinstance(value, dict):
        return wrapped(rng, value) if rng.random() < 0.3 else value | {one_of(rng, WORDS): one_of(rng, JUNK)}
    if isinstance(value, list):
        longer = [*value, *value[:1], *value[:1]]
        return one_of(rng, [value[:-1], longer, value[::-1], longer[: rng.integers(len(longer) + 1)], [value]])
    if isinstance(value, str):
        return value[1:]
    if value is None or isinstance(value, bool):
        return one_of(rng, JUNK)
    far = value * 10.0 ** rng.uniform(-30, 30)
    return one_of(
        rng, [value * rng.uniform(0.5, 2.0), far, value + int(rng.integers(-3, 4)), -value, [value], str(value)]
    )


def mutated(rng, facts: dict, other: dict) -> dict:
    """A description with an entry or two changed; `other` is one to take parts from."""
    facts = {"kernel": copy.deepcopy(facts["kernel"])}
    for _ in range(rng.integers(1, 3)):
        every, theirs = places(facts), places(other)
        holder, key = every[rng.integers(len(every))]
        what = rng.integers(6)
        if what == 0 and holder is not facts:
            del holder[key]
        elif what == 1:
            holder[key] = one_of(rng, JUNK)
        elif what == 2:
            donor, place = theirs[rng.integers(len(theirs))]
            holder[key] = copy.deepcopy(donor[place])
        else:
            holder[key] = changed(rng, holder[key])
    return facts["kernel"]


@np.errstate(all="ignore")  # of casts
def spoiled(rng, leaves: dict) -> dict:
    """A state with a leaf or two changed."""
    leaves = dict(leaves)
    for _ in range(rng.integers(1, 3)):
        if not leaves:
            break
        name = list(leaves)[rng.integers(len(leaves))]
        leaf = leaves[name]
        what = rng.integers(7)
        if what == 0:
            del leaves[name]
        elif what == 1:
            leaves[name] = np.zeros(rng.integers(0, 4, rng.integers(0, 4)), leaf.dtype)
        elif what == 2:
            leaves[name] = leaf.real.astype(
                one_of(rng, [np.float32, np.float16, np.int64, np.int8, bool, np.complex64])
            )
        elif what == 3:
            leaves[name + one_of(rng, ["", ".x", "2"])] = one_of(rng, [leaf[None], np.stack([leaf, leaf], -1), leaf])
        elif leaf.dtype != bool and leaf.size:
            numbers = [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-300, 1e300, -1e30, 1e30, 2.0**53, 0.5]
            leaves[name] = np.where(rng.random(leaf.shape) < 0.5, one_of(rng, numbers), leaf)
    return leaves


def opened(path, run: list[Sample]) -> Online | None:
    """A checkpoint after some steps; None where it is refused."""
    try:
        boat = Online.open(path)
    except CheckpointError as error:
        assert str(error).startswith(f"{path}: ") and len(str(error)) < 2000
        return None
    for sample in run:
        assert np.shape(boat.step(sample)) == np.shape(boat.predict(sample.inputs))
    return boat


@pytest.mark.thorough
@pytest.mark.fuzz(cases=300, slow=10_000)
def test_a_changed_description_is_refused_or_legal(rng, cases, sets, tmp_path):
    """A legal one steps, at once, and its state stays finite."""
    run, counts = samples(6, seed=2), {"refused": 0, "legal": 0}
    for case in range(cases):
        leaves, facts = sets[rng.integers(len(sets))]
        kernel = mutated(rng, facts, sets[rng.integers(len(sets))][1])
        path = checkpoint.save(tmp_path / "a.safetensors", leaves, **facts | {"kernel": kernel})
        began = time.process_time()
        boat = opened(path, run)
        assert time.process_time() - began < 10, f"case {case}: {kernel}"
        for name, leaf in boat.state.items() if boat else ():
            assert name in OPEN or np.isfinite(leaf).all(), f"case {case}: {name} of {kernel}"
        counts["legal" if boat else "refused"] += 1
    print(counts)
    assert min(counts.values()) > cases / 20


@pytest.mark.fuzz(cases=200, slow=10_000)
def test_a_changed_state_is_refused_or_legal(rng, cases, sets, tmp_path):
    run, counts = samples(6, seed=2), {"refused": 0, "legal": 0}
    for _ in range(cases):
        leaves, facts = sets[rng.integers(len(sets))]
        path = checkpoint.save(tmp_path / "a.safetensors", spoiled(rng, leaves), **facts)
        counts["legal" if opened(path, run) else "refused"] += 1
    print(counts)
    assert min(counts.values()) > cases / 50
