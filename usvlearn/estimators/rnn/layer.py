"""The network in torch, learned online by Adam: equations (1) to (4) of `state`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from certify.networks.shallow import ShallowWeights
from certify.proofs.equilibria import CLASSES, equilibria
from certify.training.conditions import CONDITIONS, rate
from certify.training.projections import GAUGES, project
from usvlearn.core.family import FEEDBACK
from usvlearn.core.hyperparameters import Hyper, Positive, UnitInterval, as_tensor, check_broadcast
from usvlearn.core.protocol import Estimator, describe
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError, check_choice, check_not_negative, check_positive
from usvlearn.estimators.rnn.initial import initial_weights, pretrained_weights
from usvlearn.estimators.rnn.replay_buffer import added, due
from usvlearn.estimators.rnn.state import (
    BETA2,
    EPSILON,
    FAMILY,
    INPUTS,
    KEPT,
    MOST_KEPT,
    MOST_NEURONS,
    MOST_STEPS,
    SIZES,
    SURGE,
    TARGET,
    WEIGHTS,
    Replay,
    RNNState,
)


def network_inputs(inputs: Inputs) -> Tensor:
    """u of (1), `(*batch, 4)`."""
    heading = inputs.heading
    return torch.stack(
        [0.5 + 0.5 * heading.sin(), 0.5 + 0.5 * heading.cos(), inputs.command_left, inputs.command_right], -1
    )


def network(weights: ShallowWeights, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """x⁺ of (1), `(*batch,)`, and z, `(*batch, n)`."""
    a, w1, W2, b = weights
    z = w1 * x[..., None] + (W2 * u[..., None, :]).sum(-1) + b
    return (a * z.relu()).sum(-1), z


def gradient(
    weights: ShallowWeights,
    x: Tensor,  # (*batch,) scaled speed from which the last step departs
    u: Tensor,  # (*batch, 4)
    target: Tensor,  # (*batch,) scaled measurement
    penalty: Tensor | None = None,  # η, broadcasts against (*batch,)
    before: tuple[Tensor, Tensor, Tensor] | None = None,  # x₋, u₋, unbroken, for the unrolled loss
) -> Tensor:
    """The gradient of (2) with respect to the weights, `(*batch, 7n)` in the order a, w1, W2, b."""
    a, w1 = weights.a, weights.w1
    if before is not None:
        x_before, u_before, unbroken = before
        x_between, z_before = network(weights, x_before, u_before)
        x = torch.where(unbroken, x_between, x)
    predicted, z = network(weights, x, u)
    e = (predicted - target)[..., None]
    grad_a = z.relu() * e
    slope = a * (z > 0)
    grad_z = slope * e
    grad_w1 = grad_z * x[..., None]
    grad_W2 = grad_z[..., None] * u[..., None, :]
    grad_b = grad_z
    if before is not None:  # (3)
        through = e * ((slope * w1).sum(-1) * unbroken)[..., None]  # e s
        grad_z_before = through * a * (z_before > 0)
        grad_a = grad_a + through * z_before.relu()
        grad_w1 = grad_w1 + grad_z_before * x_before[..., None]
        grad_W2 = grad_W2 + grad_z_before[..., None] * u_before[..., None, :]
        grad_b = grad_b + grad_z_before
    if penalty is not None:
        bound = 1.0 / (a.shape[-1] + 1)
        shrink = penalty[..., None] * (a.abs() + bound * w1.abs() > bound)  # η ψ
        grad_a, grad_w1 = grad_a + shrink * a, grad_w1 + shrink * w1
    return torch.cat([grad_a, grad_w1, grad_W2.flatten(-2), grad_b], -1)


def clipped(grad: Tensor, c: float) -> Tensor:
    """Each batch element's gradient g, `(*batch, 7n)`, as g/√(1 + ‖g‖²/c²): no longer than c, and hardly changed where
    short.
    """
    grad = grad.clamp(-1e15, 1e15)  # so that no square overflows, not even in float32
    return grad * (1 + (grad * grad).sum(-1, keepdim=True) / c**2).rsqrt()


def element_weights(state: RNNState, element: int | tuple[int, ...]) -> ShallowWeights:
    """The weights of one batch element as float64 arrays, for `certify`."""
    return ShallowWeights(*(w[element].detach().cpu().double().numpy() for w in state.weights))


class RNN(Estimator):
    """Shallow ReLU network, n = 20 neurons and 140 weights by default, one Adam step a sample.

    The paper's own: `initial="random" rate=5e-4 rate_ratio=(1, 1, 1, 1, 1) momentum=0.9 clip=None stability="penalty"
    penalty=0.1 unroll=2`.

    The network and the penalty are the paper's, section IV-B; Adam is that of Kingma & Ba 2015. The projection is
    derived in `docs/certification.md`.

    Args:
        neurons: n, the number of neurons.
        surge_max: v_max, m/s, which scales the speed onto [0, 0.5].
        initial: "persistence", equation (4), or "random" weights.
        pretrained: initial weights in place of these: a checkpoint, .npz or .pt (see `certify.networks.shallow.load`),
            or one of several in it, `FILE:members.rnn.weights`. They suit the `surge_max` and dt with which they were
            learned.
        rate: Adam's learning rate at the first update, no unit; broadcasts against the batch.
        rate_ratio: relative rates, no unit, of a, w₁, the columns of W₂ for the heading and for the commands, and b;
            those of w₁ and W₂ also scale the neurons of "persistence".
        decay: the rate falls as 1/√(1 + ⌊k/decay⌋) after a number of k updates; None keeps it.
        momentum: Adam's β₁, in [0, 1), no unit.
        clip: c, the norm that no batch element's gradient exceeds, no unit; None or infinity for no limit.
        stability: "project" onto `condition` after every update, "penalty" (the paper's), or "none".
        condition: simple, gershgorin, lmi, exact (all activation patterns, the weakest that (a, w₁) alone can tell), or
            interval (the same for |x| ≤ 1, where a speed that coasts is kept, and commands of up to 1.2).
        contraction_rate: κ of the projection, no unit; broadcasts against the batch.
        gauge: "literal", or "best": simple and gershgorin of the equal network that holds them most easily.
        penalty: η of the paper's penalty, no unit; broadcasts against the batch.
        unroll: number of steps through which the loss is taken, 1 or 2.
        feedback: "measured" predicts from the last measured speed, "estimate" from the network's own.
        seed: seed of the initial weights.
        replay_size: number of learned samples that are kept; 0 for none.
        replay_steps: number of kept samples that are learned again, by one update, after each new one.

    Raises:
        ConfigError: a number or a choice outside its legal values.

    >>> rnn = RNN(surge_max=2.74)
    >>> sum(w.numel() for w in rnn.init().weights)
    140
    """

    bounds: Tensor  # (2, 5) least and greatest x and u of the condition "interval"
    rate_ratio: Tensor  # (7n,) in the order of the gradient

    frozen = FAMILY.frozen

    def __init__(
        self,
        neurons: int = 20,
        surge_max: float = 3.0,
        initial: str = "persistence",
        pretrained: str | Path | None = None,
        rate: Hyper = 8e-4,
        rate_ratio: Sequence[float] = (1.0, 2.0, 0.3, 1.5, 0.5),
        decay: int | None = 1000,
        momentum: float = 0.0,
        clip: float | None = 0.1,
        stability: str = "project",
        condition: str = "exact",
        contraction_rate: Hyper = 0.999,
        gauge: str = "literal",
        penalty: Hyper = 1e-4,
        unroll: int = 1,
        feedback: str = "measured",
        seed: int = 0,
        replay_size: int = 0,
        replay_steps: int = 8,
    ):
        super().__init__()
        if unroll not in (1, 2):
            raise ConfigError(f"unroll: found {unroll!r}, expected 1 or 2")
        check_choice("initial", initial, ("persistence", "random"))
        self.balanced = pretrained is None and initial == "persistence"
        if not (isinstance(neurons, int) and self.balanced < neurons <= MOST_NEURONS):  # the balanced pair takes two
            expected = f"a whole number, {1 + self.balanced} … {MOST_NEURONS}"
            raise ConfigError(f"neurons: found {neurons!r}, expected {expected}")
        if check_not_negative("momentum", momentum) >= 1:
            raise ConfigError(f"momentum: found {momentum!r}, expected a number below 1")
        self.feedback = check_choice("feedback", feedback, FEEDBACK)
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.decay = None if decay is None else check_positive("decay", decay, "of updates")
        self.clip = None if clip in (None, math.inf) else check_positive("clip", clip, ", or null for no limit")
        self.scale, self.unroll, self.momentum = 0.5 / surge_max, unroll, momentum
        check_choice("stability", stability, ("none", "penalty", "project"))
        self.condition = check_choice("condition", condition, (*CONDITIONS, "interval"))
        self.gauge = check_choice("gauge", gauge, GAUGES)
        self.rate, penalised = Positive(rate, "rate"), Positive(penalty, "penalty")
        kappa = UnitInterval(contraction_rate, "contraction_rate")
        self.penalty = penalised if stability == "penalty" else None
        self.contraction_rate = kappa if stability == "project" else None
        self.initial_rate = float(kappa().detach().min())  # of (4) where nothing is projected
        self.register_buffer("bounds", as_tensor([[-1.0, 0.0, 0.0, -1.2, -1.2], [1.0, 1.0, 1.0, 1.2, 1.2]]))
        ratio = as_tensor(list(rate_ratio), "rate_ratio")
        if ratio.shape != (5,) or not bool(((ratio >= 0) & ratio.isfinite()).all()):
            raise ConfigError(f"rate_ratio: found {list(rate_ratio)}, expected five numbers of 0 or more")
        a, w1, heading, command, b = (each.expand(neurons) for each in ratio)
        W2 = torch.stack([heading, heading, command, command], -1).flatten()
        self.register_buffer("rate_ratio", torch.cat([a, w1, W2, b]))
        for name, value, least, most in (
            ("replay_size", replay_size, 0, MOST_KEPT),
            ("replay_steps", replay_steps, 1, MOST_STEPS),
        ):
            if isinstance(value, bool) or not (isinstance(value, int) and least <= value <= most):
                raise ConfigError(f"{name}: found {value!r}, expected a whole number, {least} … {most}")
        self.replay_size, self.replay_steps = replay_size, replay_steps
        if not isinstance(seed, int):
            raise ConfigError(f"seed: found {seed!r}, expected a whole number")
        if pretrained is None:
            weights = initial_weights(neurons, initial, ratio.tolist(), torch.Generator().manual_seed(seed))
        else:
            weights = pretrained_weights(str(pretrained), neurons)
        self.a, self.w1, self.W2, self.b = map(nn.Parameter, weights)

    def init(self, batch: Sequence[int] = ()) -> RNNState:
        batch, n = tuple(batch), len(self.a)
        check_broadcast(self, batch)
        weights = ShallowWeights(*(w.expand(*batch, *w.shape) for w in (self.a, self.w1, self.W2, self.b)))
        if self.balanced:  # the room of 1e-12 keeps `project` away, through which no gradient comes from the edge
            kappa = self.a.new_full((), self.initial_rate) if self.contraction_rate is None else self.contraction_rate()
            weights = self._stable(weights._replace(a=weights.a * ((1 - 1e-12) * kappa)[..., None]))
            a, b = weights.a, weights.b
            # A condition stricter than `exact` may have shrunk the first neuron's.
            constant = -(a * b)[..., :1] / b[..., 1:2]
            weights = weights._replace(a=torch.cat([a[..., :1], constant, a[..., 2:]], -1))
        weights = self._stable(weights)
        zero = self.a.new_zeros
        unbroken = torch.zeros(batch, dtype=torch.bool, device=self.a.device)
        moments = zero((*batch, WEIGHTS * n)), zero((*batch, WEIGHTS * n))
        before = zero((*batch, INPUTS))
        replay: Replay | dict[str, Any] = {}
        if self.replay_size:
            replay = Replay(zero((*batch, self.replay_size, KEPT)), zero(batch), zero(batch))
        return RNNState(weights, *moments, zero(batch), zero(batch), zero(batch), before, zero(batch), unbroken, replay)

    def predict(self, state: RNNState, inputs: Inputs) -> tuple[RNNState, Tensor]:
        x, _ = network(state.weights, self.scale * state.surge, network_inputs(inputs))
        surge = x / self.scale
        coasted = surge.clamp(-2 * self.surge_max, 2 * self.surge_max)  # the speed from which a coasting step departs
        return state._replace(surge=coasted, unbroken=torch.zeros_like(state.unbroken)), surge

    def update(self, state: RNNState, inputs: Inputs, surge: Tensor) -> RNNState:
        u = network_inputs(inputs)
        penalty = None if self.penalty is None else self.penalty()
        before = state.surge_before, state.inputs_before, state.unbroken
        learned = self._descend(state, self._gradient(state.weights, state.surge, u, surge, before, penalty))
        if isinstance(replay := state.replay, Replay):
            others = torch.stack([state.surge, surge, state.unbroken.to(surge.dtype)], -1)
            replay, again, earlier, unbroken = due(added(replay, torch.cat([u, others], -1)), self.replay_steps)
            before = earlier[..., SURGE], earlier[..., :INPUTS], unbroken
            weights = ShallowWeights(*(w.unsqueeze(surge.ndim) for w in learned.weights))  # for (*batch, samples)
            penalty = None if penalty is None else penalty[..., None]
            grad = self._gradient(weights, again[..., SURGE], again[..., :INPUTS], again[..., TARGET], before, penalty)
            learned = self._descend(learned, grad.mean(-2))
        if self.feedback == "estimate":
            estimate = network(state.weights, self.scale * state.surge, u)[0] / self.scale
            surge = estimate.clamp(-2 * self.surge_max, 2 * self.surge_max)
        return learned._replace(
            surge=surge, surge_before=state.surge, inputs_before=u, dt=inputs.dt,
            unbroken=torch.ones_like(state.unbroken), replay=replay,
        )  # fmt: skip

    def start(self, state: RNNState, surge: Tensor) -> RNNState:
        return state._replace(surge=surge, unbroken=torch.zeros_like(state.unbroken))

    def description(self) -> dict[str, Any]:
        return describe(
            FAMILY, self, size=len(self.a), unroll=int(self.unroll), best=self.gauge == "best",
            condition="none" if self.contraction_rate is None else self.condition,
            tiny=torch.finfo(self.a.dtype).tiny, bounds=self.bounds.flatten(),
        )  # fmt: skip

    def monitor(self, state: RNNState) -> dict[str, Tensor]:
        a, w1 = state.weights.a, state.weights.w1
        margins = {f"margin_{name}": condition(a, w1).margin for name, condition in CONDITIONS.items()}
        K = rate(a, w1)
        time_constant = torch.where(K < 1, -state.dt / K.log(), torch.nan)
        return {**margins, "contraction_rate": K, "time_constant": time_constant, **self._at_rest(state)}

    def _at_rest(self, state: RNNState) -> dict[str, Tensor]:
        """The equilibrium without thrust, at the last heading, that is nearest to the speed: its place and class."""
        rest = pad(state.inputs_before[..., :2], (0, 2))
        places = torch.full((*state.surge.shape, 3), torch.nan, dtype=torch.float64)
        for element in np.ndindex(*state.surge.shape):
            weights = element_weights(state, element)
            x = float(self.scale * state.surge[element])
            if not all(np.isfinite(w).all() for w in weights):
                continue
            every = equilibria(weights, rest[element].tolist(), -1.0, 1.0)
            places[(*element, 0)] = len(every)
            if every:
                nearest = every[int(np.argmin([abs(each.x - x) for each in every]))]
                places[(*element, 1)], places[(*element, 2)] = nearest.x / self.scale, list(CLASSES).index(nearest.kind)
        columns = places.to(state.surge.device).unbind(-1)
        return dict(zip(("equilibria", "equilibrium", "equilibrium_class"), columns, strict=True))

    def _stable(self, weights: ShallowWeights) -> ShallowWeights:
        if self.contraction_rate is None:
            return weights
        return project(weights, self.condition, self.contraction_rate(), self.gauge, (self.bounds[0], self.bounds[1]))

    def _gradient(
        self,
        weights: ShallowWeights,
        surge: Tensor,  # m/s, from which the step departs
        u: Tensor,
        target: Tensor,  # m/s
        before: tuple[Tensor, Tensor, Tensor],  # surge and u of the step before, and whether it led to this one
        penalty: Tensor | None,
    ) -> Tensor:
        """`gradient` of speeds in m/s, limited."""
        h = self.scale
        earlier = (h * before[0], *before[1:]) if self.unroll == 2 else None
        grad = gradient(weights, h * surge, u, h * target, penalty, earlier)
        return grad if self.clip is None else clipped(grad, self.clip)

    def _descend(self, state: RNNState, grad: Tensor) -> RNNState:
        """One step of Adam (Kingma & Ba 2015, algorithm 1), and one projection."""
        rate, count = self.rate(), state.updates + 1
        if self.decay is not None:
            rate = rate * (1 + (state.updates / self.decay).floor()).rsqrt()
        m = state.moment1.lerp(grad, 1 - self.momentum) if self.momentum else grad
        v = state.moment2.lerp(grad * grad, 1 - BETA2)
        step_size = (rate / (1 - self.momentum**count) if self.momentum else rate)[..., None] * self.rate_ratio
        v_hat = v / (1 - BETA2**count)[..., None]
        # Clamped because the slope of the root at 0 is infinite: it must not reach the gradients.
        step = step_size * m / (v_hat.clamp(min=torch.finfo(v.dtype).tiny).sqrt() + EPSILON)
        n = state.weights.a.shape[-1]
        da, dw1, dW2, db = step.split([n * size for size in SIZES], -1)
        a, w1, W2, b = state.weights
        weights = self._stable(ShallowWeights(a - da, w1 - dw1, W2 - dW2.unflatten(-1, (n, INPUTS)), b - db))
        return state._replace(weights=weights, moment1=m, moment2=v, updates=count)
