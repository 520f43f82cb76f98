"""Certificates: what holds can be proved, what was changed is refused, and checking needs no solver and no torch."""

import hashlib
import json
import re
import subprocess
import sys
import time
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs import certificate, exact
from certify.search.box import box as box_of
from certify.search.box import certify, operating_box
from tests.support import ROOT, few


def network(n: int = 5, K: float = 0.9, seed: int = 0) -> ShallowWeights:
    rng = np.random.default_rng(seed)
    a, w1, b = rng.normal(size=(3, n))
    a *= K / float(exact.conditions(a, w1)["exact"].rate)
    return ShallowWeights(a, w1, rng.normal(size=(n, 2)), b)


def small(n: int = 5) -> ShallowWeights:
    """One that holds every condition."""
    net = network(n)
    return net._replace(a=net.a / np.abs(net.a).max() * 0.1 / (n + 1), w1=net.w1 / np.abs(net.w1).max() * 0.8)


def boxed() -> tuple[ShallowWeights, dict]:
    """A network that only the box certifies, by a tree of several boxes, and that leaves the box."""
    box = operating_box(2)
    for seed in range(50):
        weights = network(12, 1.4, seed)
        result = certify(weights, box)
        if result.verdict == "certified" and len(result.tree) > 3 and result.invariant == "no":
            return weights, certificate.make(weights, "box", 1, box, result.tree, result.invariance_tree, "net.npz")
    raise AssertionError("no such network was drawn")


@pytest.mark.parametrize("condition", certificate.CLOSED_FORMS)
def test_what_holds_is_proved(condition):
    weights = small()
    cert = json.loads(json.dumps(certificate.make(weights, condition, path="net.npz")))
    assert certificate.verify(cert, weights) == (True, cert["claim"])
    assert Fraction(cert["rate"]) > exact.conditions(weights.a, weights.w1)[condition].rate
    assert cert["margin"] == pytest.approx(float(exact.conditions(weights.a, weights.w1)[condition].margin))
    assert set(cert["proof"]) == {"metric", "multipliers"} and cert["path"] == "net.npz"


@pytest.mark.parametrize("condition", certificate.CLOSED_FORMS)
def test_what_does_not_hold_gets_no_certificate(condition):
    assert certificate.make(network(K=1.01), condition) is None
    one, zero = np.ones(1), np.zeros(1)
    assert certificate.make(ShallowWeights(one, one, np.zeros((1, 2)), zero), condition) is None  # the identity


def test_box_and_interval():
    weights, cert = boxed()
    assert certificate.verify(cert, weights).valid and "for as long as x stays in it" in cert["claim"]
    assert certificate.make(weights, "exact") is None
    assert certificate.make(weights, "interval", 1, operating_box(2)) is None
    off = weights._replace(b=np.full(12, -50.0))
    cert = certificate.make(off, "interval", 1, operating_box(2), invariance_tree=".")
    assert certificate.verify(cert, off).valid and "maps into itself" in cert["claim"]
    with pytest.raises(CertifyError, match="no box"):
        certificate.make(weights, "interval")


def resigned(cert: dict) -> dict:
    """With the checksum that belongs to what it says now: only the mathematics can refuse it."""
    cert = {key: value for key, value in cert.items() if key != "sha256"}
    text = json.dumps(cert, sort_keys=True)
    return {**cert, "sha256": hashlib.sha256(text.encode()).hexdigest()}


TAMPERED = {
    "λ of one neuron": lambda c: c["proof"]["multipliers"].__setitem__(0, "1/1000000000"),
    "a negative λ": lambda c: c["proof"]["multipliers"].__setitem__(0, "-1"),
    "one λ too few": lambda c: c["proof"]["multipliers"].pop(),
    "p": lambda c: c["proof"].__setitem__("metric", "2"),
    "no number": lambda c: c["proof"].__setitem__("metric", "one"),
    "a number too long to work out": lambda c: c["proof"].__setitem__("metric", "1e999999999"),
    "a float": lambda c: c["proof"].__setitem__("metric", 1.0),
    "a division by zero": lambda c: c["proof"].__setitem__("metric", "1/0"),
    "a faster rate": lambda c: c.__setitem__("rate", "1/2"),
    "rate and claim": lambda c: c.update(rate="1/2", contraction_rate="1/2"),
    "a rate above 1": lambda c: c.update(rate="2", contraction_rate="2"),
    "a rate of 0": lambda c: c.update(rate="0", contraction_rate="0"),
    "the margin": lambda c: c.__setitem__("margin", 0.99),
    "the claim": lambda c: c.__setitem__("claim", c["claim"].replace("≤ 0.9", "≤ 0.1")),
    "the condition": lambda c: c.__setitem__("condition", "lmi"),
    "a box's proof": lambda c: c.update(
        condition="exact, by a box", proof={"box": [["0", "1"]] * 3, "tree": ".", "invariance_tree": None}
    ),
    "an unknown condition": lambda c: c.__setitem__("condition", "magic"),
    "the weights": lambda c: c.__setitem__("weights", "0" * 64),
    "the format": lambda c: c.__setitem__("format", "usvlearn certificate 1"),
    "no proof": lambda c: c.pop("proof"),
    "the neurons": lambda c: c.__setitem__("neurons", 4),
    "the neurons as a float": lambda c: c.__setitem__("neurons", float(c["neurons"])),
    "the inputs as a bool": lambda c: c.__setitem__("inputs", c["inputs"] == 2),
    "an unknown key": lambda c: c.__setitem__("note", "proved by hand"),
    "an unknown key of the proof": lambda c: c["proof"].__setitem__("note", ""),
    "no path": lambda c: c.pop("path"),
    "a path that is no text": lambda c: c.__setitem__("path", ["net.npz"]),
    "versions of another kind": lambda c: c.__setitem__("versions", {"numpy": 2}),
}


@pytest.mark.parametrize("name", TAMPERED)
def test_a_tampered_certificate_is_refused(name):
    weights = network()
    cert = certificate.make(weights)
    text = json.dumps(cert)
    TAMPERED[name](cert)
    assert json.dumps(cert) != text
    assert not certificate.verify(cert, weights).valid
    assert not certificate.verify(resigned(cert), weights).valid


def test_other_weights_are_refused():
    weights = network()
    cert = certificate.make(weights)
    for k, name in enumerate(ShallowWeights._fields):
        changed = weights[k].copy()
        changed.flat[0] = np.nextafter(changed.flat[0], np.inf)
        check = certificate.verify(cert, weights._replace(**{name: changed}))
        assert not check.valid and "other weights" in check.reason
    assert not certificate.verify(cert, weights._replace(a=[np.nan] * 5)).valid


def claim_of(proof: dict) -> str:
    ends = ", ".join(f"[{Decimal(float(Fraction(lo)))}, {Decimal(float(Fraction(hi)))}]" for lo, hi in proof["box"])
    where = "for as long as x stays in it" if proof["invariance_tree"] is None else "which f maps into itself"
    return f"for (x, u) in {ends}, {where}"


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p.__setitem__("tree", "."),
        lambda p: p.__setitem__("tree", p["tree"][:-1]),
        lambda p: p.__setitem__("tree", ""),
        lambda p: p.__setitem__("box", [["0", "1000"], *p["box"][1:]]),
        lambda p: p.__setitem__("box", p["box"][:-1]),
        lambda p: p.__setitem__("box", [["1", "0"], *p["box"][1:]]),
        lambda p: p.__setitem__("box", [["1/4", "1/4"], *p["box"][1:]]),
        lambda p: p.__setitem__("box", [*p["box"], ["0", "0"]]),
        lambda p: p.__setitem__("invariance_tree", "."),
    ],
)
def test_a_tampered_tree_is_refused(change):
    weights, cert = boxed()
    change(cert["proof"])
    cert["claim"] = re.sub(r"for \(x, u\).*", claim_of(cert["proof"]), cert["claim"])
    assert not certificate.verify(resigned(cert), weights).valid


def test_what_is_claimed_is_never_below_what_is_proved():
    """Every decimal of a claim lies on the side on which the claim is true, whatever the number of digits."""
    one = ShallowWeights([1.0], [1.0], [[0.0]], [0.0])
    for short in (Fraction(1, 3), Fraction(1, 10**28), Fraction(1, 10**29 + 7), Fraction(1, 2**300)):
        slope = 1 - short
        weights = one._replace(a=[0.25])
        cert = certificate.make(weights, "exact", slope)
        claimed = Fraction(re.search(r"≤ ([0-9.]+) ", cert["claim"])[1])
        assert slope <= claimed < 1
    rng = np.random.default_rng(0)
    for _ in range(200):
        weights = one._replace(a=rng.uniform(0, 0.9, 1), w1=rng.uniform(0, 1, 1))
        cert = certificate.make(weights)
        margin = exact.conditions(weights.a, weights.w1)["exact"].margin
        assert cert["margin"] <= margin and np.nextafter(cert["margin"], 1) > margin
    box = box_of([(0.1, 0.7), (-1 / 3, 1e-9), (0, 1)], 2)
    claim = certificate.make(network(K=0.5), "interval", 1, box)["claim"]
    stated = [Fraction(x) for x in re.findall(r"[-+0-9.Ee]+(?=[,\]])", claim)]
    assert stated == [Fraction(float(end)) for pair in zip(box.lo, box.hi, strict=True) for end in pair]


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.__setitem__("format", "x" * 10**6),
        lambda c: c.__setitem__("condition", ["x"] * 10**5),
        lambda c: c.__setitem__("x" * 10**6, 1),
        lambda c: c.__setitem__("rate", "9" * 1400),
        lambda c: c.__setitem__("rate", "x" * 10**6),
        lambda c: c["proof"].__setitem__("metric", "1" * 10**6),
        lambda c: c["proof"].__setitem__("multipliers", [f"{3**2000}/{7**1000 + k}" for k in range(5)]),
        lambda c: c["proof"].__setitem__("multipliers", ["1"] * 300_000),
        lambda c: c["proof"].__setitem__("multipliers", [["1"] * 1000] * 100),
    ],
)
def test_a_refusal_is_short_and_soon(change):
    weights = network()
    cert = certificate.make(weights)
    change(cert)
    started = time.process_time()
    check = certificate.verify(resigned(cert), weights)
    assert not check.valid and len(check.reason) < 250 and time.process_time() - started < 2


def test_files_are_whole_and_bad_ones_are_named(tmp_path):
    cert = certificate.make(network())
    path = certificate.write(tmp_path / "proofs/net.json", cert)
    assert certificate.read(path) == cert and list(path.parent.iterdir()) == [path]
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "text.json").write_text("hello")
    text = path.read_text()
    (tmp_path / "twice.json").write_text(text.replace("{", '{"neurons": 7,', 1))
    (tmp_path / "nan.json").write_text(re.sub(r'"margin": [^,]*', '"margin": NaN', text))
    (tmp_path / "deep.json").write_text("[" * 200_000)
    (tmp_path / "objects.json").write_text('{"a":' * 100_000)
    (tmp_path / "digits.json").write_text(re.sub(r'"neurons": ', '"neurons": ' + "9" * 500_000, text))
    (tmp_path / "long.json").write_text(" " * (certificate.LARGEST + 1))
    (tmp_path / "keys.json").write_text("{" + ",".join(f'"{k}":1' for k in [*range(100_000), 5]) + "}")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe")
    names = ("list", "text", "none", "twice", "nan", "deep", "objects", "digits", "long", "keys", "bytes")
    for name in (f"{name}.json" for name in names):
        started = time.process_time()
        with pytest.raises(CertifyError, match=name.replace(".", r"\.")) as error:
            certificate.read(tmp_path / name)
        assert len(str(error.value)) < 250 + len(str(tmp_path)) and time.process_time() - started < 2
    huge = re.sub(r'"margin": [^,]*', '"margin": 1e999999', text)
    (tmp_path / "huge.json").write_text(huge)
    assert not certificate.verify(resigned(certificate.read(tmp_path / "huge.json")), network()).valid


def test_verification_needs_no_solver_and_no_torch(tmp_path):
    weights, cert = boxed()
    np.savez(tmp_path / "net.npz", **weights._asdict())
    certificate.write(tmp_path / "box.json", {**cert})
    certificate.write(tmp_path / "exact.json", certificate.make(network()))
    np.savez(tmp_path / "other.npz", **network()._asdict())
    code = (
        "import sys\n"
        "from certify.__main__ import main\n"
        f"rc = main([{str(tmp_path / 'net.npz')!r}, {str(tmp_path / 'other.npz')!r}, '--verify',"
        f" {str(tmp_path / 'box.json')!r}, {str(tmp_path / 'exact.json')!r}])\n"
        "heavy = [name for name in ('torch', 'scipy', 'cvxpy', 'matplotlib', 'usvlearn') if name in sys.modules]\n"
        "sys.exit(f'{rc} {heavy}' if rc or heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(": valid: ") == 2


@pytest.mark.parametrize("condition", few(certificate.CLOSED_FORMS, {"simple", "exact"}, "thorough"))
def test_large_networks_and_dead_neurons_have_short_proofs(condition):
    rng = np.random.default_rng(0)
    w1 = rng.uniform(-0.9, 0.9, 500)
    a = rng.normal(size=500) / 500**2 / 4
    a[::7], w1[::5] = 0.0, 0.0
    weights = ShallowWeights(a, w1, np.zeros((500, 1)), np.zeros(500))
    cert = certificate.make(weights, condition)
    assert certificate.verify(cert, weights).valid
    assert max(map(len, cert["proof"]["multipliers"])) < 200 and len(cert["proof"]["metric"]) < 200


def test_a_tree_with_splits_is_no_interval_certificate():
    """The condition that a certificate names is the one that it proves."""
    weights, cert = boxed()
    forged = {**cert, "condition": "interval"}
    assert not certificate.verify(resigned(forged), weights).valid


def test_every_certificate_says_contracting():
    weights = network(K=0.25)
    interval = certificate.make(weights, "interval", box=operating_box(2))
    assert Fraction(interval["rate"]) < Fraction(1, 3)
    close = weights._replace(a=weights.a * ((1 - 1e-9) / 0.25))
    cert = certificate.make(close)
    assert Fraction(cert["rate"]) < 1 and "≤ 1 |" not in cert["claim"]
    assert "< 1 |" in certificate.make(weights, "box", 1, operating_box(2))["claim"]
    assert certificate.make(weights, "exact", 0.9) is not None  # a float is a rate, too
    for rate in (0, 2, float("nan")):
        with pytest.raises(CertifyError, match="rate"):
            certificate.make(weights, rate=rate)


@pytest.mark.parametrize("condition", certificate.CLOSED_FORMS)
@pytest.mark.parametrize("n", [4000, 20_000])
def test_weights_with_many_digits_do_not_make_a_check_long(condition, n):
    """The claims, which come from the weights, took 7 s with 2000 neurons, growing with their square."""
    rng = np.random.default_rng(0)
    small = rng.normal(size=n) * 1e-150
    weights = ShallowWeights(rng.normal(size=n) * 1e-6, small, np.zeros((n, 1)), np.zeros(n))
    content = certificate.make(
        ShallowWeights([0.1, -0.1], [0.3, 0.2], [[0.0], [0.0]], [0.0, 0.0]), condition, rate=Fraction(1, 2)
    ) or certificate.make(ShallowWeights([0.1, -0.1], [0.3, 0.2], [[0.0], [0.0]], [0.0, 0.0]), "exact")
    content |= {"condition": condition, "neurons": n, "inputs": 1, "weights": certificate.digest(weights)}
    content["sha256"] = certificate._checksum(content)
    began = time.process_time()
    check = certificate.verify(content, weights)
    assert not check.valid and time.process_time() - began < 5
    assert ("about 5 s" in check.reason) == (n > certificate.MOST_ROWS or condition == "gershgorin")


def test_a_tree_of_cells_of_earlier_versions_is_refused_in_one_sentence():
    weights, cert = boxed()
    parts = {**cert["proof"], "tree": "z0 . z1 . e0:1,1:1"}
    claims = certificate._claims(weights, "box", Fraction(1), parts)
    assert (
        "proved any more: make it again" in certificate.verify(certificate.described(claims, parts, ""), weights).reason
    )
