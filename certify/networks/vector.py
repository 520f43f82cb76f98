"""The weights of a network whose state is a vector, and its activation.

    x⁺ = R x + A φ(y),   y = W x + W₂ u + b                    one hidden layer                        (1)
    x⁺ = R x + A φ(V φ(y) + c)                                 two hidden layers
    x⁺ = φ(W x + W₂ u + b)                                     recurrent: torch.nn.RNN, A = I and R = 0

x ∈ ℝ^q, such as surge, sway and yaw rate; u ∈ ℝ^m; φ is applied to each component. The paper's network (section
IV-B) is q = 1, R = 0 and relu, `certify.networks.shallow.ShallowWeights`.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError, about, quoted
from certify.networks.recurrent import of_torch
from certify.networks.shallow import (
    LARGEST,
    Network,
    ShallowWeights,
    as_float64,
    holds_shallow,
    read_tensors,
    refuse_many,
    stated_activation,
)
from certify.networks.shallow import from_tensors as shallow_networks

MOST_STATES = 6  # q; the exact rate takes the 2^q signs of x
MOST_RECURRENT = 1000  # q of a recurrent network, whose rate needs no signs where T is diagonal
LARGEST_OF_TWO = 1e100  # largest weight with two hidden layers, where a slope is a product of three weights
MOST_DIGITS = 60  # of a leak


class VectorWeights(NamedTuple):
    """The weights of a network of q states, n neurons and m inputs; arrays or tensors.

    V and c are None where there is one hidden layer.

    >>> net = VectorWeights(R=[[0.9]], A=[[0.1]], W=[[1.0]], W2=[[0.0]], b=[0.0])
    >>> net.V is None
    True
    """

    R: Any  # (*batch, q, q)
    A: Any  # (*batch, q, n), of the last hidden layer
    W: Any  # (*batch, n, q), of the first
    W2: Any  # (*batch, n, m)
    b: Any  # (*batch, n)
    V: Any = None  # (*batch, l, n): of the second; A is then (*batch, q, l)
    c: Any = None  # (*batch, l)


REQUIRED = ("A", "W", "W2", "b")


class Activation(NamedTuple):
    """φ of (1): its name, and the interval of its slopes on all of ℝ."""

    name: str  # relu, leaky or tanh
    least: Fraction  # slope
    most: Fraction = Fraction(1)

    def __str__(self) -> str:
        return f"leaky:{self.least}" if self.name == "leaky" else self.name


RELU, TANH = Activation("relu", Fraction(0)), Activation("tanh", Fraction(0))


class VectorNetwork(NamedTuple):
    """One checkpoint, and the place from which it was read.

    >>> net = VectorNetwork("", check(VectorWeights([[0.9]], [[0.1]], [[1.0]], [[0.0]], [0.0])))
    >>> net.states, net.inputs, net.neurons
    (1, 1, 1)
    """

    path: str  # of the file; "" where there is none
    weights: VectorWeights  # float64 arrays, no batch
    activation: Activation = RELU  # φ, see `activation`

    @property
    def states(self) -> int:
        """q, the number of components of the state."""
        return int(self.weights.W.shape[-1])

    @property
    def inputs(self) -> int:
        """m, the number of inputs."""
        return int(self.weights.W2.shape[-1])

    @property
    def neurons(self) -> int:
        """The number of neurons of all hidden layers."""
        return int(self.weights.b.shape[-1] + (0 if self.weights.c is None else self.weights.c.shape[-1]))


def activation(text: str) -> Activation:
    """φ by its name: `relu`, `tanh`, or `leaky:α` with a slope α in [0, 1) for negative arguments.

    Args:
        text: the name.

    Returns:
        φ, with its least slope as a fraction.

    Raises:
        CertifyError: another name, or no such slope.

    >>> str(activation("leaky:0.01")), activation("tanh").most
    ('leaky:1/100', Fraction(1, 1))
    """
    name, given, value = text.partition(":") if isinstance(text, str) else (text, "", "")
    if name in ("relu", "tanh") and not given:
        return Activation(name, Fraction(0))
    if name == "leaky" and len(value) <= MOST_DIGITS and re.fullmatch(r"[0-9]+(\.[0-9]+)?|[0-9]+/[1-9][0-9]*", value):
        if (slope := Fraction(value)) < 1:
            return Activation("leaky", slope)
    raise CertifyError(
        f"activation: found {quoted(text)}, expected relu, tanh or leaky:α with a slope α from 0 to below 1, such as "
        "leaky:0.01"
    )


def check(weights: VectorWeights, name: str = "weights") -> VectorWeights:
    """The weights as float64 arrays, zeros for R = None; a CertifyError for wrong shapes, and too many states."""
    if weights.R is None:
        q = np.shape(weights.A)[-2] if np.ndim(weights.A) > 1 else 0
        weights = weights._replace(R=np.zeros((*np.shape(weights.A)[:-2], q, q)))
    given = {key: value for key, value in zip(VectorWeights._fields, weights, strict=True) if value is not None}
    arrays = as_float64(given, name)
    shapes = {key: value.shape for key, value in arrays.items()}
    batch, (n, q) = shapes["b"][:-1], shapes["W"][-2:] if len(shapes["W"]) > 1 else (-1, -1)
    last = shapes["V"][-2] if len(shapes.get("V", ())) > 1 else n
    expected = {"R": (q, q), "A": (q, last), "W": (n, q), "W2": (n, *shapes["W2"][-1:]), "b": (n,)}
    if "V" in arrays or "c" in arrays:
        expected |= {"V": (last, n), "c": (last,)}
    if shapes != {key: (*batch, *shape) for key, shape in expected.items()} or n < 1 or last < 1:
        listed = ", ".join(f"{key} {value}" for key, value in shapes.items())
        raise CertifyError(
            f"{name}: found the shapes {listed}, expected R (q, q), A (q, n), W (n, q), W2 (n, m), b (n,) with q and n "
            "of 1 or more; with a second hidden layer V (l, n), c (l,) and A (q, l)"
        )
    checked = VectorWeights(**arrays)
    most_states = MOST_RECURRENT if is_recurrent(checked) else MOST_STATES
    if not 1 <= q <= most_states:
        raise CertifyError(f"{name}: found a state of {q} components, expected 1 to {most_states}")
    return checked


def is_recurrent(weights: VectorWeights) -> bool:
    """Whether x⁺ = φ(W x + W₂ u + b): one hidden layer, A = I and R = 0; of checked weights."""
    A, R = np.asarray(weights.A), np.asarray(weights.R)
    return weights.V is None and A.shape[-1] == A.shape[-2] and not R.any() and bool((A == np.eye(A.shape[-1])).all())


def refuse_large(weights: VectorWeights, name: str = "weights") -> None:
    """Refuse weights whose products along the layers, and their sums, may exceed a float."""
    largest = LARGEST if weights.V is None else LARGEST_OF_TWO
    if (size := max(np.abs(x).max(initial=0.0) for x in weights if x is not None)) > largest:
        raise CertifyError(f"{name}: found a weight of {size:.3g}, expected none above {largest:g}")


def of_shallow(weights: ShallowWeights) -> VectorWeights:
    """The paper's network as one with a vector state, q = 1."""
    a, w1 = np.asarray(weights.a, dtype=np.float64), np.asarray(weights.w1, dtype=np.float64)
    return check(VectorWeights(None, a[..., None, :], w1[..., None], weights.W2, weights.b))


def digest(weights: VectorWeights) -> str:
    """The sha256 of one network's weights, which a certificate is about."""
    total = hashlib.sha256(b"vector")
    for name, array in zip(VectorWeights._fields, check(weights), strict=True):
        if array is not None:
            total.update(f"{name}{array.shape}".encode() + np.ascontiguousarray(array + 0.0).astype("<f8").tobytes())
    return total.hexdigest()


def from_tensors(
    tensors: Mapping[str, Any], path: str = "tensors", phi: Activation | None = None, most: float = math.inf
) -> list[VectorNetwork]:
    """Every network (1) among named tensors, one batch element after the other; empty where there is none.

    Names end in `A`, `W`, `W2`, `b` after a common prefix, with `R` where there is a skip connection, and `V`, `c`
    where there is a second hidden layer. The linear layers of a torch module are accepted, too: two or three, the first
    with (n, q + m) weights, those of the state first, the last with (q, n) and no bias; and so are torch.nn.RNN and
    RNNCell, beside which linear layers are not read. There may be `most` networks.

    Without φ it is relu, and tanh of torch.nn.RNN, as in torch.
    """
    recurrent = of_torch(tensors, path)
    pairs = [(each.prefix, VectorWeights(None, np.eye(len(each.b)), each.W, each.W2, each.b)) for each in recurrent]
    phi = phi or (TANH if recurrent else RELU)
    for prefix in [name.removesuffix("W") for name in tensors if re.search(r"(^|\.)W$", name)]:
        if lacking := [prefix + name for name in REQUIRED if prefix + name not in tensors]:
            raise CertifyError(f"{path}: holds {prefix}W but no {', '.join(lacking)}: expected A, W, W2 and b together")
        named = {name: tensors.get(prefix + name) for name in VectorWeights._fields}
        pairs.append((prefix.rstrip("."), VectorWeights(**named)))
    pairs = pairs or [("", each) for each in _layers(tensors, path)]
    networks: list[VectorNetwork] = []
    for prefix, weights in pairs:
        label = path if len(pairs) == 1 else f"{path}:{prefix}"
        arrays = check(weights, label)
        refuse_large(arrays, label)
        refuse_many(len(networks) + math.prod(arrays.b.shape[:-1]), most, label)
        for element in np.ndindex(arrays.b.shape[:-1]):
            part = VectorWeights(*(None if x is None else x[element] for x in arrays))
            name = f"[{','.join(map(str, element))}]" if element else ""
            networks.append(VectorNetwork(label + name, part, phi))
    return networks


def _layers(tensors: Mapping[str, Any], path: str) -> list[VectorWeights]:
    """The network of two or three linear layers, if the tensors are such with q > 1 or two hidden layers."""
    layers = [(name.removesuffix("weight"), x) for name, x in tensors.items() if re.search(r"(^|\.)weight$", name)]
    if len(layers) not in (2, 3) or any(np.ndim(x) != 2 for _, x in layers):
        return []
    (first, W), *middle, (last, A) = layers
    W, A = np.asarray(W), np.asarray(A)
    q = len(A)
    if len(layers) == 2 and q == 1:
        return []  # a shallow network of one state
    if W.shape[1] < q or len(W) != (np.asarray(middle[0][1]) if middle else A).shape[1]:
        shapes = ", ".join(str(np.shape(x)) for _, x in layers)
        raise CertifyError(f"{path}: found linear layers of the shapes {shapes}, expected (n, q + m), …, (q, n)")
    if (offset := tensors.get(f"{last}bias")) is not None and np.any(np.asarray(offset)):
        raise CertifyError(f"{path}: {last}bias is not zero, expected x⁺ = A φ(…) without an offset")
    bias = tensors.get(f"{first}bias")
    weights = VectorWeights(None, A, W[:, :q], W[:, q:], np.zeros(len(W)) if bias is None else bias)
    for name, V in middle:
        c = tensors.get(f"{name}bias")
        weights = weights._replace(V=V, c=np.zeros(len(V)) if c is None else c)
    return [weights]


def read_both(
    path: str | Path, phi: Activation | None = None, as_vectors: bool = False, most: float = math.inf
) -> tuple[list[Network], list[VectorNetwork]]:
    """The shallow networks and the networks (1) in a file.

    With another activation than relu, or `as_vectors`, all are of the second kind. The activation is the one that the
    file states, or else relu, unless it is given. A CertifyError as of `shallow.load`, if both differ, or if there are
    more than `most` of a kind.
    """
    tensors = read_tensors(path)
    if (stated := stated_activation(path)) is not None:
        with about(str(path)):
            named = activation(stated)
        if phi not in (None, named):
            raise CertifyError(f"{path}: states the activation {named}, found --activation {phi}: leave it out")
        phi = named
    vectors = from_tensors(tensors, str(path), phi, most)
    shallow = [] if vectors and not holds_shallow(tensors) else shallow_networks(tensors, str(path), most)
    if phi in (None, RELU) and not as_vectors:
        return shallow, vectors
    return [], vectors + [VectorNetwork(each.path, of_shallow(each.weights), phi or RELU) for each in shallow]
