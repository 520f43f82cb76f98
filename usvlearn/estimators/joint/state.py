"""The joint EKF: an extended Kalman filter over the speed, a disturbance, the current and the parameters.

State, all per unit mass (n = 16, or 23 with fore-aft asymmetry terms):

    x = [w, b, c_N, c_E, θ (9), κ_L, κ_R, (e (7),) μ]                                                  (1)

w is the speed through the water, m/s; b a slow disturbance, m/s²; c the current, m/s; θ the nine parameters of the
surge dynamics; κ the cubic thrust; e terms that are even in speed and command; μ the share of a step by which a
command acts late. With the commands u, the sum over both sides, and h the length of the step:

    ξ = (1−μ) u_k + μ u_{k−1}
    f = θ_q w|w| + θ_l w + θ_c |r| w + Σ (α ξ + β ξ|ξ| + γ ξ|w| + κ ξ³) + e₀ w² + Σ (e₁|ξ| + e₂ ξ² + e₃ ξ w) + b   (2)
    J = ∂f/∂w,   z = hJ,   φ₁(z) = (e^z − 1)/z
    w⁺ = w + h φ₁(z) f,   b⁺ = e^(−h/τ_b) b,   c⁺ = e^(−h/τ_c) c                                        (3)
    y = w + c_N cos ψ + c_E sin ψ + noise of variance σ²                                                (4)

(3) is the exponential Rosenbrock–Euler step (Hochbruck & Ostermann 2010): exact where f is linear in w, of second
order elsewhere, and stable however stiff the drag. With g = ∂w⁺/∂x the covariance P goes to F P Fᵀ + Q, where F has the
row g, the decays of b and c, and ones; Q is (h/0.4 s) times: 0.05 σ² for w, q_b σ² for b, and for each parameter its
prior variance over T_θ/0.4 s, up to that variance; and σ_c² (1 − e^(−2h/τ_c)) for c.

At rest nothing is learned of the parameters and σ²: they do not walk, g is 0 for them, and σ² stays as it is. There the
speed is all noise, to which a drag fits that grows without end; and a sensor that reports 0 would make σ² vanish.

Measurement with the innovation e, S its variance:

    K = P H/S,   x ← x + K e,   P ← P − K HᵀP;   where e² > k² S an outlier: S becomes e²/k²               (5)
    σ² ← σ² (1 + max(0.005, 1/(count + 20)) (min(e²/S, 9) − 1))                                         (6)
    θ_q, θ_l, θ_c ≤ 0 and θ_q ± e₀ ≤ 0, by projection in turn                                            (7)

P = U D Uᵀ is kept in factors, whose measurement, with α_0 = S − HᵀPH in (5), and projection are those of
`usvlearn.estimators.ud_factorization`. As w is the first state, F U is triangular but for scales, and a time update
needs no orthogonalisation. Each step adds noise to w, b and c; at every fourth step one parameter, in turn, gets the
random-walk noise of all the steps between.

A segment starts at a measured speed. Its first step knows the heading: there P loses all that joins w and b to others,
b becomes 0, P_ww 4 m²/s², each variance of c grows by 0.05² m²/s², and the speed is measured. A step of more than 10 s
is predicted; its speed starts a segment. A speed beyond ±20 m/s is that limit, with P_ww = 400 m²/s².

*Periodic estimates.* After each `read_every` s of update steps, without those at rest, the parameters are read; the
first three periodic estimates are dropped. With weights 0.9^age, θ̄ is their mean and C their covariance; `reading`
makes intervals of them.

*The trial*, an option, answers a change of the boat within seconds. With z = e/√S of (5), z₋ that of the step before,
m = min(|z|, |z₋|)² (25 at most), and ū the running mean (share 0.005) of min(m, 4) where z z₋ > 0, of 0 elsewhere,

    g ← max(0, g ± m − ½ − 2ū),   + where z z₋ > 0, − elsewhere                                         (8)

is Page's sum (Page 1954) of innovations that keep their sign. A second filter holds the state before the step while
g ≤ 2. From there on it runs beside the first, with the covariance that a change leaves:

    P ← P + Σ_side s² d dᵀ + Σ_i (r x_i)² e_i e_iᵀ,   d = (α, β, γ, κ, e₁, e₂, e₃) of the side as they are   (9)

where each variance grows to four times its prior at most, and μ's does not. The evidence for it is

    D ← D + ℓ_second − ℓ_first,   ℓ = −½ min(e²/S, 25) − ½ log S                                        (10)

Where g exceeds its threshold within 20 steps, the trial begins. While D > `leads` the second filter predicts the next
speed. Its parameters are uncertain, and open-loop simulations depart from it at D > 100 only. At
D > `confirmed` it replaces the first, and the periodic estimates begin anew. It is dropped at D < `dropped`, where D
falls by `fallen` below its greatest value, and after `trial_steps`. The filter that predicts lies in `mean`, `factor`,
`noise` and `updates`; the other one lies in `trial`.

The derivation is in `docs/theory/estimators.md#joint-ekf`.
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
    """The names of the parameters, in the order of x.

    >>> len(names(True)), names(False)[-1]
    (19, 'command_lag')
    """
    return (*SURGE, *CUBIC, *(EVEN if even else ()), LAG)


class Number(Parameters):
    """Hyperparameters and constants, in the units of the arguments of `JointEKF`."""

    DISTURBANCE = POSITIVE  # q_b
    DISTURBANCE_TIME = POSITIVE  # τ_b
    CURRENT = POSITIVE  # σ_c
    CURRENT_TIME = POSITIVE  # τ_c
    DRIFT_TIME = POSITIVE  # T_θ
    OUTLIER = POSITIVE_OR_INFINITE  # k
    READ_EVERY = POSITIVE_OR_INFINITE
    MASS = MODEST  # kg: for the units of what is read
    THRESHOLD = POSITIVE  # of g; this one and the next six only with trials
    LEADS = FINITE
    CONFIRMED = POSITIVE
    DROPPED = FINITE
    FALLEN = POSITIVE
    SIDE = NOT_NEGATIVE  # s of (9)
    EACH = NOT_NEGATIVE  # r


class Vector(ParameterVectors):
    """One number for each parameter."""

    VARIANCE = POSITIVE, lambda size: size - THETA  # prior
    PRIOR = FINITE, lambda size: size - THETA  # mean, per unit mass
    INVERSE_MASS = FINITE, lambda size: size - THETA  # g of 1/m = gᵀθ; zeros where the mass is an assumption


class Choice(Options):
    """Choices."""

    EVEN = False, True
    TRIAL_STEPS = Range(1, 10**6)  # the longest trial; only with trials


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
    optional=(Choice.TRIAL_STEPS,),
    last=tuple(Number)[Number.THRESHOLD :],
    lengths=(Choice.TRIAL_STEPS,),
    work=lambda n: 4 * n + 2,
    heading=lambda own: True,
    frozen=FROZEN,
    instead={"mean": ("trial.mean", "trial.early")},
)
AT = FAMILY.at
AT_TRIAL = cast("TrialState", AT.trial)
