"""Memory of the step before: the parts of `WithMemory` before and after the steps of its estimator."""

from usvlearn.core.arrays import clamp, copy
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, LEFT_BEFORE, RIGHT, RIGHT_BEFORE, SURGE, SURGE_DOT
from usvlearn.estimators.wrappers.memory.state import AT, Number


@jit
def start(node, s, surge):
    """`WithMemory.start`."""
    s[node[AT.surge_dot]], s[node[AT.surge]], s[node[AT.since]] = 0.0, surge, 0.0
    s[node[AT.estimate]], s[node[AT.known]] = surge, 0.0


@jit
def recall(node, s, row, x):
    """Write the inputs of a step, and those of the step before."""
    copy(x[:SURGE], row[:SURGE])
    known = s[node[AT.known]] > 0
    x[SURGE_DOT] = s[node[AT.surge_dot]]
    x[LEFT_BEFORE] = s[node[AT.command_left]] if known else x[LEFT]
    x[RIGHT_BEFORE] = s[node[AT.command_right]] if known else x[RIGHT]


@jit
def remember(node, s, q, x, surge, learned):
    """Store this step, whose `surge` was measured (`learned`) or predicted, for the next one."""
    s[node[AT.since]] += x[DT]
    span = s[node[AT.since]] if learned else x[DT]
    change = surge - s[node[AT.surge if learned else AT.estimate]]
    limit = q[node[Row.NUMBERS] :][Number.SURGE_DOT_MAX]
    s[node[AT.surge_dot]] = clamp(change / (span if span > 0 else 1.0), limit)
    if learned:
        s[node[AT.surge]], s[node[AT.since]] = surge, 0.0
    s[node[AT.estimate]], s[node[AT.known]] = surge, 1.0
    s[node[AT.command_left]], s[node[AT.command_right]] = x[LEFT], x[RIGHT]
