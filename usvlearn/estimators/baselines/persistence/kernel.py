"""Persistence: the step of `layer`."""

from usvlearn.core.jit import jit
from usvlearn.estimators.baselines.persistence.state import AT


@jit
def start(node, s, q, surge):
    """`Persistence.start`."""
    s[node[AT.surge]] = surge


@jit
def predict(node, s, q, x, work):
    """`Persistence.predict`."""
    surge = s[node[AT.surge]]
    return surge, surge


@jit
def coast(node, s, q, x, predicted, work):
    """Nothing changes."""


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it; returns the speed, m/s."""
    return s[node[AT.surge]]


@jit
def learn(node, s, q, x, estimate, target, work):
    """`Persistence.update`."""
    s[node[AT.surge]] = target
