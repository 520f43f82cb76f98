"""Monitors: what a state tells of itself. Which parameters are informed; is an innovation white; did a thruster fail.

**Excitation.** With P₀ the covariance before the first sample and P = S Sᵀ that of now, 1 − P_ii/P₀_ii is the share of
a parameter's first variance that the data have removed. The least informed direction is the eigenvector of
P₀^(−½) P P₀^(−½) with the largest eigenvalue.

**Whiteness.** If a predictor has learned all there is, its innovations e_k are white: their lag-1 autocorrelation lies
within ±1.96/√n for 95 % of the sequences of n (Box & Jenkins 1970). All means forget exponentially, with

    n = (Σ w)²/Σ w² = ω (2 − α)/(α (2 − ω)),   ω = 1 − (1 − α)^steps                                      (1)

independent samples in them; e is clipped at three robust standard deviations, s (Huber 1981):

    s² ← s² + b (min(e², (c s)²)/κ − s²),   c = 1.345,   κ = E min(z², c²) = 0.71016                      (2)

**A thruster that fails.** The yaw rate answers a one-sided loss at once, and unlike the surge it does not feel a steady
current. A regression with a long memory says what the commands do to it; R is a ridge, w the weight of a sample:

    r_k = xᵀϑ + e,   x = [1, r_{k−1}, r_{k−2}, ξ_i, ξ_i|ξ_i|, ξ_i³ of both sides],                        (3)
    ϑ = (Σ w x xᵀ + R)⁻¹ Σ w x r,   ℓ = xᵀ (Σ w x xᵀ + R)⁻¹ x                                              (4)

Where a thruster keeps the share 1 − d of its effect f_i, the part of xᵀϑ that side i makes, e has the mean −d f_i.
Page's CUSUM (1954) of the log-likelihood ratio of a loss d against none, and what the samples since its last zero tell:

    σ² = (1 + N ℓ) s² + (η F)²,   g_i ← max(0, g_i − d f_i e/σ² − ½ (d f_i/σ)²)                            (5)
    effectiveness_i = 1 + Σ f_i e/σ² / Σ (f_i/σ)²                                                          (6)

N ℓ s² is the error of ϑ, which stays the same over some N steps; η F an error of the model (3), where F is the effect
of full command. A g_i above the threshold raises the alarm. While g is up little is learned, lest a fault be absorbed.

The sums M = Σ w x xᵀ are rounded at each of the n = Σ w steps that they remember, by at most some n ε √(M_ii M_jj) in
all (ε the machine's). In float32, at constant commands, that makes M indefinite. A ridge above that bound keeps M + R
positive definite, since nine such errors add up to less than it; in float64 it is ρ alone:

    R_jj = max(ρ, 16 n ε M_jj)                                                                            (7)

Where the factorisation breaks down nevertheless, the model says nothing in that step: ϑ = 0, ℓ = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.signals import Inputs, tree_map, where

WHITE = 1.96  # standard deviations of a 95 % band
HUBER, HUBER_MEAN, HUBER_RATE = 1.345, 0.71016, 0.005  # c, κ and b of (2)
FIRST_SCALE, LEAST_SCALE = 0.05, 1e-6  # m/s, s of the innovations before the first, and its least

# Chosen on simulated boats of four plants; the floor on a real one.
YAW_MEMORY = 900.0  # s at full thrust
YAW_RIDGE = 0.01  # ρ of (7): ϑ is 0 within ten standard deviations of the noise
YAW_SCALE = 0.1  # rad/s, s of (5) before the first sample
YAW_FLOOR = 0.05  # rad/s, least s of (5): wind and waves turn a boat by more than a good compass errs
YAW_RATE = 0.01  # share by which s² moves in a step
KNEE = 2.0  # standard deviations about which a sample begins to count less
YAW_SPREAD = 1.5  # 1/E z²/(1 + z²/KNEE²), z standard normal
LOSS = 0.5  # d of (5): a loss of less than half of it never alarms
HORIZON = 25.0  # N of (5), steps
MISFIT = 0.07  # η of (5)
CLIP, EFFECT = 5.0, 3.0  # limits of e and f_i, in σ: one sample moves g by at most d CLIP EFFECT
CALM = 6.0  # a sample counts exp(−g/CALM) in (4), and a smaller g tells nothing
THRESHOLD = 20.0  # of g
BACKWARDS = -0.25  # least effectiveness that a thruster may have
DOUBT = 10.0  # the effectiveness is 1 ± 1/√DOUBT before the first sample
CLEARED = 0.25  # share of the threshold under which g ends an alarm
FEATURES = 9  # x of (3)
THRUST = 3  # place of the first feature of the commands
ROUNDING = 16  # of (7)


class InnovationState(NamedTuple):
    """Running statistics of k innovation sequences, one per column."""

    moments: Tensor  # (*batch, k, 4) weighted sums of 1, e (m/s), e² and e e₋ (m²/s²)
    scale: Tensor  # (*batch, k) s² of (2), m²/s²
    last: Tensor  # (*batch, k) e₋, m/s


class Whiteness(NamedTuple):
    """Lag-1 autocorrelation of innovation sequences. Leaves are `(*batch, k)`."""

    correlation: Tensor  # -1 ... 1
    band: Tensor  # white noise stays within ± this in 95 % of the cases
    samples: Tensor  # n of (1)


class ThrusterState(NamedTuple):
    """The model of the yaw rate and the evidence against each thruster. Sides are left, right."""

    moments: Tensor  # (*batch, 10, 10) Σ w z zᵀ, z = [r, x]
    variance: Tensor  # (*batch,) s² of (5), rad²/s²
    before: Tensor  # (*batch, 2) yaw rate one and two steps ago, rad/s
    evidence: Tensor  # (*batch, 2) g of (5)
    sums: Tensor  # (*batch, 2, 2) side, both sums of (6) since g was 0
    raised: Tensor  # (*batch, 2) 1 where an alarm is on, else 0
    alarms: Tensor  # (*batch,) count of alarms so far
    since: Tensor  # (*batch,) s of learned steps since the last alarm, or since the start where there was none


class MonitorState(NamedTuple):
    """What `observe` carries along."""

    innovations: InnovationState
    thrusters: ThrusterState


def excitation(factor: Tensor, prior: Tensor | float) -> Tensor:
    """The share of each parameter's first variance that the data have removed, 0 (a guess) to 1, `(*batch, p)`.

    Args:
        factor: S, a square root of the covariance, `(*batch, p, p)`.
        prior: diagonal of P₀, broadcasts against `(*batch, p)`.

    >>> excitation(torch.diag(torch.tensor([1.0, 10.0])), 100.0)
    tensor([0.9900, 0.0000])
    """
    return (1 - (factor * factor).sum(-1) / prior).clamp(0, 1)


def least_informed(factor: Tensor, prior: Tensor | float) -> tuple[Tensor, Tensor]:
    """The direction that the data inform least, and the share of its first variance that they have removed.

    The direction is of unit length in parameters over √P₀, `(*batch, p)`, its largest entry positive.

    >>> direction, share = least_informed(torch.diag(torch.tensor([1.0, 10.0])), 100.0)
    >>> direction.tolist(), share.item()
    ([0.0, 1.0], 0.0)
    """
    root = torch.as_tensor(prior, dtype=factor.dtype, device=factor.device).sqrt()
    vectors, values, _ = torch.linalg.svd(factor / root[..., None])
    direction = vectors[..., 0]
    largest = direction.take_along_dim(direction.abs().argmax(-1, keepdim=True), -1)
    return direction * largest.sign() + 0.0, (1 - values[..., 0] ** 2).clamp(0, 1)


def excitation_report(names: Sequence[str], factor: Tensor, prior: Tensor | float) -> dict[str, Tensor]:
    """`excitation_<parameter>` and `least_informed_<parameter>`, the entries of both, `(*batch,)` each.

    >>> sorted(excitation_report(["a"], torch.eye(1), 4.0).items())
    [('excitation_a', tensor(0.7500)), ('least_informed_a', tensor(1.))]
    """
    share, direction = excitation(factor, prior).unbind(-1), least_informed(factor, prior)[0].unbind(-1)
    informed = {f"excitation_{name}": x for name, x in zip(names, share, strict=True)}
    return informed | {f"least_informed_{name}": x for name, x in zip(names, direction, strict=True)}


def spec(threshold: float = THRESHOLD, memory: float = 500.0) -> dict[str, float]:
    """The numbers that `observe` works with, for the compiled kernels.

    >>> spec()["threshold"]
    20.0
    """
    innovations = {"huber": HUBER, "huber_mean": HUBER_MEAN, "huber_rate": HUBER_RATE, "least_scale": LEAST_SCALE**2}
    return innovations | {
        "innovation_memory": memory, "yaw_memory": YAW_MEMORY, "yaw_ridge": YAW_RIDGE, "yaw_floor": YAW_FLOOR**2,
        "yaw_rate": YAW_RATE, "knee": KNEE, "yaw_spread": YAW_SPREAD, "loss": LOSS, "horizon": HORIZON,
        "misfit": MISFIT, "clip": CLIP, "effect": EFFECT, "calm": CALM, "threshold": threshold, "backwards": BACKWARDS,
        "doubt": DOUBT, "cleared": CLEARED,
    }  # fmt: skip


def init(batch: Sequence[int], columns: int, like: Tensor) -> MonitorState:
    """The monitors before the first sample, of the dtype and device of `like`; `columns` innovation sequences.

    >>> init((8,), 3, torch.zeros(())).innovations.moments.shape
    torch.Size([8, 3, 4])
    """
    b, k, p, zero = tuple(batch), columns, FEATURES + 1, like.new_zeros
    innovations = InnovationState(zero((*b, k, 4)), zero((*b, k)) + FIRST_SCALE**2, zero((*b, k)))
    two = zero((*b, 2))
    yaw = zero((*b, p, p)), zero(b) + YAW_SCALE**2, two, two, zero((*b, 2, 2)), two, zero(b), zero(b)
    return MonitorState(innovations, ThrusterState(*yaw))


def observe(
    state: MonitorState, innovation: Tensor, inputs: Inputs, threshold: float = THRESHOLD, memory: float = 500.0
) -> MonitorState:
    """All monitors one step on.

    Args:
        innovation: measured − predicted, m/s, `(*batch, k)`; a column that is not finite is left as it was.
        inputs: of that step, finite, leaves `(*batch,)`.
        threshold: of the evidence, above which an alarm is raised.
        memory: of the innovations, steps.

    >>> one = torch.ones(())
    >>> state = observe(init((), 1, one), 0.1 * one[None], Inputs(one, one, one, 0 * one, 0.4 * one))
    >>> state.thrusters.raised.tolist()
    [0.0, 0.0]
    """
    innovations = observe_innovations(state.innovations, innovation, memory)
    return MonitorState(innovations, observe_thrusters(state.thrusters, inputs, threshold))


def observe_innovations(state: InnovationState, innovation: Tensor, memory: float = 500.0) -> InnovationState:
    """The statistics with one more innovation per column, m/s, `(*batch, k)`; NaN leaves a column as it was.

    >>> zero = init((), 2, torch.zeros(())).innovations
    >>> observe_innovations(zero, torch.tensor([0.01, torch.nan])).last
    tensor([0.0100, 0.0000])
    """
    known = innovation.isfinite()
    e = innovation.where(known, state.last)
    limit = 3 * state.scale.sqrt()
    clipped = e.minimum(limit).maximum(-limit)
    squared = (e * e).minimum(HUBER**2 * state.scale)
    scale = state.scale.lerp(squared / HUBER_MEAN, HUBER_RATE).clamp(min=LEAST_SCALE**2)  # (2)
    terms = torch.stack([torch.ones_like(e), clipped, clipped * clipped, clipped * state.last], -1)
    moments = state.moments.lerp(terms, 1 / memory)
    learned = InnovationState(moments, scale, clipped)
    return tree_map(lambda new, old: where(known, new, old), learned, state)


def whiteness(state: InnovationState, memory: float = 500.0) -> Whiteness:
    """Lag-1 autocorrelation, its 95 % band and the samples that count; 0, 1.96 and 0 before the first.

    >>> whiteness(init((), 1, torch.zeros(())).innovations).correlation
    tensor([0.])
    """
    weight, *sums = state.moments.unbind(-1)
    mean, square, lagged = (x / weight.clamp(min=torch.finfo(weight.dtype).tiny) for x in sums)
    variance = square - mean * mean
    correlation = torch.where(variance > 0, (lagged - mean * mean) / torch.where(variance > 0, variance, 1.0), 0.0)
    samples = weight * (2 * memory - 1) / (2 - weight)  # (1)
    return Whiteness(correlation, WHITE / samples.clamp(min=1).sqrt(), samples)


def observe_thrusters(state: ThrusterState, inputs: Inputs, threshold: float = THRESHOLD) -> ThrusterState:
    """The evidence against each thruster after one more step, whose inputs are finite, leaves `(*batch,)`."""
    xi = torch.stack([inputs.command_left, inputs.command_right], -1)
    size = xi.abs()
    bent = xi * size
    rate = inputs.yaw_rate[..., None]
    z = torch.cat([rate, torch.ones_like(rate), state.before, xi, bent, bent * size], -1)
    x, known = z[..., 1:], state.moments[..., 1:, :]
    information = known[..., 1:]
    share = ROUNDING * torch.finfo(z.dtype).eps * information[..., :1, 0]
    ridge = (share * information.diagonal(dim1=-2, dim2=-1)).clamp(min=YAW_RIDGE)  # (7)
    root, broken = torch.linalg.cholesky_ex(information + ridge.diag_embed())
    solved = torch.cholesky_solve(torch.cat([known[..., :1], x[..., None]], -1), root)  # (4)
    solved = solved.masked_fill((broken > 0)[..., None, None], 0.0)
    predicted, leverage = (x[..., None] * solved).sum(-2).unbind(-1)
    thrust = solved[..., THRUST:, 0]
    at_full = thrust.unflatten(-1, (3, 2)).sum(-2)  # F of both sides
    effect = (x[..., THRUST:] * thrust).unflatten(-1, (3, 2)).sum(-2)  # f of both sides
    e, variance = inputs.yaw_rate - predicted, state.variance

    coherent = 1 + HORIZON * leverage
    misfit = 0.5 * MISFIT**2 * (at_full * at_full).sum(-1)
    precision = torch.addcmul(misfit, coherent, variance).rsqrt()[..., None]  # 1/σ of (5)
    evidence, sums = cusum(state.evidence, state.sums, effect * precision, e[..., None] * precision, 2 * threshold)
    # A thruster cannot push backwards: then it is the model that does not fit any more, and it learns again.
    plausible = 1 + sums[..., 0] / (sums[..., 1] + DOUBT) > BACKWARDS
    evidence, sums = torch.where(plausible, evidence, 0.0), torch.where(plausible[..., None], sums, 0.0)
    above = evidence.add(state.raised, alpha=(1 - CLEARED) * threshold).sub(threshold)
    raised = above.sign().relu()
    alarm = (raised - state.raised).amax(-1).relu()
    since = (state.since + inputs.dt) * (1 - alarm)

    calm = (-state.evidence.amax(-1) / CALM).exp()
    square = e * e
    light = variance / torch.add(variance, square, alpha=KNEE**-2)  # the square of a soft Huber weight
    variance = variance.lerp(square * light * YAW_SPREAD, calm * YAW_RATE).clamp(min=YAW_FLOOR**2)
    weighted = (calm * light.sqrt())[..., None] * z
    keep = (size.sum(-1).clamp(max=1) * inputs.dt * (-1 / YAW_MEMORY)).exp()  # only thrust makes it forget
    moments = torch.addcmul(keep[..., None, None] * state.moments, weighted[..., None], z[..., None, :])
    before = torch.cat([rate, state.before[..., :1]], -1)
    return ThrusterState(moments, variance, before, evidence, sums, raised, state.alarms + alarm, since)


def cusum(
    evidence: Tensor,  # (*batch, 2) g
    sums: Tensor,  # (*batch, 2, 2)
    effect: Tensor,  # (*batch, 2) f/σ
    error: Tensor,  # (*batch, 1) e/σ
    highest: float,  # at which g stops, so that a healed thruster soon ends an alarm
) -> tuple[Tensor, Tensor]:
    """The next g and sums of (5) and (6).

    >>> g, _ = cusum(torch.zeros(2), torch.zeros(2, 2), torch.tensor([2.0, -2.0]), torch.tensor([-1.0]), 36.0)
    >>> g.tolist()
    [0.5, 0.0]
    """
    effect = effect.clamp(-EFFECT, EFFECT)
    terms = torch.stack([effect * error.clamp(-CLIP, CLIP), effect * effect], -1)
    moment, weight = terms.unbind(-1)
    evidence = evidence.sub(moment, alpha=LOSS).sub(weight, alpha=0.5 * LOSS**2).clamp(0, highest)  # (5)
    return evidence, (sums + terms) * evidence.sign()[..., None]


def effectiveness(state: ThrusterState) -> tuple[Tensor, Tensor]:
    """What is left of each thruster's thrust, by (6), and its standard deviation, `(*batch, 2)` each.

    1 where the evidence is below CALM, as it now and then is of every healthy thruster.

    >>> state = init((), 1, torch.zeros(())).thrusters._replace(sums=torch.tensor([[-50.0, 90.0], [0.0, 0.0]]))
    >>> effectiveness(state._replace(evidence=torch.tensor([12.0, 0.0])))[0].tolist()
    [0.5, 1.0]
    """
    moment, weight = state.sums.unbind(-1)
    weight = weight + DOUBT
    return 1 + torch.where(state.evidence > CALM, moment / weight, 0.0), weight.rsqrt()


def monitor_report(state: MonitorState, members: Sequence[str], memory: float = 500.0) -> dict[str, Tensor]:
    """What a person wants to see, by name, `(*batch,)` each; `members` names the columns.

    >>> sorted(monitor_report(init((), 1, torch.zeros(())), ["aid"]))[:3]
    ['alarm', 'alarms', 'effectiveness_left']
    """
    white, thrusters = whiteness(state.innovations, memory), state.thrusters
    numbers = {
        "alarm": thrusters.raised.amax(-1),
        "alarms": thrusters.alarms,
        "since_alarm": thrusters.since,
        "whiteness_band": white.band.amax(-1),
    }
    columns = {
        "effectiveness": (("left", "right"), effectiveness(thrusters)[0]),
        "evidence": (("left", "right"), thrusters.evidence),
        "whiteness": (members, white.correlation),
        "scale": (members, state.innovations.scale.sqrt()),
    }
    for part, (names, values) in columns.items():
        numbers |= {f"{part}_{name}": value for name, value in zip(names, values.unbind(-1), strict=True)}
    return numbers
