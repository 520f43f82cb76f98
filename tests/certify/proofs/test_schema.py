"""Certificates follow the published JSON schema."""

import json
from fractions import Fraction

import jsonschema
import numpy as np
import pytest

from certify.networks.shallow import ShallowWeights
from certify.networks.vector import VectorNetwork, VectorWeights, activation, check
from certify.proofs import certificate, vector_certificate
from certify.proofs.box_planes import Box
from certify.proofs.vector_exact import Proof
from tests.support import ROOT

SHALLOW = ShallowWeights([0.2], [0.5], [[1.0]], [0.0])
UNIT = Box(np.array([0.0, -1.0]), np.ones(2))


@pytest.fixture(scope="module")
def validator():
    schema = json.loads((ROOT / "certify" / "certificate.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def network(phi: str = "relu") -> VectorNetwork:
    weights = VectorWeights(None, [[0.1, 0.0], [0.0, 0.2]], [[0.5, 0.0], [0.25, 0.25]], [[1.0], [0.0]], [0.0, 0.1])
    return VectorNetwork("net.npz", check(weights), activation(phi))


@pytest.mark.parametrize("condition", certificate.CONDITIONS)
def test_certificates_of_shallow_networks_follow_the_schema(condition, validator):
    more = {"box": UNIT} if condition in ("interval", "box") else {}
    cert = certificate.make(SHALLOW, condition, **more)
    validator.validate(cert)
    for key in ("rate", "sha256", "proof"):
        assert not validator.is_valid({name: value for name, value in cert.items() if name != key})
    assert not validator.is_valid({**cert, "proof": {**cert["proof"], "more": "1"}})


@pytest.mark.parametrize("condition", vector_certificate.CONDITIONS)
def test_certificates_of_vector_states_follow_the_schema(condition, validator):
    more = {}
    if condition in ("lmi", "quadratic"):
        one = Fraction(1)
        more = {"proof": Proof([[one, 0 * one], [0 * one, one]], [[one / 4, one / 4]])}
    cert = vector_certificate.make(network(), condition, **more)
    validator.validate(cert)
    assert not validator.is_valid({**cert, "format": certificate.FORMAT})
    assert not validator.is_valid({**cert, "activation": "gelu"})
    assert not validator.is_valid({**cert, "proof": {}})


def test_a_leaky_network_and_all_steps_follow_the_schema(validator):
    cert = vector_certificate.make(network("leaky:0.01"), "exact", norm="one", step=Fraction(3, 2))
    validator.validate(cert)
    assert cert["proof"]["step"] == "3/2" and cert["activation"] == "leaky:1/100"
