"""What a checkpoint says of its estimator is checked, whole, before the kernels are handed it."""

import copy
import json
import re
import subprocess
import sys

import numpy as np
import pytest
import torch

from tests.support import ESTIMATORS, FAMILIES, few
from tests.support.kernel_cases import LONG, VARIANTS, mission
from usvlearn import (
    AID,
    ARX,
    BOA,
    RLS,
    RNN,
    Average,
    Ensemble,
    Inputs,
    JointEKF,
    Online,
    Persistence,
    RecursiveWeights,
    Robust,
    Sample,
    SIFtRLS,
    SurgeDynamics,
    rollout,
)
from usvlearn.core import checkpoint
from usvlearn.core.family import defaults
from usvlearn.core.protocol import spec_of
from usvlearn.core.samples import named_leaves, rebuild, tree_map
from usvlearn.engine import select_element
from usvlearn.engine.parts import KINDS
from usvlearn.engine.program import Program
from usvlearn.engine.validate import check
from usvlearn.errors import CheckpointError
from usvlearn.runs.resuming import from_checkpoints

SAMPLE = Sample(Inputs(0.5, 0.4, 1.0, 0.1, 0.4), 1.0, True, True)
OPEN = """
import sys
from pathlib import Path
from usvlearn import Inputs, Online, Sample
from usvlearn.errors import CheckpointError
for path in sorted(Path(sys.argv[1]).glob("*.safetensors")):
    try:
        boat = Online.open(path)
        for _ in range(3):
            boat.step(Sample(Inputs(0.5, 0.4, 1.0, 0.1, 0.4), 1.0, True, True))
        print(path.stem, "opened", flush=True)
    except CheckpointError as error:
        print(path.stem, error, flush=True)
"""


def members() -> dict:
    rls = RLS(SurgeDynamics(28.0))
    return {"aid": AID(28.0), "rnn": RNN(6, replay_size=7, replay_steps=3), "rls": rls, "robust": Robust(SIFtRLS())}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """The leaves and facts of a checkpoint that has learned a little."""
    rules = {"average": Average(["aid", "rnn"]), "boa": BOA(), "weighted": RecursiveWeights()}
    boat = Online(Ensemble(members(), rules), backend="torch")
    for _ in range(3):
        boat.step(SAMPLE)
    return checkpoint.load(boat.save(tmp_path_factory.mktemp("set") / "a.safetensors", boat="heron"))


REMOVED = object()


def put(facts, entry: str, value) -> None:
    """Change what stands at a place of the description."""
    holder, *path, last = facts, "kernel", *(entry.split("/") if entry else [])
    for key in path:
        holder = holder[int(key) if isinstance(holder, list) else key]
    if value is REMOVED:
        del holder[last]
    else:
        holder[int(last) if isinstance(holder, list) else last] = value


NINE = [1.0] * 9
FORGED = {  # case: a place in the description, what is put there, and what the error must say
    "index": ("rules/average/columns/0", 10**9, r"rules.average.columns\[0\]: found 1000000000, expected 0 … 3:"),
    "negative_index": ("rules/average/columns/0", -(10**6), r"columns\[0\]: found -1000000, expected 0 … 3"),
    "index_twice": ("rules/average/columns", [0, 0], r"columns: found \[0, 0\], expected each once"),
    "no_index": ("rules/average/columns", [], r"columns: found \[\], expected 1 … 4 of them"),
    "fraction": ("rules/average/columns/0", 0.5, r"columns\[0\]: found 0.5, expected a whole number"),
    "truth": ("rules/average/columns/0", True, r"columns\[0\]: found True, expected a whole number"),
    "short": ("members/aid/vectors/spread", [1.0] * 5, r"vectors.spread: found the shape \(5,\), expected .*\(9,\)"),
    "long": ("members/aid/vectors/theta0", [1.0] * 10, r"theta0: found the shape \(10,\), expected .*\(9,\)"),
    "one": ("members/aid/vectors/theta0", [1.0], r"theta0: found the shape \(1,\), expected .*\(9,\)"),
    "ratio": ("members/rnn/vectors/rate_ratio", NINE, r"rnn.vectors.rate_ratio: found the shape \(9,\), .*\(42,\)"),
    "ragged": ("members/aid/vectors/spread", [NINE, [1.0]], r"spread: found .* expected a number, or lists of numbers"),
    "empty": ("", {}, "kernel: found no 'kind'"),
    "list": ("", [], r"kernel: found \[\], expected a dictionary"),
    "size": ("members/aid/size", 10**9, "members.aid.size: found 1000000000, expected 9"),
    "neurons": ("members/rnn/size", 10**9, "members.rnn.size: found 1000000000, expected 1 … 100000"),
    "many_neurons": ("members/rnn/size", 99_999, "kernel: found 28.* numbers in all, expected 1048576 at most"),
    "more_neurons": ("members/rnn/size", 7, r"members.rnn.weights.a: found the shape \(6,\), expected \(7,\)"),
    "no_neurons": ("members/rnn/size", 0, "members.rnn.size: found 0, expected 1 … "),
    "kind": ("members/aid/kind", "quantum", "members.aid.kind: found 'quantum', expected one of 'rls', 'sift', 'aid'"),
    "no_kind": ("members/aid/kind", [], r"members.aid.kind: found \[\], expected the kind"),
    "nested": ("members/aid/kind", "ensemble", "members.aid.kind: found 'ensemble', expected one of"),
    "twice": ("members/robust/inner/kind", "robust", "inner.kind: found 'robust', expected one of"),
    "terms": ("members/aid/terms", ["dynamics"] * 2, r"terms: found \['dynamics', 'dynamics'\], expected one of"),
    "condition": ("members/rnn/condition", 3, "condition: found 3, expected one of 'none', 'simple'"),
    "unroll": ("members/rnn/unroll", True, "unroll: found True, expected one of 1, 2"),
    "feedback": ("members/aid/feedback", [], r"feedback: found \[\], expected one of 'measured'"),
    "word": ("members/aid/numbers/gain", "1.0", "numbers.gain: found '1.0', expected a number"),
    "nothing": ("members/aid/numbers/gain", None, "numbers.gain: found None, expected a number"),
    "nan": ("members/aid/numbers/gain", float("nan"), r"numbers.gain: found nan, expected 1e-30 … 1e\+30"),
    "zero": ("members/aid/numbers/scale", 0.0, "numbers.scale: found 0.0, expected 1e-12"),
    "infinite": ("members/rnn/numbers/rate", float("inf"), "numbers.rate: found inf, expected 1e-30"),
    "forgetting": ("members/rls/numbers/forgetting", 1.5, "forgetting: found 1.5, expected 1e-30 … 1:"),
    "batch": ("members/aid/numbers/gain", [1.0, 2.0], r"gain: found the shape \(2,\), expected .* against \(\)"),
    "missing": ("members/aid/numbers/gain", REMOVED, "members.aid.numbers: found no 'gain'"),
    "more": ("members/aid/numbers/gains", 1.0, "members.aid.numbers: found 'gains', expected scale, surge_max, gain"),
    "name": ("members/a b", {}, "kernel.members: found 'a b', expected names of letters, digits and _"),
    "long_name": ("members/" + "x" * 5000, {}, "kernel.members.x{300}"),
    "output": ("output", "best", "kernel.output: found 'best', expected one of 'average', 'boa'"),
    "columns": ("columns", ["aid"], r"kernel.columns: found \['aid'\], expected the names of the members"),
    "monitors": ("monitors/calm", REMOVED, "kernel.monitors: found no 'calm'"),
    "rule": ("rules/average/vector", [1.0, 1.0], "rules.average: found 'vector', expected kind, columns, numbers"),
    "dotted_rule": ("rules/a.b", {}, "kernel.rules: found 'a.b', expected names without a dot"),
    "prior": ("rules/boa/vector/0", 0.0, r"rules.boa.vector\[0:\]: found 0.0, expected 1e-30 … 1"),
    "priors": ("rules/boa/vector", [0.2] * 5, r"rules.boa.vector: found .*, expected 8 of them"),
    "no_rules": ("rules", {}, "kernel.rules: found {}, expected at least one"),
    "given": ("accommodation", {"members": [0], "numbers": {}}, r"members\[0\]: found 0, expected the column of a"),
    "given_beyond": ("accommodation", {"members": [9], "numbers": {}}, r"accommodation.members\[0\]: found 9"),
    "given_nobody": ("accommodation", {"members": [], "numbers": {}}, r"accommodation.members: found \[\]"),
    "longer": ("members/rnn/replay_size", 70_000, "state.members.rnn.replay.samples: found the shape"),
    "no_replay": ("members/rnn/replay_size", 0, "replay.learned: found a leaf that the estimator does not have"),
    "endless": ("members/rnn/replay_steps", 10**9, "members.rnn.replay_steps: found 1000000000, expected 1 … "),
    "no_members": ("members", {}, "kernel.members: found {}, expected at least one"),
}  # fmt: skip


@pytest.fixture(scope="module")
def told(saved, tmp_path_factory) -> dict[str, str]:
    """What opening each forged set, and stepping, says; another process does it, which such a checkpoint may kill."""
    folder = tmp_path_factory.mktemp("forged")
    leaves, facts = saved
    for case, (entry, value, _) in FORGED.items():
        forged = copy.deepcopy(facts)
        put(forged, entry, value)
        checkpoint.save(folder / f"{case}.safetensors", leaves, **forged)
    done = subprocess.run([sys.executable, "-c", OPEN, str(folder)], capture_output=True, text=True, timeout=300)
    return dict(line.split(" ", 1) for line in done.stdout.splitlines())


@pytest.mark.parametrize("case", FORGED)
def test_a_forged_description_is_refused(told, case):
    """By one sentence that begins with the file and names the entry."""
    assert re.search(rf"/{case}.safetensors: (kernel|state)", told[case]) and re.search(FORGED[case][2], told[case])
    assert len(told[case]) < 600 and told[case].endswith("Online(ESTIMATOR).restore(path), with torch")


def nan_at(leaf):
    return np.where(np.arange(leaf.size).reshape(leaf.shape) == 0, np.nan, leaf)


STATES = {  # case: a leaf, what becomes of it, and what the error must say; None: it is legal
    "shape": ("members.aid.theta", lambda x: x[:8], r"theta: found the shape \(8,\), expected \(9,\)"),
    "axes": ("members.aid.theta", lambda x: x[None], r"found the shape \(5,\)|found the shape"),
    "number": ("members.aid.theta", lambda x: x.sum(), r"theta: found the shape \(\), expected \(\*batch, 9\)"),
    "no_elements": ("members.aid.theta", lambda x: x[None][:0], "expected"),
    "half": ("members.aid.theta", np.float16, "theta: found numbers of float16, expected float64 or float32"),
    "single": ("members.aid.surge", np.float32, "surge: found numbers of float32, expected float64 or float32, the"),
    "whole": ("monitors.thrusters.alarms", np.int64, "alarms: found numbers of int64"),
    "complex": ("members.rnn.weights.a", np.complex64, "a: found numbers of complex64"),
    "flag": ("members.rnn.unbroken", np.float64, "unbroken: found numbers of float64, expected bool"),
    "no_leaf": ("halfwidths", None, "halfwidths: found no such leaf"),
    "other_leaf": ("members.aid.more", lambda x: np.ones(3), "members.aid.more: found a leaf that"),
    "sample": ("members.rnn.replay.samples", nan_at, None),
    "fewer": ("members.rnn.replay.samples", lambda x: x[:3], r"samples: found the shape \(3, 7\), expected \(7, 7"),
    "interval": ("conformal.halfwidth", nan_at, "conformal.halfwidth: found nan"),
    "published": ("halfwidths", nan_at, "halfwidths: found nan"),
    "rule": ("combiners.weighted.weights", nan_at, "weights: found nan"),
    "factor": ("combiners.weighted.factor", lambda x: 0 * x, r"factor: found 0.0, expected .* 1e-30 or more on the"),
    "monitor": ("monitors.thrusters.moments", nan_at, "moments: found nan"),
    "updates": ("members.rnn.updates", np.negative, r"updates: found -\d"),
    "asleep": ("predictions", nan_at, None),
    "diverged": ("members.rnn.weights.a", nan_at, None),
    "infinite": ("members.aid.theta", lambda x: x / 0.0, None),
    "diverging": ("members.aid.theta", lambda x: x + 1e40, None),
}  # fmt: skip


@pytest.mark.parametrize("case", STATES)
@pytest.mark.filterwarnings("ignore:divide by zero|invalid value")
def test_a_forged_state_is_refused(saved, tmp_path, case):
    name, change, expected = STATES[case]
    leaves, facts = saved
    leaves = dict(leaves)
    before = leaves.pop(name, None)
    if change is not None:
        leaves[name] = np.asarray(change(before))
    path = checkpoint.save(tmp_path / "a.safetensors", leaves, **facts)
    if expected is not None:
        with pytest.raises(CheckpointError, match=rf"a.safetensors: state\..*{expected}"):
            Online.open(path)
        return
    boat = Online.open(path)
    for _ in range(3):
        assert np.isfinite(boat.step(SAMPLE))  # the others go on
    open_ended = ("members", "pred", "halfwidths")  # intervals are infinite at first
    assert all(np.isfinite(x).all() for name, x in boat.state.items() if not name.startswith(open_ended))


def test_a_diverged_estimator_alone_is_refused(tmp_path):
    leaves, facts = checkpoint.load(Online(AID(28.0)).save(tmp_path / "a.safetensors"))
    path = checkpoint.save(tmp_path / "a.safetensors", leaves | {"theta": np.full(9, np.nan)}, **facts)
    with pytest.raises(CheckpointError, match=r"state\.theta: found nan"):
        Online.open(path)


def indexed() -> Ensemble:
    """Members that take numbers of their state for places."""
    rnn = RNN(6, replay_size=7, replay_steps=3)
    return Ensemble({"joint": JointEKF(surge_max=2.7), "arx": ARX(), "rnn": rnn, "persistence": Persistence()})


@pytest.mark.parametrize("name", ["joint.turn", "arx.turn", "rnn.replay.turn", "rnn.replay.learned"])
def test_an_index_is_legal_in_its_range_alone_on_every_way_to_a_kernel(tmp_path, name):
    """Also in a member, which may hold any other number once it has diverged."""
    boat, name = Online(indexed()), f"members.{name}"
    leaves, facts = checkpoint.load(boat.save(tmp_path / "a.safetensors"))
    for value in (-1e300, -4e6, -1.0, 1e7, 1e300, np.nan, np.inf):
        path = checkpoint.save(tmp_path / "a.safetensors", leaves | {name: np.array(value)}, **facts)
        ways = (Online.open, Online(indexed()).restore, lambda path: from_checkpoints(
            tree_map(lambda x: x[None], boat.state), [path], boat.description))  # fmt: skip
        for way in ways:
            with pytest.raises(CheckpointError, match=rf"a\.safetensors: state\.{name}: found .*, expected 0 … \d+"):
                way(path)


@pytest.mark.parametrize("value", [-1e300, -4e6, 1e300, np.nan])
def test_an_index_of_a_state_reads_nothing_beyond_an_array(value):
    """A state that a program sets is not checked: the kernels themselves keep to their arrays."""
    boat = Online(indexed(), backend="kernel")
    odd = {name: torch.full_like(x, value) if name.endswith("turn") else x for name, x in named_leaves(boat.state)}
    boat.state = rebuild(boat.state, odd)
    assert all(np.isfinite(boat.step(SAMPLE)) for _ in range(60)) and np.isfinite(boat.leaf("members.joint.mean")).all()
    assert 0 <= boat.leaf("members.joint.turn") < 4 * boat.leaf("members.joint.mean").size


@pytest.mark.thorough
@pytest.mark.parametrize("dt", [1e-60, 5e-324])
def test_a_step_whose_length_float32_cannot_hold_is_none(dt):
    boat = Online(ARX().to(torch.float32), backend="kernel")
    boat.step(SAMPLE)
    before = boat.leaf("theta")
    assert np.isnan(boat.step(SAMPLE._replace(inputs=SAMPLE.inputs._replace(dt=dt))))
    np.testing.assert_array_equal(boat.leaf("theta"), before)
    assert np.isfinite(boat.step(SAMPLE))


def test_a_folder_is_opened_at_its_newest_legal_set(tmp_path):
    boat = Online(Persistence())
    boat.save(tmp_path / "1.safetensors")
    leaves, facts = checkpoint.load(boat.save(tmp_path / "2.safetensors"))
    facts["kernel"]["size"] = -1
    checkpoint.save(tmp_path / "2.safetensors", leaves, **facts)
    with pytest.warns(UserWarning, match="kernel.size: found -1, expected 0: .*; trying the one before"):
        assert Online.open(tmp_path).step(SAMPLE) == 0.0


def test_the_name_of_the_estimator_must_be_there(tmp_path):
    leaves, facts = checkpoint.load(Online(Persistence()).save(tmp_path / "a.safetensors"))
    for name in (None, 3, ["Persistence"]):
        path = checkpoint.save(tmp_path / "a.safetensors", leaves, **facts | {"estimator": name})
        with pytest.raises(CheckpointError, match=r"estimator: found .*, expected the name of an estimator"):
            Online.open(path)


EVERY = ESTIMATORS | VARIANTS | LONG
BEYOND = {"robust_rnn_blows_up", "robust_rnn_refuses"}


OF_BOTH = [(name, dtype) for dtype in (torch.float64, torch.float32) for name in FAMILIES]
OTHERS = [(name, torch.float64) for name in sorted(EVERY.keys() - set(FAMILIES) - BEYOND)]


@pytest.mark.parametrize(("name", "dtype"), few([*OF_BOTH, *OTHERS], OF_BOTH[: len(FAMILIES)], "thorough"), ids=str)
def test_what_estimators_say_of_themselves_is_legal(name, dtype):
    """And so are their states, before and after samples with faults."""
    estimator, batch = EVERY[name]().to(dtype), (4,) if name in LONG else (2,)
    description = json.loads(json.dumps(spec_of(estimator)))
    with torch.no_grad():
        state = estimator.init(batch)
        check(description, {name: leaf.numpy() for name, leaf in named_leaves(state)})
        state = rollout(estimator, state, mission(100, *batch, dtype=dtype))[0]
        check(description, {name: leaf.numpy() for name, leaf in named_leaves(state)})
        one = {name: leaf[1].numpy() for name, leaf in named_leaves(state)}  # boat's, as a run saves it
        check(select_element(description, batch[0], 1), one)


@pytest.mark.parametrize("name", sorted(BEYOND))
def test_rates_that_overflow_are_not_legal(name):
    estimator = EVERY[name]()
    leaves = {name: leaf.detach().numpy() for name, leaf in named_leaves(estimator.init())}
    with pytest.raises(CheckpointError, match=r"numbers.rate: found .*e\+(200|308), expected 1e-30 … 1e\+30"):
        check(spec_of(estimator), leaves)


def test_numbers_that_differ_by_boat_are_opened(tmp_path):
    aid, sample = AID(28.0, gain=[0.3, 1.0, 3.0]), tree_map(lambda x: np.full(3, x), SAMPLE)
    boats, torchs = (Online(aid, (3,), backend) for backend in ("kernel", "torch"))
    for _ in range(3):
        np.testing.assert_allclose(boats.step(sample), torchs.step(sample), rtol=1e-12)
    again = Online.open(boats.save(tmp_path / "a.safetensors"))
    np.testing.assert_allclose(again.step(sample), torchs.step(sample), rtol=1e-12)


@pytest.mark.parametrize("name", ["aid_estimate", "rnn_replay", "joint"])
def test_what_is_absent_has_its_default(name):
    """As if there were no such number or choice: so checkpoints from before it open."""
    own = FAMILIES[name]().description()
    choices, numbers = (defaults(each) for each in (KINDS[own["kind"]].choices, KINDS[own["kind"]].numbers))
    full = Program(own | choices | {"numbers": own["numbers"] | numbers})
    numbers = {key: x for key, x in own["numbers"].items() if key not in numbers}
    bare = Program({key: x for key, x in own.items() if key not in choices} | {"numbers": numbers})
    assert bare.leaves == full.leaves and (bare.program == full.program).all() and (bare.numbers == full.numbers).all()


def test_whole_numbers_may_be_given_as_others(tmp_path):
    boat = Online(RNN(6, unroll=2.0), backend="torch")
    again = Online.open(boat.save(tmp_path / "a.safetensors"))
    np.testing.assert_allclose(again.step(SAMPLE), boat.step(SAMPLE), rtol=1e-12)
