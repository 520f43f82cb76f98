"""Certificates of networks with a vector state: made, verified, forged."""

import copy
import itertools
import time
from fractions import Fraction

import numpy as np
import pytest

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.networks.vector import RELU, VectorNetwork, VectorWeights, activation, check, from_tensors, of_shallow
from certify.proofs import vector_certificate as certificates
from certify.proofs import vector_exact
from certify.proofs.certificate import _checksum, described, read, write
from certify.proofs.exact import conditions, multipliers
from certify.proofs.vector_exact import Proof
from certify.search.vector_lmi import smallest_rate
from tests.support import few
from tests.support.vector_networks import forward, network


def made(condition: str, net: VectorNetwork) -> dict:
    proof = None
    if condition in ("lmi", "quadratic"):
        proof = smallest_rate(net.weights, net.activation, 2 if condition == "lmi" else 1).proof
    cert = certificates.make(net, condition, proof=proof)
    assert cert is not None
    return cert


CASES = list(
    itertools.product(("gershgorin", "lmi", "quadratic", "exact"), ("relu", "leaky:0.1", "tanh"), (False, True))
)


@pytest.mark.parametrize(("condition", "phi", "two"), few(CASES, [*CASES[::5], *CASES[3::5]], "thorough"))
def test_a_certificate_is_valid_for_its_network_alone(condition, phi, two, tmp_path):
    rng = np.random.default_rng(3)
    net = network(rng, two=two, phi=activation(phi))
    if condition == "gershgorin" and not two:
        small = 0.2 * rng.uniform(-1, 1, (4, 2))
        net = net._replace(weights=net.weights._replace(W=small))
    if condition != "exact" and condition != "quadratic" and (phi != "relu" or (two and condition == "gershgorin")):
        assert certificates.make(net, condition) is None
        return
    path = write(tmp_path / "made.json", made(condition, net))
    content = read(path)
    assert certificates.verify(content, net).valid
    other = net._replace(weights=net.weights._replace(A=net.weights.A * 1.01))
    assert not certificates.verify(content, other).valid
    assert not certificates.verify(content, net._replace(activation=activation("leaky:0.5"))).valid


def test_a_singular_scaling_is_refused():
    net = network(np.random.default_rng(0))
    with pytest.raises(CertifyError, match="singular"):
        certificates.make(net, "exact", scaling=[[Fraction(1)] * 2] * 2)
    good = made("exact", net)
    good["proof"]["scaling"] = [["1", "1"], ["1", "1"]]
    good["sha256"] = _checksum(good)
    assert not certificates.verify(good, net).valid


@pytest.mark.parametrize("condition", ["gershgorin", "quadratic", "exact"])
def test_a_changed_proof_with_a_right_checksum_is_refused_or_still_true(condition):
    """A forger may compute the checksum anew: every entry of the proof is changed in turn."""
    rng = np.random.default_rng(1)
    net = network(rng)
    net = net._replace(weights=net.weights._replace(W=0.1 * net.weights.W))
    good = made(condition, net)
    junk = ["-1", "0", "1/0", "1e9", "9" * 200, "x", None, 5, [], {}, ["1"], [["1"]], True, "¼", " 1", "1/3 "]
    for key, value in good["proof"].items():
        places = [(i, j) for i, row in enumerate(value) for j in range(len(row))] if isinstance(value, list) else [None]
        for place in [None, *places]:
            for wrong in junk:
                forged = copy.deepcopy(good)
                if place is None:
                    forged["proof"][key] = wrong
                else:
                    forged["proof"][key][place[0]][place[1]] = wrong
                forged["sha256"] = _checksum(forged)
                check = certificates.verify(forged, net)
                if check.valid:  # another multiplier, scaling or step may prove the same claim
                    assert check.reason == forged["claim"] and isinstance(wrong, str)
    for key in good:
        for wrong in junk:
            forged = {**copy.deepcopy(good), key: wrong}
            if key != "sha256":
                forged["sha256"] = _checksum(forged)
            assert key in ("path", "versions") or not certificates.verify(forged, net).valid


def test_a_smaller_rate_than_the_proved_one_is_refused():
    net = network(np.random.default_rng(2))
    good = made("exact", net)
    for rate in ("1/100", "0", "-1", "2"):
        forged = {**good, "rate": rate, "contraction_rate": rate}
        forged["sha256"] = _checksum(forged)
        assert not certificates.verify(forged, net).valid


@pytest.mark.parametrize("condition", ["exact", "quadratic"])
def test_a_check_that_would_take_long_is_refused_before(condition):
    """T with numbers as long as they may be, and thousands of neurons."""
    rng, q, n = np.random.default_rng(2), 6, 6000
    net = network(rng, q, n)
    draw = iter(int(x) for x in rng.integers(10**17, 10**18, 100))
    T = [[f"{next(draw)}1/{next(draw)}7" for _ in range(q)] for _ in range(q)]
    parts = {"norm": "inf", "scaling": T, "step": "1"}
    if condition == "quadratic":
        parts = {"metric": [[str(int(i == j)) for j in range(q)] for i in range(q)], "multipliers": [["1"] * n]}
    claims = certificates._claims(net.weights, net.activation, condition, Fraction(1), parts)
    began = time.process_time()
    check = certificates.verify(described(claims, parts, "net.npz"), net)
    assert not check.valid and "would take longer than about 5 s" in check.reason
    assert time.process_time() - began < 5
    small = network(np.random.default_rng(2), q, 40)  # with a T as long, but a smaller network
    if condition != "quadratic":
        claims = certificates._claims(small.weights, small.activation, condition, Fraction(1), parts)
        assert "longer" not in certificates.verify(described(claims, parts, "net.npz"), small).reason


def test_all_smaller_steps_are_certified():
    net = network(np.random.default_rng(4))
    cert = certificates.make(net, "exact", step=Fraction(5, 4))
    assert cert is not None and certificates.verify(cert, net).valid and "0 < η ≤ 5/4" in cert["claim"]
    K = Fraction(cert["contraction_rate"])
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(2, 200, 2)), rng.normal(size=(200, 2))
    for eta in (0.05, 0.5, 1.0, 1.25):
        y = x + eta * (forward(net, x, u) - x)
        before, after = (np.abs(each[0] - each[1]).max(-1) for each in (x, y))
        assert (after <= (1 - eta / 1.25 * (1 - float(K))) * before * (1 + 1e-12)).all()


def test_a_box_of_earlier_versions_is_refused_in_one_sentence():
    net = network(np.random.default_rng(8))
    old = {**made("exact", net), "condition": "box"}
    assert "is proved no more: make it again" in certificates.verify(old, net).reason


def test_one_state_is_a_special_case():
    """The rate of a vector state with q = 1 and R = 0 is the closed form for one state, and so are the paper's."""
    rng = np.random.default_rng(9)
    for _ in range(50):
        n = int(rng.integers(1, 8))
        a, w1 = rng.normal(size=(2, n)) * rng.uniform(0.05, 1)
        shallow = ShallowWeights(a, w1, rng.normal(size=(n, 2)), rng.normal(size=n))
        results, weights = conditions(a, w1), of_shallow(shallow)
        assert vector_exact.rate(weights, vector_exact.everywhere(weights, RELU)) == results["exact"].rate
        margin, smallest = vector_exact.gershgorin(weights)
        assert smallest == results["gershgorin"].rate and (margin > 0) == (results["gershgorin"].margin > 0)
        kappa = results["exact"].rate * Fraction(101, 100)
        proof = multipliers("exact", a, w1, kappa)
        lam = [x * kappa * kappa for x in proof.multipliers]  # there a/κ, here κ² P
        assert vector_exact.proves(weights, RELU, Proof([[Fraction(1)]], [lam]), kappa)


def test_two_layers_of_the_papers_matrix_count_twice():
    """Slopes in [0, 2] in both layers: without a skip connection a quarter of the rate is claimed, and holds."""
    rng = np.random.default_rng(12)
    net = network(rng, two=True)
    net = net._replace(weights=net.weights._replace(R=np.zeros((2, 2))))
    cert = made("lmi", net)
    assert Fraction(cert["contraction_rate"]) == Fraction(cert["rate"]) / 4
    P = np.array([[float(Fraction(x)) for x in row] for row in cert["proof"]["metric"]])
    root = np.linalg.cholesky(P).T
    for _ in range(500):
        first, second = rng.integers(0, 2, 4), rng.integers(0, 2, 3)
        J = net.weights.A @ (second[:, None] * net.weights.V) @ (first[:, None] * net.weights.W)
        size = np.linalg.norm(root @ J @ np.linalg.inv(root), 2)
        assert size <= float(Fraction(cert["contraction_rate"])) * (1 + 1e-9)


@pytest.mark.parametrize(("condition", "w"), [("gershgorin", 0.5), ("lmi", 1.0)])
def test_one_layer_of_the_papers_matrix_claims_half_its_rate_and_no_less(condition, w):
    """One state, where the slope between two points is known: any smaller claim is wrong."""
    weights = check(VectorWeights(None, [[0.45]], [[w]], np.zeros((1, 0)), [0.0]))
    net = VectorNetwork("net.npz", weights)
    kappa = Fraction(9, 10) * Fraction(w) + Fraction(1, 1000)  # 2K and a little more
    proof = smallest_rate(weights, RELU, 2).proof if condition == "lmi" else None
    cert = certificates.make(net, condition, rate=kappa, proof=proof)
    claimed = Fraction(cert["contraction_rate"])
    x = np.array([[0.0], [1.0]])
    slope = Fraction(float(np.diff(forward(net, x, np.zeros((2, 0))), axis=0)[0, 0]))
    assert slope <= claimed == kappa / 2 < slope * Fraction(101, 100)
    assert f"≤ {float(claimed):.6g} |x₁ − x₂|_P" in cert["claim"]
    skip = net._replace(weights=weights._replace(R=np.array([[0.2]]), A=np.array([[0.2]])))
    rate, proof = Fraction(9, 10), smallest_rate(skip.weights, RELU, 2).proof if condition == "lmi" else None
    with_skip = certificates.make(skip, condition, rate=rate, proof=proof)
    assert Fraction(with_skip["contraction_rate"]) == rate  # R has no slope: nothing is halved


@pytest.mark.parametrize("two", [False, True])
def test_linear_layers_of_torch_are_the_same_network(two):
    """The first layer's columns are x, then u; a bias of the last one would be an offset."""
    net = network(np.random.default_rng(14), two=two)
    weights = net.weights._replace(R=np.zeros((2, 2)))
    tensors = {"0.weight": np.concatenate([weights.W, weights.W2], 1), "0.bias": weights.b}
    tensors |= {"2.weight": weights.V, "2.bias": weights.c} if two else {}
    (same,) = from_tensors({**tensors, "4.weight": weights.A, "4.bias": np.zeros(2)})
    for given, expected in zip(same.weights, weights, strict=True):
        np.testing.assert_array_equal(given, expected)
    with pytest.raises(CertifyError, match="offset"):
        from_tensors({**tensors, "4.weight": weights.A, "4.bias": np.ones(2)})
