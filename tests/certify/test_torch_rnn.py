"""torch.nn.RNN and RNNCell: read from files and modules, rates that are proved, and what is refused."""

import itertools
import json
import time
from fractions import Fraction

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

import certify
from certify.__main__ import main
from certify.errors import CertifyError
from certify.networks.vector import TANH, VectorNetwork, VectorWeights, check, read_both
from certify.proofs import recurrent, vector_certificate, vector_exact
from certify.proofs.certificate import described
from certify.proofs.exact import definiteness
from certify.search.recurrent import by_full_metric, by_spectral_norm, diagonal_scaling
from tests.support import few
from tests.support.vector_networks import spectral


def module(n: int, rate: float = 0.9, seed: int = 0, **options) -> nn.RNN:
    """W_hh = rate times a rotation, in other coordinates: no norm has a smaller rate, a quadratic one has it."""
    torch.manual_seed(seed)
    rnn = nn.RNN(2, n, **options)
    turn = torch.linalg.qr(torch.randn(n, n))[0]
    units = torch.exp2(torch.arange(n) % 5 - 2.0)
    with torch.no_grad():
        rnn.weight_hh_l0.copy_(rate * units[:, None] * turn / units)
    return rnn


def network(W: np.ndarray) -> VectorNetwork:
    n = len(W)
    return VectorNetwork("", check(VectorWeights(None, np.eye(n), W, np.ones((n, 1)), np.ones(n))), TANH)


def random(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng([n, seed]).normal(size=(n, n)) / np.sqrt(n)


def patterns(W: np.ndarray, count: int = 200) -> np.ndarray:
    """D W for D with slopes 0, 1 and between, `(count, n, n)`."""
    rng = np.random.default_rng(1)
    D = rng.choice([0.0, 1.0, 0.3], size=(count, len(W)))
    D[0] = 1.0
    return D[:, :, None] * W


# Reading


@pytest.mark.parametrize("ending", ["pt", "safetensors", "npz"])
@pytest.mark.parametrize("prefix", ["", "rnn.", "module.rnn."])
@pytest.mark.parametrize("cell", [False, True])
def test_a_state_dict_is_read_whatever_it_is_saved_in(tmp_path, ending, prefix, cell):
    net = nn.RNNCell(2, 3) if cell else nn.RNN(2, 3)
    tensors = {prefix + name: x.detach().clone() for name, x in net.state_dict().items()} | {
        "head.weight": torch.ones(1, 3)
    }
    path = tmp_path / f"net.{ending}"
    if ending == "pt":
        torch.save(tensors, path)
    elif ending == "safetensors":
        save_file(tensors, path)
    else:
        np.savez(path, **{name: x.numpy() for name, x in tensors.items()})
    shallow, (read,) = read_both(path)
    W, W2, *biases = net.parameters()
    expected = [x.detach().double().numpy() for x in (W2, W, sum(b.double() for b in biases))]
    assert shallow == [] and read.activation == TANH
    for x, y in zip((read.weights.W, read.weights.W2, read.weights.b), expected, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("made, words", [
    (nn.LSTM(2, 3), "an LSTM"), (nn.GRU(2, 3), "a GRU"), (nn.LSTMCell(2, 3), "an LSTM"), (nn.GRUCell(2, 3), "a GRU"),
    (nn.RNN(2, 3, num_layers=2), "several layers"), (nn.RNN(2, 3, bidirectional=True), "both directions"),
    (nn.LSTM(2, 3, proj_size=2), "a projection"),
    ({"weight_hh_l0": torch.eye(3)}, "weight_ih is missing"),
    ({"weight_ih": torch.ones(3, 2), "weight_hh": torch.full((3, 3), torch.nan)}, "9 NaN"),
    ({"weight_ih": torch.ones(2, 2), "weight_hh": torch.eye(3)}, "found the shapes"),
    ({"weight_ih": torch.ones(3, 2), "weight_hh": torch.eye(3), "bias_hh": torch.ones(2)}, "found the shapes"),
    ({"weight_ih": torch.ones(3, 2), "weight_hh": 1e200 * torch.eye(3, dtype=torch.float64)}, "none above 1e+150"),
    ({"weight_ih": torch.ones(1001, 1), "weight_hh": torch.eye(1001)}, "expected 1 to 1000"),
])  # fmt: skip
def test_other_modules_and_damaged_weights_are_one_sentence(tmp_path, capsys, made, words):
    torch.save(made if isinstance(made, dict) else made.state_dict(), tmp_path / "net.pt")
    assert main([str(tmp_path / "net.pt")]) == 2
    error = capsys.readouterr().err
    assert words in error and error.startswith("error: ") and len(error.splitlines()) == 1
    if not isinstance(made, dict):
        with pytest.raises(CertifyError, match=words):
            certify.certify(made)


def test_a_module_states_its_nonlinearity():
    result = certify.certify(nn.Sequential(nn.Linear(1, 2), module(3, nonlinearity="relu"), nn.Linear(3, 1)))
    assert result.contracting and result.found["activation"] == "relu"
    assert certify.certify(module(3), "tanh").certificate["activation"] == "tanh"
    for wrong, given, words in (
        (module(3), "relu", "the module has 'tanh'"),
        (nn.Linear(2, 2), None, "found 0 networks"),
        (nn.ModuleList([module(2), module(2)]), None, "found 2 networks"),
        (3, None, "expected a torch.nn.RNN"),
    ):
        with pytest.raises(CertifyError, match=words):
            certify.certify(wrong, given)


# Rates


@pytest.mark.parametrize("n", [1, 4, 12, 40])
def test_a_known_rate_is_found_and_proved(n):
    result = certify.certify(module(n))
    assert result.contracting and 0.9 - 1e-6 <= result.rate < 0.9005
    torch_twice = certify.certify(module(n, rate=1.1), seconds=0.2)
    assert not torch_twice.contracting and torch_twice.certificate is None


@pytest.mark.parametrize("n, full", [(2, True), (5, True), (12, True), (12, False), (30, False)])
def test_no_pattern_grows_faster_than_a_rate_that_is_proved(n, full):
    W = random(n)
    answer = by_full_metric(W, 10.0) if full else by_spectral_norm(W)
    slopes = patterns(W)
    assert spectral(slopes, answer.proof.metric) <= float(answer.kappa) * (1 + 1e-9)
    radius = np.abs(np.linalg.eigvals(slopes)).max()
    assert radius <= answer.kappa <= by_spectral_norm(W).kappa * Fraction(10001, 10000)
    less = answer.kappa * Fraction(99, 100)
    assert not recurrent.proves(W, answer.proof.metric, answer.proof.multipliers[0], less)


@pytest.mark.thorough
@pytest.mark.parametrize("n, seed", [(3, 0), (4, 1), (6, 2)])
def test_the_full_metric_is_the_one_that_a_solver_finds(n, seed):
    pytest.importorskip("clarabel")
    from certify.search.vector_lmi import smallest_rate

    solved = smallest_rate(network(random(n, seed)).weights, TANH)
    assert float(by_full_metric(random(n, seed), 10.0).kappa) == pytest.approx(solved.rate, rel=5e-4)


@pytest.mark.parametrize("norm", ["inf", "one"])
def test_of_a_diagonal_scaling_the_rate_needs_no_signs(norm):
    W = random(4)
    net, T = network(W), diagonal_scaling(W)
    slopes = vector_exact.everywhere(net.weights, TANH)
    enumerated = vector_exact.row_sums(net.weights, slopes, norm, T)
    assert vector_exact.rate(net.weights, slopes, norm, T) == max(x for _, values in enumerated for x in values)
    least = np.abs(np.linalg.eigvals(np.abs(W))).max()  # no diagonal T has a smaller one
    assert float(vector_exact.rate(net.weights, slopes, "one", T)) == pytest.approx(least, rel=1e-6)


@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_definite_matrices_alone_are_proved_definite(n):
    rng = np.random.default_rng(n)
    for k in range(20):
        X = rng.integers(-9, 10, (n, n)).astype(object)
        M = X @ X.T + (np.diag([k % 3] * n) if k % 3 else 0)
        if k % 4 == 3:
            M[0, 0] -= 60
        exact = definiteness([[Fraction(x) for x in row] for row in M]) == 1
        assert recurrent.positive_definite(M) == exact
    edge = np.array([[10**40, 10**40 - 1], [10**40 - 1, 10**40 - 2]], dtype=object)  # determinant −1
    assert not recurrent.positive_definite(edge)


# Certificates


@pytest.mark.parametrize("n", [10, 30, *few([100], (), "thorough"), *few([200], ())])
def test_many_states_are_certified_by_numbers_that_verification_accepts(n):
    W = 0.4 * random(n)
    for condition, given in (
        ("quadratic", by_spectral_norm(W)._asdict()),
        ("exact", {"norm": "one", "scaling": diagonal_scaling(W)}),
    ):
        net = network(W if condition == "quadratic" else W / 10)
        given["rate"] = given.pop("kappa", None)
        content = vector_certificate.make(net, condition, **given)
        assert vector_certificate.verify(content, net).valid


@pytest.mark.parametrize("n", [3, 10])
def test_a_certificate_is_about_its_weights_alone(n):
    answer = by_spectral_norm(0.5 * random(n))
    net = network(0.5 * random(n))
    content = vector_certificate.make(net, "quadratic", answer.kappa, answer.proof)
    assert vector_certificate.verify(content, net).valid
    assert not vector_certificate.verify(content, network(0.6 * random(n))).valid
    exact = vector_certificate.make(network(0.1 * random(n)), "exact", norm="one", scaling=diagonal_scaling(random(n)))
    assert exact is not None and vector_certificate.verify(exact, network(0.1 * random(n))).valid
    claims = {key: content[key] for key in content.keys() - {"proof", "path", "versions", "sha256"}}
    for changed in (
        {"multipliers": [["1"] * n]},
        {"metric": [["1" if i == j else "1/2" if i + j == 1 else "0" for j in range(n)] for i in range(n)]},
        {"metric": [[str(-int(i == j)) for j in range(n)] for i in range(n)], "multipliers": [["-1"] * n]},
    ):
        forged = described({**claims, "rate": "1/100", "margin": 0.99, "contraction_rate": "1/100"},
                           content["proof"] | changed, "")  # fmt: skip
        assert not vector_certificate.verify(forged, net).valid


def test_steps_of_many_states_are_refused_before_their_signs_are_tried():
    net = network(0.01 * random(40))
    exact = vector_certificate.make(net, "exact", norm="one", scaling=diagonal_scaling(net.weights.W))
    proof = exact["proof"] | {"step": "1/2"}
    claims = {key: exact[key] for key in exact.keys() - {"proof", "path", "versions", "sha256"}}
    claims |= vector_certificate._claims(net.weights, net.activation, "exact", Fraction(exact["rate"]), proof)
    check = vector_certificate.verify(described(claims, proof, ""), net)
    assert not check.valid and "too large" in check.reason


@pytest.mark.parametrize("part", ["metric", "scaling"])
def test_forged_numbers_do_not_make_verification_slow(part):
    n, rng = 60, np.random.default_rng(0)
    net, odd = network(0.01 * random(60)), [str(Fraction(1, int(x) | 1)) for x in rng.integers(2**60, 2**62, n)]
    diagonal = [[x if i == j else "0" for j in range(n)] for i, x in enumerate(odd)]
    if part == "metric":
        content = vector_certificate.make(net, "quadratic", *by_spectral_norm(net.weights.W))
        proof = {"metric": diagonal, "multipliers": [odd]}
    else:
        content = vector_certificate.make(net, "exact", norm="one", scaling=diagonal_scaling(net.weights.W))
        proof = content["proof"] | {"scaling": diagonal}
    claims = {key: content[key] for key in content.keys() - {"proof", "path", "versions", "sha256"}}
    began = time.process_time()
    vector_certificate.verify(described(claims, proof, ""), net)
    assert time.process_time() - began < 5


def test_the_command_judges_writes_and_verifies(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save(module(8).state_dict(), "good.pt")
    torch.save(module(70, rate=1.2).state_dict(), "wide.pt")
    assert main(["good.pt", "--nonlinearity", "relu", "--certificate", "proofs"]) == 0
    assert main(["--verify", "proofs/good.quadratic.json"]) == 0 and ": valid" in capsys.readouterr().out
    assert main(["good.pt", "--activation", "tanh", "--verify", "proofs/good.quadratic.json"]) == 1
    assert main(["good.pt", "wide.pt"]) == 1 and "above 64 states" in capsys.readouterr().out
    assert main(["good.pt", "--json", "--lmi"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (
        row["activation"] == "tanh" and row["rates"].keys() == {"quadratic", "exact"} and row["judged"] == "quadratic"
    )
    for options, words in ((["--condition", "lmi"], "is not for"), (["--steps"], "at most 6 states")):
        assert main(["good.pt", *options]) == 2 and words in capsys.readouterr().err
    np.savez("stated.npz", **{name: x.numpy() for name, x in module(3).state_dict().items()}, activation="tanh")
    assert main(["stated.npz", "--nonlinearity", "relu"]) == 2 and "states the activation" in capsys.readouterr().err


@pytest.mark.thorough
@pytest.mark.parametrize("n, seconds", few([(32, 15), (64, 120)], [(32, 15)]))
def test_a_full_metric_of_many_states_is_found_in_time(n, seconds):
    W, began = 0.7 * random(n), time.process_time()
    net = nn.RNN(1, n)
    with torch.no_grad():
        net.weight_hh_l0.copy_(torch.as_tensor(W))
    result = certify.certify(net)
    assert result.contracting and result.rate < 0.97 < by_spectral_norm(W).kappa
    assert time.process_time() - began < seconds


@pytest.mark.thorough
@pytest.mark.parametrize("constrained", [False, True])
def test_a_network_that_learns_a_boat_is_certified_where_it_is_constrained(constrained):
    """Surge, m v̇ = F − d v|v|, sampled at 0.2 s: a slope near 1. The constraint is on ‖W_hh‖₂."""
    torch.manual_seed(0)
    command, speed = torch.rand(8, 20).repeat_interleave(10, 1), torch.zeros(8, 201)
    for k in range(200):
        v = speed[:, k]
        speed[:, k + 1] = v + 0.2 * (command[:, k] - 0.4 * v * v.abs())
    net = nn.ModuleDict({"rnn": nn.RNN(1, 12, batch_first=True), "head": nn.Linear(12, 1)})
    optimizer, losses = torch.optim.Adam(net.parameters(), 5e-3), []
    for _ in range(150):
        optimizer.zero_grad()
        loss = (net["head"](net["rnn"](command[..., None])[0])[..., 0] - speed[:, 1:]).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if constrained:
            with torch.no_grad():
                W = net["rnn"].weight_hh_l0
                W.mul_((0.99 / torch.linalg.matrix_norm(W, 2)).clamp(max=1))
    assert losses[-1] < 0.1 * losses[0]
    result = certify.certify(net)
    assert result.contracting or not constrained
    assert not constrained or result.rate <= 0.9901
    for slopes in itertools.islice(patterns(net["rnn"].weight_hh_l0.detach().double().numpy()), 20):
        assert not result.contracting or np.abs(np.linalg.eigvals(slopes)).max() <= result.rate
