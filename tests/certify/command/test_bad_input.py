"""Input that is wrong, or very large or small: one sentence, and the verdicts of all other networks."""

import itertools
import json
import sys
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.__main__ import main
from certify.networks.shallow import ShallowWeights
from tests.support import few
from tests.support.certify_command import told


def near_one(bits: int) -> ShallowWeights:
    """K = 1 − 2^−bits: the sum of 1 − 2⁻⁵³, 2⁻⁵³ (1 − 2⁻⁵³) …"""
    ends = [*range(0, bits, 53), bits]
    parts = [
        (max(-lo, -1000), (1 - 2.0 ** (lo - hi)) * 2.0 ** min(1000 - lo, 0)) for lo, hi in itertools.pairwise(ends)
    ]
    a, w1 = np.array([2.0**e for e, _ in parts]), np.array([w for _, w in parts])
    return ShallowWeights(a, w1, np.zeros((len(a), 4)), np.full(len(a), 0.1))


NEAR = [[], ["--box", "--seconds", "0.2"], ["--certificate", "proofs"], ["--plot", "map.png"]]


@pytest.mark.parametrize("options", few(NEAR, NEAR[:3], "thorough"))
def test_a_rate_nearer_to_one_than_any_float_is_certified(files, capsys, monkeypatch, options):
    monkeypatch.chdir(files)
    weights = near_one(1113)
    pairs = zip(weights.a.tolist(), weights.w1.tolist(), strict=True)
    assert sum(Fraction(x) * Fraction(y) for x, y in pairs) == 1 - Fraction(1, 2**1113)
    np.savez("near.npz", **weights._asdict())
    wide = {"A": np.stack([weights.a, 0 * weights.a]), "W": np.stack([weights.w1, 0 * weights.w1], -1)}
    np.savez("wide.npz", **wide, W2=weights.W2, b=weights.b)
    wide = [] if options[:1] in (["--box"], ["--plot"]) else ["wide.npz"]
    assert main(["near.npz", *wide, "good.npz", *options]) == 0
    assert "2 of 2 certified contracting by exact" in capsys.readouterr().out
    code, rows = told(capsys, "near.npz", *wide, "good.npz", *options)
    assert code == 0 and [row["time_constant"] is None for row in rows] == [True, False, *[True for _ in wide]]
    assert not options[:1] == ["--certificate"] or main(["--verify", *map(str, Path("proofs").glob("*"))]) == 0


ANY_SIZE = [["--json"], ["--lmi"], ["--steps", "--seconds", "0.2"]]
EACH_ONCE = [(1e150, ANY_SIZE[0]), (1e100, ANY_SIZE[1]), (1e150, ANY_SIZE[2]), (5e-324, ANY_SIZE[0])]


@pytest.mark.parametrize(
    ("size", "options"), few(itertools.product([1e150, 1e100, 5e-324], ANY_SIZE), EACH_ONCE, "thorough")
)
def test_weights_of_any_size_end_in_a_verdict_or_in_one_sentence(files, capsys, monkeypatch, size, options):
    monkeypatch.chdir(files)
    ones = {"A": np.ones((2, 2)), "W": np.ones((2, 2)), "W2": np.ones((2, 1)), "b": np.ones(2)}
    one = {**ones, "R": np.ones((2, 2))}
    two = {**ones, "V": np.ones((2, 2)), "c": np.ones(2)}
    shallow = near_one(60)._asdict()
    for name, network in {"one": one, "two": two, "shallow": shallow}.items():
        np.savez(f"{name}.npz", **{key: size * x for key, x in network.items()})
        code = main([f"{name}.npz", "good.npz", *options])
        output = capsys.readouterr()
        assert code in (0, 1, 2) and "good" in output.out
        assert len(output.err.split("\n")) <= 2 and bool(output.err.strip()) == (code == 2)
        assert code != 2 or output.err.strip().startswith(f"error: {name}.npz: ")


def test_a_certified_set_whose_proof_is_too_long_stops_no_other(files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    rng = np.random.default_rng(0)
    w1 = rng.uniform(1, 2, 400) * 2.0 ** -rng.integers(900, 1000, 400)
    np.savez("long.npz", a=np.zeros(400), w1=w1, W2=np.zeros((400, 1)), b=np.zeros(400))
    assert main(["long.npz", "good.npz", "--certificate", "proofs"]) == 2
    output = capsys.readouterr()
    assert "long.npz: is certified, but its proof is longer" in output.err and "1 certificates" in output.out
    assert [path.name for path in Path("proofs").iterdir()] == ["good.exact.json"]


def test_errors_that_nobody_foresaw_stop_no_other_set(files, capsys, monkeypatch):
    from certify.analysis import assess

    def fails(network, **rest):
        if "good" in network.path:
            raise OverflowError("too large")
        return known(network, **rest)

    known = assess.assess
    monkeypatch.setattr(assess, "assess", fails)
    for more in ([], ["--activation", "tanh"]):
        assert main([str(files / "good.npz"), str(files / "off.npz"), *more]) == 2
        output = capsys.readouterr()
        assert "good.npz: cannot be judged (OverflowError: too large)" in output.err and "off" in output.out
    monkeypatch.setattr("certify.__main__.find", lambda paths: 1 // 0)
    assert main([str(files / "good.npz")]) == 3
    assert "ZeroDivisionError" in capsys.readouterr().err


def test_verification_compares_no_more_than_some_thousand_sets(files, capsys, monkeypatch):
    """Told from the shapes: 250,000 checkpoints of one neuron are 8 MB."""
    monkeypatch.chdir(files)
    assert main(["good.npz", "--certificate", "proofs"]) == 0
    (proof,) = map(str, Path("proofs").iterdir())
    elements = {"a": np.full((250_000, 1), 0.6), "w1": np.ones((250_000, 1)), "b": np.zeros((250_000, 1))}
    np.savez("many.npz", **elements, W2=np.zeros((250_000, 1, 0)))
    wide = {
        "A": elements["a"][:, None],
        "W": elements["w1"][..., None],
        "b": elements["b"],
        "W2": np.zeros((250_000, 1, 0)),
    }
    np.savez("wide.npz", **wide)
    capsys.readouterr()
    for name in ("many", "wide"):
        began = time.process_time()
        assert main([f"{name}.npz", "--verify", proof]) == 2 and time.process_time() - began < 5
        assert "found 250000 checkpoints, expected at most 10000" in capsys.readouterr().err
    text = Path(proof).read_text().replace("good.npz", "many.npz")
    Path("named.json").write_text(text)
    assert main(["--verify", "named.json", proof]) == 2
    output = capsys.readouterr()
    assert "named.json: many.npz: found 250000" in output.err and f"{proof}: valid" in output.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no PATH is given"),
        (["nowhere"], "nowhere: no such file"),
        (["good.npz", "nowhere*"], "no such file"),
        (["text.npz"], "text.npz: cannot be read"),
        (["notes.txt"], "notes.txt: is no checkpoint"),
        (["nan.npz"], "nan.npz: found 1 NaN"),
        (["empty.npz"], "without neurons"),
        (["shapes.npz"], "found the shapes"),
        (["good.npz", "--box=1:0,0:1"], "lo"),
        (["good.npz", "--box=0:1"], "1 intervals, expected 2"),
        (["good.npz", "--lmi", "--solver", "NOSUCH"], "NOSUCH"),
        (["good.npz", "--input", "1,2"], "expected 1 finite numbers"),
        (["good.npz", "--input", "one"], "expected numbers"),
        (["good.npz", "--dt", "-1"], "--dt"),
        (["good.npz", "--headings", "--plot", "map.png"], "--headings"),
        (["good.npz", "--plot", ""], "--plot"),
        (["good.npz", "--plot", "run"], "--plot"),
        (["x" * 300], "File name too long"),
        ([""], "empty PATH"),
        (["good.npz", "--certificate", ""], "expected a folder"),
        (["good.npz", "--input", "-inf"], "expected 1 finite"),
        (["compare", "--seed", "-1"], "--seed"),
        (["empty", "--json"], "holds no checkpoints"),
        (["good.npz", "--plot", "map.xyz"], "map.xyz"),
        (["good.npz", "--certificate", "good.npz"], "is a file"),
        (["good.npz", "--certificate", "/dev/null/proofs"], "cannot be written"),
        (["--verify", "good.npz"], "good.npz"),
        (["--verify", "nowhere.json"], "cannot be read"),
        (["compare", "--networks", "0"], "--networks"),
        (["compare", "--sizes", "10,x"], "--sizes"),
        (["compare", "--seconds", "nan"], "--seconds"),
        (["compare", "--page", "x"], "--page"),
        (["compare", "nowhere"], "nowhere"),
        (["good.npz", "--condition", "magic"], "--condition"),
        (["good.npz", "--bx"], "--bx"),
        (["good.npz", "--certificate"], "--certificate"),
    ],
)
def test_bad_input_is_one_sentence_and_code_2(files, capsys, monkeypatch, arguments, message):
    monkeypatch.chdir(files)
    arrays = dict(np.load("good.npz"))
    np.savez("nan.npz", **{**arrays, "a": [np.nan]})
    np.savez("empty.npz", a=[], w1=[], W2=np.zeros((0, 1)), b=[])
    np.savez("shapes.npz", **{**arrays, "w1": [1.0, 2.0]})
    Path("text.npz").write_text("hello")
    Path("notes.txt").write_text("hello")
    Path("empty").mkdir()
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: ") and captured.err.count("\n") == 1
    assert message in captured.err


def test_one_bad_file_does_not_hide_the_other_verdicts(files, capsys, monkeypatch):
    monkeypatch.chdir(files)
    (files / "text.npz").write_text("hello")
    huge = {**np.load("good.npz"), "b": [1e100]}  # too large for the search on a box
    np.savez("huge.npz", **huge)
    assert main([".", "--json", "--box"]) == 2
    captured = capsys.readouterr()
    assert (
        "text.npz: cannot be read" in captured.err and "huge.npz: weights or box: found a value of size" in captured.err
    )
    assert len(json.loads(captured.out)) == 6 and captured.err.count("error: ") == 2
    assert main(["good.npz", "text.npz"]) == 2 and "1 of 1 certified" in capsys.readouterr().out
    assert main(["huge.npz", "--box"]) == 2 and capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "path", ["x" * 100_000 + ".npz", "a/" * 3000 + "a.npz", "nul\0.npz", ["good.npz"], "\ud800.npz"]
)
def test_a_path_that_no_file_can_have_stops_nobody(files, capsys, monkeypatch, path):
    monkeypatch.chdir(files)
    assert main(["good.npz", "--certificate", "proofs"]) == 0
    good = Path("proofs/good.exact.json")
    Path("bad.json").write_text(json.dumps({**json.loads(good.read_text()), "path": path}))
    capsys.readouterr()
    assert main(["--verify", "bad.json", str(good)]) == 2
    captured = capsys.readouterr()
    assert f"{good}: valid" in captured.out and "bad.json: its weights" in captured.err and len(captured.err) < 250


NEEDED = {
    "rich": ["net.npz"],
    "scipy": ["compare", "net.npz"],
    "cvxpy": ["net.npz", "--lmi", "--solver", "SCS"],
    "clarabel": ["net.npz", "--lmi"],
    "matplotlib": ["net.npz", "--plot", "map.png"],
}
IMPORTING = (
    "certify.display.tables",
    "certify.command.compare",
    "certify.training.conditions",
    "certify.training.projections",
)


@pytest.mark.parametrize("package", NEEDED)
def test_certify_names_the_package_that_is_missing(package, tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "net.npz", a=[0.5, 0.2], w1=[1.0, -1.0], W2=[[0.1], [0.2]], b=[0.0, 0.1])
    monkeypatch.chdir(tmp_path)
    loaded = [name for name in sys.modules if name.startswith((f"{package}.", *IMPORTING))]
    for name in loaded:  # what was imported before must not help
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    assert main(NEEDED[package]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and package in error and "pip install" in error
    assert len(error.splitlines()) == 1
