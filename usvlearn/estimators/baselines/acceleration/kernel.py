"""Constant acceleration: the step of `layer`."""

from usvlearn.core.arrays import clamp
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT
from usvlearn.estimators.baselines.acceleration.state import AT, Number


@jit
def start(node, s, q, surge):
    """`Acceleration.start`."""
    s[node[AT.surge]] = s[node[AT.measured]] = surge
    s[node[AT.surge_dot]] = s[node[AT.since]] = 0.0


@jit
def predict(node, s, q, x, work):
    """`Acceleration.predict`: the speed, within its limits and without."""
    estimate = s[node[AT.surge]] + x[DT] * s[node[AT.surge_dot]]
    return clamp(estimate, q[node[Row.NUMBERS] :][Number.SURGE_MAX]), estimate


@jit
def coast(node, s, q, x, predicted, work):
    """The state after `Acceleration.predict`."""
    s[node[AT.surge]] = predicted
    s[node[AT.since]] += x[DT]


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it; returns the speed, m/s."""
    predicted, _ = predict(node, s, q, x, work)
    s[node[AT.surge]] = predicted
    return predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """`Acceleration.update`."""
    since = s[node[AT.since]] + x[DT]
    change = (target - s[node[AT.measured]]) / (since if since > 0 else 1.0)
    s[node[AT.surge_dot]] = clamp(change, q[node[Row.NUMBERS] :][Number.SURGE_DOT_MAX])
    s[node[AT.surge]] = s[node[AT.measured]] = target
    s[node[AT.since]] = 0.0
