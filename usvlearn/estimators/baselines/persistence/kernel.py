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
def learn(node, s, q, x, estimate, target, work):
    """`Persistence.update`."""
    s[node[AT.surge]] = target
