"""Scales a network with a vector state so that its numbers have one size, for a solver in floats.

For diagonal C, T with positive entries and a number s, (T R T⁻¹/s, T A C⁻¹/s, C W T⁻¹) has the rate κ/s in the norm
√(xᵀ P' x) with the multipliers Λ' iff (R, A, W) has the rate κ with P = T P' T and Λ = s² C Λ' C. With two hidden
layers V becomes C₁ V C₀⁻¹. C, T and s are powers of two here, so that nothing is rounded and short fractions remain
short.
"""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from certify.networks.vector import VectorWeights
from certify.proofs.vector_exact import Proof

FAINT = 2.0**-20  # the weights of a neuron without an effect, for which λ = 1 takes about FAINT² from the margin
ROUNDS = 20  # of balancing two hidden layers
FARTHEST = 1000  # |log₂ c_i|


class Balanced(NamedTuple):
    """An equal network with a rate near 1, and what leads back."""

    R: np.ndarray  # (q, q)
    layers: list[np.ndarray]  # W, V if there is one, A; without the neurons that have no effect
    state: np.ndarray  # T's diagonal, (q,)
    neurons: list[np.ndarray]  # C's diagonal for each hidden layer, of all neurons
    alive: list[np.ndarray]  # the neurons that have an effect, for each hidden layer
    size: float  # s

    def proof(self, P: list[list[Fraction]], multipliers: list[list[Fraction]]) -> Proof:
        """P and Λ for the weights as given, from P' and from Λ' of the neurons with an effect."""
        t, square = [Fraction(x) for x in self.state], Fraction(self.size) ** 2
        lams = []
        for c, alive, lam in zip(self.neurons, self.alive, multipliers, strict=True):
            rest = iter(lam)
            lams.append([square * Fraction(x) ** 2 * (next(rest) if y else 1) for x, y in zip(c, alive, strict=True)])
        return Proof([[a * b * x for b, x in zip(t, row, strict=True)] for a, row in zip(t, P, strict=True)], lams)


def balance(weights: VectorWeights) -> Balanced:
    """The equal network in which what enters and what leaves a state or a neuron have one size; of checked weights.

    A neuron that the state does not reach, or that does not reach the next state, is left out.
    """
    hidden = [weights.W] if weights.V is None else [weights.W, weights.V]
    reached, leads = [_largest(weights.W, 1) > 0], [_largest(weights.A, 0) > 0]
    if weights.V is not None:
        reached.append(_largest(weights.V[:, reached[0]], 1) > 0)
        leads.insert(0, _largest(weights.V[leads[0]], 0) > 0)
    alive = [x & y for x, y in zip(reached, leads, strict=True)]

    ins, outs = _largest(weights.W[alive[0]], 0), _largest(weights.A[:, alive[-1]], 1)
    both = (ins > 0) & (outs > 0)
    state = _ratio(ins, outs, root=2)
    middle = np.round(np.log2(state[both]).mean()) if both.any() else 0.0
    state = np.where(both, state / np.exp2(middle), 1.0)
    used = [np.ones(len(state), bool), *alive, np.ones(len(state), bool)]

    def scaled(state: np.ndarray) -> tuple[float, np.ndarray, list[np.ndarray], np.ndarray]:
        R, total = state[:, None] * weights.R / state, np.eye(len(state))
        maps = [hidden[0] / state, *hidden[1:], weights.A * state[:, None]]
        for X, (columns, rows) in zip(maps, itertools.pairwise(used), strict=True):
            total = np.abs(X[np.ix_(rows, columns)]) @ total
        norm = np.array(np.linalg.norm(R, 2) + np.linalg.norm(total, 2) / 2)
        return _ratio(norm, np.ones(())).item(), R, maps, state

    size, R, maps, state = min(scaled(np.ones(len(state))), scaled(state), key=lambda pair: pair[0])
    maps[-1] = maps[-1] / size
    layers = [X[np.ix_(rows, columns)] for X, (columns, rows) in zip(maps, itertools.pairwise(used), strict=True)]
    neurons = [np.ones(len(x)) for x in alive]
    for _ in range(1 if weights.V is None else ROUNDS):
        for k, here in enumerate(alive):
            c = _ratio(_largest(layers[k + 1], 0), _largest(layers[k], 1), root=2)
            neurons[k][here] *= c
            layers[k], layers[k + 1] = layers[k] * c[:, None], layers[k + 1] / c
    _make_faint(maps, neurons, reached, leads)
    return Balanced(R / size, layers, state, neurons, alive, size)


def _make_faint(
    maps: list[np.ndarray], c: list[np.ndarray], reached: list[np.ndarray], leads: list[np.ndarray]
) -> None:
    """The c_i of the neurons without an effect, such that the weights on their one side with an effect are FAINT."""
    last = len(c) - 1
    for k in range(last + 1):  # what enters a neuron that leads nowhere
        entering = maps[0] if k == 0 else (maps[k] / c[k - 1])[:, reached[k - 1]]
        here = ~leads[k]
        c[k][here] = _ratio(np.full(here.sum(), FAINT), _largest(entering[here], 1))
    for k in range(last, -1, -1):  # what leaves a neuron that the state does not reach
        leaving = maps[k + 1] if k == last else maps[k + 1] * c[k + 1][:, None]
        here = ~reached[k] & leads[k] if k else ~reached[k]
        c[k][here] = _ratio(_largest(leaving[:, here], 0), np.full(here.sum(), FAINT))


def _ratio(above: np.ndarray, below: np.ndarray, root: int = 1) -> np.ndarray:
    """The power of two nearest to the root of above/below; 1 where one of them is 0."""
    both = (above > 0) & (below > 0)
    logarithm = np.log2(np.where(both, above, 1.0)) - np.log2(np.where(both, below, 1.0))
    return np.exp2(np.clip(np.round(logarithm / root), -FARTHEST, FARTHEST))


def _largest(X: np.ndarray, axis: int) -> np.ndarray:
    return np.abs(X).max(axis, initial=0.0)
