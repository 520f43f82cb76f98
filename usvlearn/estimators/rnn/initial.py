"""The initial weights of the network: drawn at random, or read from a file."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights, load
from usvlearn.errors import ConfigError


def initial_weights(n: int, initial: str, ratio: Sequence[float], generator: torch.Generator) -> ShallowWeights:
    """Random weights, or persistence, equation (4) of `state` at κ = 1, and kinks within 0 ≤ x ≤ ½, 0 ≤ u ≤ 1."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    a = (2 * uniform(n) - 1) / math.sqrt(n)
    w1, W2, b = ((2 * uniform(*shape) - 1) / math.sqrt(5) for shape in ((n,), (n, 4), (n,)))
    if initial == "random":
        return ShallowWeights(a, w1, W2, b)
    _, speed, heading, command, _ = ratio  # weights with a higher rate are larger
    w1, W2 = speed * w1, W2 * torch.tensor([heading, heading, command, command], dtype=torch.float64)
    b = -(w1 * uniform(n) / 2 + (W2 * uniform(n, 4)).sum(-1))
    a, w1[:2], W2[:2], b[:2] = torch.zeros_like(a), torch.tensor([2.0, 0.0]), 0.0, 1.0
    a[:2] = torch.tensor([0.5, -0.5])
    return ShallowWeights(a, w1, W2, b)


def pretrained_weights(given: str, n: int) -> ShallowWeights:
    """The weights that `pretrained` names: a file's, or one set of a file's as `certify` calls it."""
    file = re.match(r".*?\.(safetensors|npz|pth?)(?=$|[:\[])", given)
    path = file[0] if file else given
    try:
        networks = load(path)
    except CertifyError as error:
        raise ConfigError(f"pretrained: {error}") from error
    matches = networks if path == given else [each for each in networks if each.path == str(Path(given))]
    if len(matches) != 1:
        names = ", ".join(each.path for each in networks[:6]) + (", …" if len(networks) > 6 else "")
        raise ConfigError(f"pretrained: found {len(matches)} networks for {given!r}, expected one: give one of {names}")
    weights = matches[0].weights
    if (shape := weights.W2.shape) != (n, 4):
        raise ConfigError(
            f"pretrained: found {shape[0]} neurons and {shape[1]} inputs in {given}, expected {n} and 4: set neurons "
            "to the file's, or give another file"
        )
    return ShallowWeights(*map(torch.from_numpy, weights))
