"""The prior without torch: the same ensemble as torch makes of the configuration, for any boat."""

import json
import shutil

import build_prior
import numpy as np
import pytest

from tests.support.commands import python
from usvlearn import Inputs, Online, Sample
from usvlearn.core import checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.live.prior import FILE, prior

BOATS = [(28.0, 2.74), (17.5, 3.5), (0.02, 0.31), (54321.0, 17.3)]  # kg, m/s


def assert_equal(found, expected, path: str = "") -> None:
    """Two trees with equal choices, and with numbers that are equal to 1e-12 of their size."""
    assert type(found) is type(expected), path
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), path
        for key, value in expected.items():
            assert_equal(found[key], value, f"{path}/{key}")
    elif isinstance(expected, list):
        assert len(found) == len(expected), path
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_equal(one, other, f"{path}/{i}")
    elif isinstance(expected, np.ndarray):
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape), path
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=0, err_msg=path)
    elif isinstance(expected, float):
        assert found == expected or abs(found / expected - 1) < 1e-12, path
    else:
        assert found == expected, path


@pytest.mark.thorough
@pytest.mark.parametrize("mass, surge_max", BOATS)
def test_it_equals_the_ensemble_that_torch_makes(mass, surge_max):
    """It fails, too, if a default has changed since the file was made: run `python aboard/build_prior.py`."""
    leaves, facts = prior(mass, surge_max)
    name, description, state = build_prior.default_ensemble(mass, surge_max)
    assert_equal(facts, {"estimator": name, "kernel": description})
    assert_equal(leaves, state)


def test_the_boat_matters():
    one, other = (json.dumps(prior(*boat)[1]) for boat in BOATS[:2])
    assert one != other


def test_what_it_becomes_is_saved_and_opened(tmp_path):
    boat = Online.of(*prior(20.0, 1.7))
    boat.step(Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 0.2, True, True))
    again = Online.open(boat.save(tmp_path / "set.safetensors"))
    assert again.predict(Inputs(0.5, 0.5, 0.0, 0.0, 0.4)) == boat.predict(Inputs(0.5, 0.5, 0.0, 0.0, 0.4))


@pytest.mark.thorough
def test_it_imports_no_torch():
    python(
        "import sys; sys.modules['torch'] = None; sys.modules['hydra'] = None\n"
        "from usvlearn import Online; from usvlearn.live.prior import prior; Online.of(*prior(20.0, 1.7))"
    )


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf"), "28", None])
def test_what_is_no_positive_number_is_refused(value):
    with pytest.raises(ConfigError, match=r"^mass: found .*, expected a positive number of kg"):
        prior(value, 2.0)
    with pytest.raises(ConfigError, match=r"^surge_max: found .*, expected a positive number of m/s"):
        prior(20.0, value)


@pytest.mark.thorough
def test_the_file_is_made_again(tmp_path):
    remade, before = checkpoint.load(build_prior.make(tmp_path / "prior.safetensors")), checkpoint.load(FILE)
    assert_equal(list(remade), list(before))


@pytest.mark.parametrize("law, sentence", [
    (lambda mass, surge_max: 2.0 + mass, "is no product of whole powers"),
    (lambda mass, surge_max: np.sqrt(surge_max), "is no product of whole powers"),
    (lambda mass, surge_max: np.minimum(mass, 100.0), "is no product of whole powers"),
    (lambda mass, surge_max: "small" if mass < 100 else "large", "depends on the boat"),
])  # fmt: skip
def test_a_number_that_is_no_monomial_is_refused(law, sentence, tmp_path, monkeypatch):
    monkeypatch.setattr(
        build_prior, "default_ensemble", lambda *boat: ("Ensemble", {"numbers": {"new": law(*boat)}}, {})
    )
    with pytest.raises(ConfigError, match=f"^kernel.numbers.new: found .*{sentence}"):
        build_prior.make(tmp_path / "prior.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_file_is_told(tmp_path, monkeypatch):
    copy = tmp_path / "prior.safetensors"
    shutil.copy(FILE, copy)
    content = bytearray(copy.read_bytes())
    content[-5] ^= 1
    copy.write_bytes(content)
    monkeypatch.setattr("usvlearn.live.prior.FILE", copy)
    with pytest.raises(CheckpointError, match="is damaged"):
        prior(20.0, 1.7)
