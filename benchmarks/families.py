"""Random and freshly initialised networks, on which the conditions are compared."""

from __future__ import annotations

import math

import numpy as np
import torch

from certify.command.compare import random_networks as initial_networks
from certify.networks.shallow import ShallowWeights
from certify.training import conditions


def random_networks(count: int, n: int, rng: np.random.Generator) -> list[ShallowWeights]:
    """Normal weights, four inputs, scaled so that K is spread log-uniformly over 0.03 … 3."""
    networks = []
    for K in np.exp(rng.uniform(math.log(0.03), math.log(3), count)):
        a, w1, b = rng.normal(size=(3, n))
        gain = math.sqrt(K / float(conditions.rate(torch.tensor(a), torch.tensor(w1))))
        networks.append(ShallowWeights(gain * a, gain * w1, rng.normal(size=(n, 4)), b))
    return networks


def signed_networks(count: int, n: int, rarer: int, rng: np.random.Generator) -> list[ShallowWeights]:
    """Initial networks of which `rarer` neurons have s_i < 0, and the others s_i > 0."""
    signs = np.where(np.arange(n) < rarer, -1.0, 1.0)
    return [w._replace(a=np.abs(w.a) * signs, w1=np.abs(w.w1)) for w in initial_networks(count, n, rng)]
