"""The weights of `torch.nn.RNN` and `torch.nn.RNNCell`, h⁺ = φ(W_hh h + W_ih u + b_ih + b_hh), by the names of tensors.

Other recurrent modules are refused. A certificate is about W_hh alone: φ takes increments to increments with slopes in
[0, 1], for relu as for tanh, whatever the inputs and the biases are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.networks.shallow import as_float64

NAMED = re.compile(r"(?P<prefix>.*\.|)(?P<part>(weight|bias)_(ih|hh|hr))(_l(?P<layer>\d+))?(?P<reverse>_reverse)?")
GATED = {4: "an LSTM", 3: "a GRU"}  # by the rows of weight_hh for each of its columns


class Recurrent(NamedTuple):
    """One module, and what stands before the names of its tensors."""

    prefix: str
    W: np.ndarray  # (n, n) W_hh
    W2: np.ndarray  # (n, m) W_ih
    b: np.ndarray  # (n,) the sum of both biases


def of_torch(tensors: Mapping[str, Any], path: str) -> list[Recurrent]:
    """The recurrent networks among named tensors; a CertifyError about other kinds, or missing weights."""
    modules: dict[str, dict[str, Any]] = {}
    for name, tensor in tensors.items():
        if match := NAMED.fullmatch(name):
            label = f"{path}: {match['prefix']}{match['part']}"
            if match["layer"] not in (None, "0"):
                raise CertifyError(f"{label}_l{match['layer']}: found several layers, expected num_layers=1")
            if match["reverse"]:
                raise CertifyError(f"{label}_reverse: found both directions, expected bidirectional=False")
            if match["part"] == "weight_hr":
                raise CertifyError(f"{label}: found a projection, expected torch.nn.RNN or RNNCell without proj_size")
            modules.setdefault(match["prefix"], {})[match["part"]] = tensor
    return [_module(prefix, parts, f"{path}: {prefix}") for prefix, parts in modules.items()]


def _module(prefix: str, given: dict[str, Any], label: str) -> Recurrent:
    if lacking := {"weight_ih", "weight_hh"} - given.keys():
        raise CertifyError(f"{label}{min(lacking)} is missing, expected weight_ih and weight_hh of torch.nn.RNN")
    parts = as_float64(given, label)
    W, W2 = parts["weight_hh"], parts["weight_ih"]
    n = W.shape[-1] if W.ndim == 2 else 0
    if n and len(W) % n == 0 and (kind := GATED.get(len(W) // n)):
        raise CertifyError(f"{label}weight_hh: found {kind} by its shape {W.shape}, whose gates multiply states: "
                           "certified are torch.nn.RNN and RNNCell alone")  # fmt: skip
    biases = [parts[name] for name in ("bias_ih", "bias_hh") if name in parts]
    if not n or W.shape != (n, n) or W2.shape != (n, *W2.shape[1:2]) or any(b.shape != (n,) for b in biases):
        shapes = ", ".join(f"{name} {x.shape}" for name, x in parts.items())
        raise CertifyError(
            f"{label}: found the shapes {shapes}, expected weight_hh (n, n), weight_ih (n, m), bias (n,)"
        )
    return Recurrent(prefix.rstrip("."), W, W2, sum(biases, np.zeros(n)))
