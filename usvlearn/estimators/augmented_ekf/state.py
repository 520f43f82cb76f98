"""An extended Kalman filter whose state is augmented by parameters: what the joint EKF and the axis EKF share.

    x = [y, b, (c_N, c_E,) θ, μ]

y is measured, b is a slow disturbance, c the current (of the joint EKF alone), θ holds the parameters of the dynamics
of y, and μ the share of a step by which a command acts late. The equations are those of
`usvlearn.estimators.joint.state`; a family adds its dynamics, and what follows from them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import NOT_NEGATIVE, POSITIVE, TRIANGLE, Family, Range, leaf

if TYPE_CHECKING:
    from torch import Tensor

Y, B = range(2)  # places in x
NOISE, NOISE_LEAST, NOISE_SHARE, NOISE_COUNT, NOISE_MOST = 0.03, 1e-4, 0.005, 20.0, 9.0  # of σ: unit of y; of (6)
FIRST_DISTURBANCE = 1e-2  # variance of b before the first step, (m/s²)² or (rad/s²)²
STEP, OWN_NOISE = 0.4, 0.05  # s, for which the noise of y and b is stated; that of y, in σ²
EVERY = 4  # steps from one parameter's walk to the next's
REST = 1e-3  # sum of the squares of commands and speeds below which a boat is at rest
LONGEST, MOST = 10.0, 20.0  # s of a step from which something is learned; y, m/s or rad/s
DECAYED = 20.0  # exponent of the longest decay, so that no factor of P is 0
LAG_LEAST, LAG_MOST = -0.5, 1.5
LOOSEST = 100.0  # times the prior, to which `inflate_covariance` lifts the mean variance of the parameters at most


class FilterState(NamedTuple):
    """The leaves with which the state of such a filter begins."""

    mean: Tensor  # (*batch, n) x
    factor: Tensor  # (*batch, n, n) U and D, a column of U in each row: U_ij at [j, i] for i < j, D_j at [j, j], else 0
    noise: Tensor  # (*batch,) σ²
    updates: Tensor  # (*batch,) count of update steps, without those at rest
    surge: Tensor  # (*batch,) measured y with which the last segment started
    started: Tensor  # (*batch,) bool: no step since then
    commands: Tensor  # (*batch, 2) of the last step, left and right
    turn: Tensor  # (*batch,) steps in the round in which each parameter gets random-walk noise once
    deviation: Tensor  # (*batch,) standard deviation of the last prediction


def leaves(n: int) -> FilterState:
    """These leaves, of a filter of size n."""
    return FilterState(
        mean=leaf(n),
        factor=leaf(n, n, legal=TRIANGLE),
        noise=leaf(legal=POSITIVE),
        updates=leaf(legal=NOT_NEGATIVE),
        surge=leaf(),
        started=leaf(flag=True),
        commands=leaf(2),
        turn=leaf(legal=Range(0.0, EVERY * n, index=True)),
        deviation=leaf(legal=NOT_NEGATIVE),
    )


AT = Family((), leaves).at
FROZEN = ("mean", "surge", "started", "commands")  # the leaves that an open-loop simulation needs
