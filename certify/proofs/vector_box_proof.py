"""Replay of a proof about a network with a vector state on a box, in integers: nothing here trusts the search.

A proof is a binary tree that halves the box, as text in preorder, its tokens separated by blanks:

    x1, x2, …, u1, u2, …   halve the box along that coordinate (`x` where the state has one component), at
                           (lo + hi)/2 in binary64: the lower half's proof follows, then the upper's
    .                      a leaf: the bound is computed there

On a leaf every slope d_i of φ lies in an interval (`certify.proofs.vector_slopes`), and with one hidden layer

    ‖J‖_∞ ≤ max_r max_{ε ∈ {±1}^q}  [R ε]_r + Σ_i max(d_i A_ri (W ε)_i)                                (1)

after the scaling by T; ‖J‖_1 is that of the transposed matrices. Each (r, ε) is the bound of one scalar slope on the
same hyperplanes z_i = 0. Neurons that share a hyperplane are merged: of relu(z) and relu(−z) just one is on. So (1) is
exact where no hyperplane crosses the leaf, and on the whole leaf if all are crossed and every pattern occurs. With two
hidden layers the first layer's intervals are propagated to the second, for each ε.

The bound of the box is the greatest of its leaves. It is a Lipschitz constant of x ↦ f(x, u) in the norm: for x and x′
in the box the segment between them, at one u, is cut by the leaves, and ‖J‖ is bounded on each part.

A tree may come from anybody, so the effort is limited: at most HALVINGS halvings on a path, and at most WORK products.
A tree beyond these limits is refused.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from certify.networks.vector import Activation, VectorWeights
from certify.proofs.box_planes import Box, region
from certify.proofs.box_proof import HALVINGS
from certify.proofs.vector_exact import Matrix
from certify.proofs.vector_statements import NODE, WORK, Range, Statement, slopes_on


def bound(
    weights: VectorWeights,
    phi: Activation,
    box: Box,
    tree: str,
    norm: str = "inf",
    scaling: Matrix | None = None,
) -> Fraction | None:
    """An upper bound of the rate on a box: the greatest bound of a tree's leaves; None where the tree is refused.

    Args:
        weights: of one network, checked.
        phi: its activation.
        box: `(q + m,)`, x first; every component of x has a width.
        tree: in the language of this module.
        norm: "inf" or "one".
        scaling: T, `(q, q)`; the identity by default.

    >>> from certify.networks.vector import RELU, check
    >>> half = check(VectorWeights(None, [[0.5]], [[1.0]], np.zeros((1, 0)), [0.0]))
    >>> bound(half, RELU, Box(np.zeros(1), np.ones(1)), "."), bound(half, RELU, Box(np.zeros(1), np.ones(1)), "x .")
    (Fraction(1, 2), None)
    """
    if not usual(weights, box):
        return None
    statement = slopes_on(weights, phi, box, norm, scaling)
    found = _replay(tree, box, weights, statement)
    return None if found is None else Fraction(found, statement.unit)


def proves(
    weights: VectorWeights,
    phi: Activation,
    box: Box,
    tree: str,
    rate: float | Fraction,
    norm: str = "inf",
    scaling: Matrix | None = None,
) -> bool:
    """Whether a tree proves that the rate on a box is below `rate`; arguments as of `bound`.

    >>> from certify.networks.vector import RELU, check
    >>> half = check(VectorWeights(None, [[0.5]], [[1.0]], np.zeros((1, 0)), [0.0]))
    >>> [proves(half, RELU, Box(np.zeros(1), np.ones(1)), ".", rate) for rate in (0.6, 0.5)]
    [True, False]
    """
    if not usual(weights, box):
        return False
    statement = slopes_on(weights, phi, box, norm, scaling)
    limit = math.ceil(Fraction(rate) * statement.unit)  # an integer is below both or below neither
    return _replay(tree, box, weights, statement, limit) is not None


def proves_range(weights: VectorWeights, phi: Activation, box: Box, tree: str) -> bool:
    """Whether a tree proves that f maps the box into the box's intervals of x. Every φ lies between two lines.

    >>> from certify.networks.vector import RELU, check
    >>> identity = check(VectorWeights(None, [[1.0]], [[1.0]], np.zeros((1, 0)), [0.0]))
    >>> [proves_range(identity._replace(b=np.array([b])), RELU, Box(np.zeros(1), np.ones(1)), ".") for b in (0.0, 0.5)]
    [True, False]
    """
    return usual(weights, box) and _replay(tree, box, weights, Range(weights, phi, box), 1) is not None


def usual(weights: VectorWeights, box: Box) -> bool:
    """Whether a box has finite ends, in order, for every coordinate, and each component of x has a width."""
    q, shape = len(weights.R), (len(weights.R) + np.shape(weights.W2)[1],)
    if np.shape(box.lo) != shape or np.shape(box.hi) != shape:
        return False
    ends = np.isfinite(box.lo).all() and np.isfinite(box.hi).all() and (box.lo <= box.hi).all()
    return bool(ends and (box.lo[:q] < box.hi[:q]).all())


def coordinates(q: int, m: int) -> list[str]:
    """The names of a box's coordinates.

    >>> coordinates(2, 1), coordinates(1, 0)
    (['x1', 'x2', 'u1'], ['x'])
    """
    return [*(["x"] if q == 1 else [f"x{j}" for j in range(1, q + 1)]), *(f"u{j}" for j in range(1, m + 1))]


def _replay(tree: str, box: Box, weights: VectorWeights, statement: Statement, limit: int | None = None) -> int | None:
    """The greatest bound of a tree's leaves; None where the text is no tree, or a bound is not below the limit."""
    q, width = len(weights.R), len(box.lo)
    tokens = tree.split() if isinstance(tree, str) and tree.isascii() else []
    places = {name: j for j, name in enumerate(coordinates(q, width - q))}
    halvings = _halvings(tokens, places)
    if halvings is None or halvings > HALVINGS:
        return None
    whole = region(box, halvings)
    pending = [(whole, statement.start(whole))]
    greatest = None
    for token in tokens:
        here, state = pending.pop()
        statement.work += NODE
        if token == ".":
            found = statement.leaf(here, state)
            if limit is not None and found >= limit:
                return None
            greatest = found if greatest is None else max(greatest, found)
        else:
            j = places[token]
            halves = here.halves(j)
            if halves is None:
                return None
            pending += [(half, statement.halve(state, j, here, half)) for half in reversed(halves)]
        if statement.work > WORK:
            return None
    return greatest


def _halvings(tokens: list[str], places: dict[str, int]) -> int | None:
    """The most halvings on a path; None where the tokens are no tree."""
    pending, most = [0], 0
    for token in tokens:
        if not pending or (token != "." and token not in places):
            return None
        count = pending.pop()
        if token != ".":
            pending += [count + 1, count + 1]
            most = max(most, count + 1)
    return None if pending else most
