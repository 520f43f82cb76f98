"""Reads the prediction of a member without a kernel, which other code has made."""

from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import ROW
from usvlearn.estimators.external.state import Choice


@jit
def start(node, s, q, surge):
    """Nothing changes."""


@jit
def predict(node, s, q, x, work):
    """The prediction that was handed over, m/s; NaN: it is inactive."""
    surge = x[ROW + node[Choice.COLUMN]]
    return surge, surge


@jit
def coast(node, s, q, x, predicted, work):
    """Nothing changes."""


@jit
def learn(node, s, q, x, estimate, target, work):
    """Nothing changes."""
