"""The batch fit as a member of forecasts: a step of its motion, in copies of a joint EKF's leaves.

At an origin the copies have the speed through the water w, the disturbance b and the current of the joint EKF. From
then on the boat moves as the batch fit has found it, with T and D linear between the points of a table:

    f = D(w) + c |r| w + Σ (T(ξ) + (γ |w| + e w) ξ) + b,   w⁺ = w + h φ₁(hJ) f,   J = ∂f/∂w

(`usvlearn.model.fit.terms`, (1)). The commands ξ are late by a time: μ in (2) of `joint.state` is that time over h.
"""

from usvlearn.core.arrays import clamp
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN, YAW_RATE
from usvlearn.estimators.augmented_ekf.kernel import decay
from usvlearn.estimators.augmented_ekf.state import MOST
from usvlearn.estimators.ensemble.forecasts import state as fit
from usvlearn.estimators.joint.kernel import move
from usvlearn.estimators.joint.state import AT, EAST, NORTH, B, Number, W
from usvlearn.estimators.regressors.kernel import phi1


@jit
def between_points(points, count, share):
    """Value and slope at a share of −1 … 1 of the last of `count` points, evenly spread; the outer lines go on."""
    place, k = (share + 1) * (count - 1) / 2, 0
    if place > 0:  # NaN is not
        k = int(min(place, count - 2.0))
    rise = points[k + 1] - points[k]
    return points[k] + (place - k) * rise, rise * (count - 1) / 2


@jit
def fitted_step(node, slot, q, table, x):
    """One step of a boat with this table; `node` is the row of the joint EKF's copies. Returns the speed, m/s."""
    mean, commands, numbers = slot[node[AT.mean] :], node[AT.commands], q[node[Row.NUMBERS] :]
    along = x[COS] * mean[NORTH] + x[SIN] * mean[EAST]
    w, b, left, right = mean[W], mean[B], slot[commands], slot[commands + 1]
    if slot[node[AT.started]] > 0:
        w, b, left, right = slot[node[AT.surge]] - along, 0.0, x[LEFT], x[RIGHT]
        slot[node[AT.started]] = 0.0
    late, turn, sign = min(table[fit.LATE] / x[DT], fit.LATEST), abs(x[YAW_RATE]), 1.0 if w >= 0 else -1.0
    f, J = between_points(table[fit.DRAG :], fit.SPEEDS, w / table[fit.SPEED])
    f, J = f + table[fit.CROSS] * turn * w + b, J / table[fit.SPEED] + table[fit.CROSS] * turn
    for side in range(2):
        now, before = (x[LEFT], left) if side == 0 else (x[RIGHT], right)
        xi = now + late * (before - now)
        thrust, _ = between_points(table[fit.THRUST + side * fit.COMMANDS :], fit.COMMANDS, xi / table[fit.COMMAND])
        more, even = table[fit.MORE + 2 * side], table[fit.MORE + 2 * side + 1]
        f += thrust + (more * abs(w) + even * w) * xi
        J += (more * sign + even) * xi
    speed = w + x[DT] * phi1(min(x[DT] * J, 1.0))[0] * f
    mean[B] = b
    current = decay(x[DT], numbers[Number.CURRENT_TIME])
    move(mean, speed, decay(x[DT], numbers[Number.DISTURBANCE_TIME]), current)
    slot[commands], slot[commands + 1] = x[LEFT], x[RIGHT]
    return clamp(speed, MOST) + current * along
