"""The joint EKF: an extended Kalman filter over the speed, a disturbance, the current and the parameters.

Equations (1) to (10) and their sources: `docs/theory/estimators.md#joint-ekf`; all quantities are per unit mass. The
covariance is kept in the factors of `usvlearn.estimators.ud_factorization`. The filter that predicts lies in `mean`,
`factor`, `noise` and `updates`; during a trial the other one lies in `trial`. The periodic estimates in `reading`
become intervals by `periodic_estimates`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

from usvlearn.core.family import (
    FINITE,
    MODEST,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_OR_INFINITE,
    TRIANGLE,
    UNIT,
    Family,
    Options,
    Parameters,
    ParameterVectors,
    Range,
    leaf,
)
from usvlearn.estimators.augmented_ekf.state import FROZEN, leaves
from usvlearn.estimators.regressors.terms import CUBIC, EVEN, LAG, SURGE

if TYPE_CHECKING:
    from torch import Tensor

W, B, NORTH, EAST, THETA = range(5)  # places in x; κ, e and μ follow the nine of θ
KAPPA = THETA + len(SURGE)
E = KAPPA + len(CUBIC)
SIZES = (E + 1, E + len(EVEN) + 1)  # n without and with fore-aft asymmetry terms
SPEED_VARIANCE, CURRENT_VARIANCE = 4.0, 0.05**2  # m²/s² at a start
DROPPED, AGEING = 3.0, 0.9  # periodic estimates; their weight from one to the next
INNOVATION_MOST, USUAL_MOST, USUAL_SHARE, OFFSET, USUALLY = 25.0, 4.0, 0.005, 0.5, 2.0  # of (8)
SUSPECT, WARM, KEPT = 2.0, 150.0, 20.0  # g from which the second filter runs; update steps before; steps to begin in
TRUSTED = 100.0  # D from which open-loop simulations depart from the second filter
ROOM = 4.0  # times its prior: the most to which (9) lifts a variance


class TrialState(NamedTuple):
    """The filter that does not predict, and what speaks for a change."""

    mean: Tensor  # (*batch, n)
    factor: Tensor  # (*batch, n, n)
    noise: Tensor  # (*batch,) m²/s²
    updates: Tensor  # (*batch,)
    statistic: Tensor  # (*batch,) g of (8)
    last: Tensor  # (*batch,) z₋
    usual: Tensor  # (*batch,) ū
    evidence: Tensor  # (*batch,) D of (10)
    best: Tensor  # (*batch,) its greatest value in this trial
    run: Tensor  # (*batch,) steps that the second filter has run beside the first; 0: it is the state before the step
    tried: Tensor  # (*batch,) steps of the trial; 0: there is none
    leads: Tensor  # (*batch,) 1 where the second filter predicts, so that it lies in `JointState.mean`, else 0
    early: Tensor  # (*batch,) 1 where it predicts, but open-loop simulations still depart from the first one, else 0
    changes: Tensor  # (*batch,) count of confirmed changes
    since: Tensor  # (*batch,) s of update steps since the last one, or since the start
    kept: Tensor  # (*batch, n − 4) parameters where the second filter began, in the order of x
    before: Tensor  # (*batch, n − 4) likewise, of the last confirmed change
    past_mean: Tensor  # (*batch, 2, n) x of the last two copies, the older one first (`ensemble.accommodation`)
    past_factor: Tensor  # (*batch, 2, n, n) likewise `factor`
    past_noise: Tensor  # (*batch, 2) m²/s²


class JointState(NamedTuple):
    """The state of the joint EKF."""

    mean: Tensor  # (*batch, n) x
    factor: Tensor  # (*batch, n, n) U and D, a column of U in each row: U_ij at [j, i] for i < j, D_j at [j, j], else 0
    noise: Tensor  # (*batch,) σ², m²/s²
    updates: Tensor  # (*batch,) count of update steps, without those at rest
    surge: Tensor  # (*batch,) measured speed with which the last segment started, m/s
    started: Tensor  # (*batch,) bool: no step since then
    commands: Tensor  # (*batch, 2) of the last step, left and right
    turn: Tensor  # (*batch,) steps in the round in which each parameter gets random-walk noise once
    deviation: Tensor  # (*batch,) standard deviation of the last prediction, m/s
    learned: Tensor  # (*batch,) s of such steps since the last periodic estimate
    readings: Tensor  # (*batch,) count of periodic estimates, with those that were dropped
    weight: Tensor  # (*batch,) sum of the weights of the periodic estimates
    reading: Tensor  # (*batch, n − 4) θ̄: mean of the parameters read, in the order of x
    spread: Tensor  # (*batch, n − 4, n − 4) C: their covariance
    trial: TrialState | dict[str, Any] = {}  # {} without trials  # noqa: RUF012

    @property
    def covariance(self) -> Tensor:
        """P = U D Uᵀ, `(*batch, n, n)`."""
        D = self.factor.diagonal(dim1=-2, dim2=-1)
        U = self.factor.tril(-1).mT + D.new_ones(D.shape[-1]).diag()
        return (U * D[..., None, :]) @ U.mT


def names(even: bool) -> tuple[str, ...]:
    """The names of the parameters, in the order of x."""
    return (*SURGE, *CUBIC, *(EVEN if even else ()), LAG)


class Number(Parameters):
    """Hyperparameters and constants, in the units of the arguments of `JointEKF`."""

    DISTURBANCE = POSITIVE  # q_b
    DISTURBANCE_TIME = POSITIVE  # τ_b
    CURRENT = POSITIVE  # σ_c
    CURRENT_TIME = POSITIVE  # τ_c
    DRIFT_TIME = POSITIVE  # T_θ
    OUTLIER = POSITIVE_OR_INFINITE  # k
    ESTIMATE_EVERY = POSITIVE_OR_INFINITE
    MASS = MODEST  # kg: for the units of what is read
    THRESHOLD = POSITIVE, 12.0  # of g; this one and the next six are of trials
    LEADS = FINITE, 5.0
    CONFIRMED = POSITIVE, 150.0
    DROPPED = FINITE, -2.0
    FALLEN = POSITIVE, 4.0
    SIDE = NOT_NEGATIVE, 0.6  # s of (9)
    EACH = NOT_NEGATIVE, 0.3  # r


class Vector(ParameterVectors):
    """One number for each parameter."""

    VARIANCE = POSITIVE, lambda size: size - THETA  # prior
    PRIOR = FINITE, lambda size: size - THETA  # mean, per unit mass
    INVERSE_MASS = FINITE, lambda size: size - THETA  # g of 1/m = gᵀθ; zeros where the mass is an assumption


class Choice(Options):
    """Choices."""

    EVEN = False, True
    TRIAL_STEPS = Range(0, 10**6), 0  # the longest trial; 0: there is none


def trial(n: int, steps: int) -> TrialState | dict[str, Any]:
    """The leaves of trials of so many steps at most; none without."""
    if not steps:
        return {}
    count = leaf(legal=NOT_NEGATIVE)
    return TrialState(
        mean=leaf(n),
        factor=leaf(n, n, legal=TRIANGLE),
        noise=leaf(legal=POSITIVE),
        updates=count,
        statistic=count,
        last=leaf(),
        usual=count,
        evidence=leaf(),
        best=leaf(),
        run=count,
        tried=count,
        leads=leaf(legal=UNIT),
        early=leaf(legal=UNIT),
        changes=count,
        since=count,
        kept=leaf(n - THETA),
        before=leaf(n - THETA),
        past_mean=leaf(2, n),
        past_factor=leaf(2, n, n, legal=TRIANGLE),
        past_noise=leaf(2, legal=POSITIVE),
    )


FAMILY = Family(
    ("joint",),
    lambda n, steps: JointState(
        *leaves(n),
        learned=leaf(legal=NOT_NEGATIVE),
        readings=leaf(legal=NOT_NEGATIVE),
        weight=leaf(legal=NOT_NEGATIVE),
        reading=leaf(n - THETA),
        spread=leaf(n - THETA, n - THETA, legal=FINITE),
        trial=trial(n, steps),
    ),
    Number,
    Choice,
    Vector,
    size=lambda own: SIZES[own["even"]],
    lengths=(Choice.TRIAL_STEPS,),
    work=lambda n: 4 * n + 2,
    heading=lambda own: True,
    frozen=FROZEN,
    instead={"mean": ("trial.mean", "trial.early")},
)
AT = FAMILY.at
AT_TRIAL = cast("TrialState", AT.trial)
