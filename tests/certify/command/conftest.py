"""A folder of networks and of a run's checkpoints, on which the command is called."""

import numpy as np
import pytest

from certify.networks.shallow import ShallowWeights
from usvlearn import AID, RNN, Ensemble
from usvlearn.core.checkpoint import save


@pytest.fixture
def files(tmp_path):
    """One network on each side of `exact`, one on an edge that only the box sees, and a run's checkpoints."""
    one, zero = np.ones(1), np.zeros(1)
    networks = {
        "good": ShallowWeights(0.6 * one, 0.5 * one, np.zeros((1, 1)), zero),
        "identity": ShallowWeights(one, one, np.zeros((1, 1)), zero),
        "tooth": ShallowWeights(2 * one, one, np.zeros((1, 1)), -0.25 * one),
        "off": ShallowWeights(2 * one, one, np.zeros((1, 1)), -9 * one),
    }
    for name, weights in networks.items():
        np.savez(tmp_path / f"{name}.npz", **weights._asdict())
    ensemble = Ensemble({"aid": AID(28.0), "rnn": RNN(6, initial="random")})
    for boat in ("anna", "bert"):
        save(tmp_path / "run/checkpoints" / boat / "00000_0000010.safetensors", ensemble.init(), boat=boat)
    return tmp_path
