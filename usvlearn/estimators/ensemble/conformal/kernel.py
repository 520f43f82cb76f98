"""Prediction intervals: the step of `layer`."""

import numpy as np

from usvlearn.core.family import Node
from usvlearn.core.jit import jit
from usvlearn.estimators.ensemble.conformal.state import AT, FEW, Number


@jit
def published(node, s, found):
    """`layer.published`, into `found`."""
    for i in range(node[Node.SIZE]):
        found[i] = np.inf if s[node[AT.count] + i] < FEW else s[node[AT.halfwidth] + i]


@jit
def conformal(node, s, q, innovation):
    """`conformal_step`, in place."""
    k, numbers = node[Node.SIZE], q[node[Node.NUMBERS] :]
    halfwidth, count = s[node[AT.halfwidth] : node[AT.halfwidth] + k], s[node[AT.count] : node[AT.count] + k]
    seen, narrower, wider = -1.0, 1.0, 1.0
    for i in range(k):
        if np.isfinite(innovation[i]):
            count[i] += 1
            if count[i] != seen:  # usually it is the same for all
                seen = count[i]
                rate = numbers[Number.RATE] + numbers[Number.BOOST] / seen
                narrower = np.exp(-rate * (1 - numbers[Number.COVERAGE]))
                wider = np.exp(rate * numbers[Number.COVERAGE])
            moved = halfwidth[i] * (wider if abs(innovation[i]) > halfwidth[i] else narrower)
            halfwidth[i] = max(moved, numbers[Number.LEAST])
