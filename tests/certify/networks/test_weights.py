"""Weights: every kind of file, and every way in which one can be wrong."""

import pickle
import zipfile

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file

from certify.errors import CertifyError
from certify.networks import shallow
from certify.networks.shallow import NAMES, ShallowWeights, check, digest, find, from_tensors, load, stated_activation
from certify.networks.vector import RELU, activation, read_both
from usvlearn import AID, RNN, Ensemble
from usvlearn.core.checkpoint import save


def weights(n: int = 3, m: int = 4, seed: int = 0) -> ShallowWeights:
    rng = np.random.default_rng(seed)
    return ShallowWeights(rng.normal(size=n), rng.normal(size=n), rng.normal(size=(n, m)), rng.normal(size=n))


def same(weights: ShallowWeights, expected: ShallowWeights) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(weights, expected, strict=True))


def test_a_checkpoint_of_an_ensemble_with_two_networks(tmp_path):
    ensemble = Ensemble({"aid": AID(28.0), "rnn": RNN(6), "wide": RNN(9, seed=1)})
    networks = load(save(tmp_path / "set.safetensors", ensemble.init(), boat="heron"))
    assert [network.path.rpartition(":")[2] for network in networks] == ["members.rnn.weights", "members.wide.weights"]
    assert [len(network.weights.a) for network in networks] == [6, 9]
    assert np.array_equal(networks[0].weights.W2, ensemble.init().members["rnn"].weights.W2.detach().numpy())


def test_elements_are_parameter_sets(tmp_path):
    networks = load(save(tmp_path / "lanes.safetensors", RNN(5).init((2, 3))))
    assert len(networks) == 6 and networks[-1].path.endswith("lanes.safetensors[1,2]")
    assert networks[0].weights.W2.shape == (5, 4)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_files_of_every_kind_hold_the_same(tmp_path, dtype):
    arrays = {name: x.astype(dtype) for name, x in zip(NAMES, weights(), strict=True)}
    expected = ShallowWeights(*(x.astype(np.float64) for x in arrays.values()))
    np.savez(tmp_path / "net.npz", **arrays)
    save_file(arrays, tmp_path / "net.safetensors")
    torch.save({name: torch.from_numpy(x) for name, x in arrays.items()}, tmp_path / "net.pt")
    for name in ("net.npz", "net.safetensors", "net.pt"):
        (net,) = load(tmp_path / name)
        assert net.path == str(tmp_path / name) and same(net.weights, expected)
        assert net.weights.a.dtype == np.float64


def test_the_state_dict_of_two_linear_layers(tmp_path):
    layers = torch.nn.Sequential(torch.nn.Linear(5, 3), torch.nn.ReLU(), torch.nn.Linear(3, 1, bias=False)).double()
    torch.save(layers.state_dict(), tmp_path / "net.pth")
    (net,) = load(tmp_path / "net.pth")
    a, w1, W2, b = net.weights
    x, u = 0.3, np.array([0.1, -0.2, 0.3, 0.4])
    expected = layers(torch.tensor([x, *u], dtype=torch.float64)).item()
    assert np.maximum(w1 * x + W2 @ u + b, 0) @ a == pytest.approx(expected, rel=1e-12)
    layers = torch.nn.Sequential(torch.nn.Linear(5, 3), torch.nn.ReLU(), torch.nn.Linear(3, 1))
    torch.save(layers.state_dict(), tmp_path / "biased.pth")
    with pytest.raises(CertifyError, match=r"2\.bias is not zero"):
        load(tmp_path / "biased.pth")


class Trap:
    def __reduce__(self):
        return exec, ("import builtins; builtins.trapped = True",)


def test_pickled_code_is_never_run(tmp_path):
    torch.save({name: torch.ones(1, 1, dtype=torch.complex64) for name in NAMES}, tmp_path / "complex.pt")
    with pytest.raises(CertifyError, match="expected real weights"):
        load(tmp_path / "complex.pt")
    torch.save({"a": Trap()}, tmp_path / "trap.pt")
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(Trap()))
    np.savez(tmp_path / "trap.npz", a=np.array([Trap()], dtype=object))
    for name in ("trap.pt", "plain.pt", "trap.npz"):
        with pytest.raises(CertifyError, match=name.replace(".", r"\.")):
            load(tmp_path / name)
    import builtins

    assert not hasattr(builtins, "trapped")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"a": [np.nan, 0, 0]}, "1 NaN or infinite values in a"),
        ({"b": [np.inf, 0, np.nan]}, "2 NaN or infinite values in b"),
        ({"w1": [1.0]}, "expected a, w1, b"),
        ({"W2": [1.0, 2.0, 3.0]}, "expected a, w1, b"),
        ({"a": 1.0}, "expected a, w1, b"),
        ({"a": [], "w1": [], "W2": np.zeros((0, 4)), "b": []}, "without neurons"),
        ({"a": ["x", "y", "z"]}, "no numbers"),
        ({"a": [1j, 0, 0]}, "no numbers"),
    ],
)
def test_weights_that_cannot_be_judged(change, message):
    with pytest.raises(CertifyError, match=message):
        check(weights()._replace(**change), "net.npz")
    with pytest.raises(CertifyError, match=r"^tensors"):
        from_tensors({"w1": [1.0], "a": [1.0]})
    whole = weights()._asdict()
    with pytest.raises(CertifyError, match=r"m2\.w1 but no m2\.W2, m2\.b"):
        from_tensors({**{f"m1.{key}": x for key, x in whole.items()}, "m2.a": [1.0], "m2.w1": [5.0]})
    with pytest.raises(CertifyError, match="no network"):
        from_tensors(ShallowWeights(*(np.zeros((0, *x.shape)) for x in weights()))._asdict())
    with pytest.raises(CertifyError, match=r"a weight of 1e\+300"):
        from_tensors(weights()._replace(w1=[1e300, 0, 0])._asdict())


THIRD = np.ones(3, np.longdouble) / 3


@pytest.mark.parametrize(
    ("a", "fits"),
    [
        (np.array([2**53 + 1, 0, 0]), False),
        (np.array([2**53, -3, 0]), True),
        (np.array([2**64 - 1, 0, 0], np.uint64), False),
        (np.array([2**63, 0, 0], np.uint64), True),
        (np.array([True, False, True]), True),
        (np.array([0.1, 0.2, 0.3], np.float16), True),
        (torch.tensor([0.1, 0.2, 0.3]), True),
        (THIRD, bool((THIRD == THIRD.astype(float)).all())),  # where a long double is a double, it fits
        (THIRD.astype(float).astype(np.longdouble), True),
    ],
)
def test_weights_are_taken_as_they_are_or_refused(a, fits):
    given = weights()._replace(a=a)
    if fits:
        assert (check(given).a == np.asarray(a)).all()
    else:
        with pytest.raises(CertifyError, match=r"^net: found values in a that float64 cannot hold exactly"):
            check(given, "net")


def test_tensors_of_torch_are_taken_as_they_are_or_refused(tmp_path):
    arrays = {name: torch.tensor(x) for name, x in weights()._asdict().items()}
    torch.save({name: x.bfloat16() for name, x in arrays.items()}, tmp_path / "half.pt")
    assert same(load(tmp_path / "half.pt")[0].weights, [x.bfloat16().double().numpy() for x in arrays.values()])
    torch.save({**arrays, "a": torch.tensor([2**53 + 1, 0, 0])}, tmp_path / "long.pt")
    with pytest.raises(CertifyError, match="cannot hold exactly"):
        load(tmp_path / "long.pt")


def test_files_that_are_none(tmp_path):
    (tmp_path / "empty.safetensors").write_bytes(b"")
    (tmp_path / "text.npz").write_text("a,b\n1,2\n")
    (tmp_path / "text.pt").write_text("hello")
    (tmp_path / "net.csv").write_text("1")
    good = save(tmp_path / "good.safetensors", RNN(4).init())
    (tmp_path / "short.safetensors").write_bytes(good.read_bytes()[:-20])
    save(tmp_path / "aid.safetensors", AID(28.0).init())
    for name in ("empty.safetensors", "text.npz", "text.pt", "net.csv", "short.safetensors", "aid.safetensors"):
        with pytest.raises(CertifyError, match=name.replace(".", r"\.")):
            load(tmp_path / name)
    with pytest.raises(CertifyError, match="cannot be read"):
        load(tmp_path / "missing.npz")


def test_find_takes_files_folders_and_patterns_once(tmp_path):
    for boat in ("anna", "bert"):
        save(tmp_path / "run/checkpoints" / boat / "1.safetensors", RNN(4).init())
    (tmp_path / "run/predictions").mkdir()
    np.savez(tmp_path / "run/predictions/1.npz", predictions=np.zeros(3))
    (tmp_path / "nothing").mkdir()
    (tmp_path / "run/report").mkdir()
    np.savez(tmp_path / "run/report/crossval.npz", errors=np.zeros(3))
    np.savez(tmp_path / "run/more.npz", **weights()._asdict())
    np.savez(tmp_path / "loose.npz", **weights()._asdict())
    sets = find([tmp_path / "run"])  # of a run its checkpoints alone
    assert [path.parent.name for path in sets] == ["anna", "bert"]
    assert find([tmp_path / "run/checkpoints"]) == sets
    assert find([tmp_path]) == [tmp_path / "loose.npz", *sets]  # beside a run whatever is there
    assert find([str(tmp_path / "run/checkpoints/*/*"), sets[0].absolute(), *sets]) == sets
    for wrong in (tmp_path / "nowhere", tmp_path / "*.pt", tmp_path / "nothing", tmp_path / "noth*"):
        with pytest.raises(CertifyError):
            find([wrong])


def test_digest_knows_every_weight_and_no_negative_zero():
    one = weights()
    assert digest(one) == digest(ShallowWeights(*(x.tolist() for x in one)))
    for k, name in enumerate(NAMES):
        changed = one[k].copy()
        changed.flat[0] = np.nextafter(changed.flat[0], np.inf)
        assert digest(one._replace(**{name: changed})) != digest(one)
    zero = one._replace(a=np.zeros(3))
    assert digest(zero) == digest(zero._replace(a=-np.zeros(3)))


@pytest.mark.parametrize("name", ["bomb.npz", "bomb.pt"])
def test_an_archive_that_unpacks_to_gigabytes_is_refused_before_it_is_unpacked(tmp_path, monkeypatch, name):
    assert shallow.UNPACKED == 2**28
    monkeypatch.setattr(shallow, "UNPACKED", 2**24)
    path = tmp_path / name
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(20 * 2**20))
    assert path.stat().st_size < 2**20
    with pytest.raises(CertifyError, match="unpacks to 21 MB, expected 17 MB at most"):
        load(path)


def test_a_file_states_its_activation_and_a_contradiction_is_refused(tmp_path):
    ensemble = Ensemble({"rnn": RNN(6)})
    saved = save(tmp_path / "set.safetensors", ensemble.init(), kernel=ensemble.description())
    assert stated_activation(saved) == "relu" and read_both(saved)[0] and read_both(saved, RELU)[0]
    with pytest.raises(CertifyError, match="states the activation relu, found --activation tanh"):
        read_both(saved, activation("tanh"))
    for file in (tmp_path / "net.npz", tmp_path / "net.safetensors"):
        arrays = weights()._asdict()
        if file.suffix == ".npz":
            np.savez(file, **arrays, activation="leaky:0.01")
        else:
            save_file(arrays, file, {"activation": "leaky:0.01"})
        (net,) = read_both(file)[1]
        assert str(net.activation) == "leaky:1/100" and read_both(file, activation("leaky:1/100"))[1]
        with pytest.raises(CertifyError, match="states the activation 'leaky"):
            load(file)
    np.savez(tmp_path / "bad.npz", **weights()._asdict(), activation="gelu")
    with pytest.raises(CertifyError, match="activation: found 'gelu'"):
        read_both(tmp_path / "bad.npz")
