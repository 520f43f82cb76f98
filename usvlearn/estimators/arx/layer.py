"""The ARX filter in torch: equations (1) to (7) of `state`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimator import Estimator, describe
from usvlearn.estimators.arx.state import (
    COMMANDS,
    FAMILY,
    LONGEST,
    LOOSEST,
    MOST_LAGS,
    NOISE,
    NOISE_LEAST,
    NOISE_SHARE,
    RATES,
    REST_SQUARE,
    REST_TIME,
    STEP,
    ARXState,
    deviations,
)
from usvlearn.hyper import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.signals import Inputs, tree_map, where

GROUP = len(COMMANDS)


class ARX(Estimator):
    """Predicts the increment of the speed from the last increments and commands; learns by a Kalman filter.

    Args:
        lags: L, how many increments and earlier commands the prediction uses.
        even: adds four features that are the same forwards and backwards.
        turning: adds the yaw rate and its change.
        thrust_speed: adds each side's command times |v|.
        project: keeps the weights of the drag where drag slows the boat, so that free runs do not run away.
        scale: s, of the prior deviations of the weights, as multiples of the noise; broadcasts against the batch.
        walk: variance by which the weights walk in 0.4 s, as a share of the prior's; broadcasts against the batch.
        degrees: ν of Student's t distribution of the noise; broadcasts against the batch. None and infinity:
            Gaussian noise.
        surge_max: physical limit of the prediction, m/s.

    >>> arx = ARX(lags=3)
    >>> len(arx.names), arx.init((8,)).factor.shape
    (27, torch.Size([8, 27, 27]))
    """

    ratios: Tensor  # (p,) prior deviations over `scale`
    drags: Tensor  # (3, p) a of (7)

    def __init__(
        self,
        lags: int = 3,
        even: bool = True,
        turning: bool = False,
        thrust_speed: bool = False,
        project: bool = True,
        scale: Hyper = 0.3,
        walk: Hyper = 3e-4,
        degrees: Hyper | None = 5.0,
        surge_max: float = 10.0,
    ):
        super().__init__()
        if isinstance(lags, bool) or not (isinstance(lags, int) and 0 <= lags <= MOST_LAGS):
            raise ConfigError(f"lags: found {lags!r}, expected a whole number, 0 … {MOST_LAGS}")
        options = {"even": even, "turning": turning, "thrust_speed": thrust_speed, "project": project}
        for name, value in options.items():
            if not isinstance(value, bool):
                raise ConfigError(f"{name}: found {value!r}, expected true or false")
        self.lags, self.even, self.turning, self.thrust_speed, self.project = lags, *options.values()
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.scale, self.walk = Positive(scale, "scale"), Positive(walk, "walk")
        degrees = None if isinstance(degrees, float) and degrees == math.inf else degrees
        self.degrees = None if degrees is None else Positive(degrees, "degrees")
        found = deviations(lags, even, turning, thrust_speed)
        self.names = tuple(found)
        self.register_buffer("ratios", as_tensor(list(found.values())))
        drags = [{"speed": 1.0}, *({"speed_square": 1.0, "even_speed_square": sign} for sign in (1.0, -1.0))]
        self.register_buffer("drags", as_tensor([[row.get(name, 0.0) for name in found] for row in drags]))

    def init(self, batch: Sequence[int] = ()) -> ARXState:
        check_broadcast(self, tuple(batch))
        p, zero = len(self.names), self.ratios.new_zeros(tuple(batch))
        zeros, noise = self.ratios.new_zeros((*batch, p)), torch.full_like(zero, NOISE**2)
        factor = torch.diag_embed(self.prior).expand(*batch, p, p)
        started = torch.ones_like(zero, dtype=torch.bool)
        return ARXState(zeros, factor, zeros, zero, noise, zero, zero, zero, started)

    def predict(self, state: ARXState, inputs: Inputs) -> tuple[ARXState, Tensor]:
        h, features, estimate = self._estimate(state, inputs)
        predicted = self._limit(estimate)
        _, _, spread = rotated(state.factor, h[..., None] * features)
        state = state._replace(deviation=(state.noise * spread).sqrt())
        return self._remember(state, features, predicted, h), predicted

    def update(self, state: ARXState, inputs: Inputs, surge: Tensor) -> ARXState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: ARXState, inputs: Inputs, surge: Tensor) -> tuple[ARXState, Tensor]:
        h, features, estimate = self._estimate(state, inputs)
        error, tails = surge - estimate, self._tails()
        g, G, spread = rotated(state.factor, h[..., None] * features)
        state = state._replace(deviation=(state.noise * spread).sqrt())
        seen = error * error / spread
        weight = (1 + tails) / (1 + tails * seen / state.noise)  # (2)
        gain, factor = measured(state.factor, g, G, 1 / weight)
        noise = (state.noise + NOISE_SHARE * (weight * seen - state.noise)).clamp(min=NOISE_LEAST**2)  # (3)
        theta = state.theta + gain * error[..., None]
        learned = state._replace(
            theta=self._projected(theta, factor) if self.project else theta,
            factor=self._walked(factor, state.turn, h),
            noise=noise,
            turn=torch.where(state.turn + 1 < len(self.names), state.turn + 1, 0.0),
        )
        rests = inputs.command_left**2 + inputs.command_right**2 + features[..., 1] ** 2 < REST_SQUARE
        rest = torch.where(rests, state.rest + inputs.dt, 0.0)
        state = tree_map(lambda new, old: where(rest <= REST_TIME, new, old), learned, state)
        return self._remember(state._replace(rest=rest), features, surge, h), self._limit(estimate)

    def start(self, state: ARXState, surge: Tensor) -> ARXState:
        past, started = torch.zeros_like(state.past), torch.ones_like(state.started)
        return state._replace(past=past, surge=surge, started=started)

    def inflate_covariance(self, state: ARXState, factor: Tensor) -> ARXState:
        """P times `factor`, up to `LOOSEST` times P₀, in trace."""
        U, D = parts(state.factor)
        trace = ((U * U).sum(-1) * D).sum(-1)
        factor = torch.minimum(factor, (LOOSEST * self.prior.sum(-1) / trace).clamp(min=1))
        return state._replace(factor=joined(U, D * factor[..., None]))

    def spec(self) -> dict[str, Any]:
        return describe(FAMILY, self, size=len(self.names), tails=self._tails())

    def monitor(self, state: ARXState) -> dict[str, Tensor]:
        U, D = parts(state.factor)
        weights = dict(zip(self.names, state.theta.unbind(-1), strict=True))
        return {**weights, "covariance_trace": ((U * U).sum(-1) * D).sum(-1), "deviation": state.deviation}

    @property
    def prior(self) -> Tensor:
        """The diagonal of P₀, `(p,)` or `(*batch, p)`."""
        return (self.scale()[..., None] * self.ratios) ** 2

    def _tails(self) -> Tensor:
        """1/ν."""
        return self.ratios.new_zeros(()) if self.degrees is None else 1 / self.degrees()

    def _limit(self, x: Tensor) -> Tensor:
        return x.clamp(-self.surge_max, self.surge_max)

    def _estimate(self, state: ARXState, inputs: Inputs) -> tuple[Tensor, Tensor, Tensor]:
        """h and f of (1), and the speed before its limits."""
        h = (inputs.dt / STEP).clamp(max=LONGEST)
        features = self._features(state, inputs)
        return h, features, state.surge + h * (features * state.theta).sum(-1)

    def _features(self, state: ARXState, inputs: Inputs) -> Tensor:
        """f of (1), `(*batch, p)`."""
        left, right, _, yaw_rate, _ = inputs
        v, past, started = self._limit(state.surge), state.past, state.started[..., None]
        begin, end = RATES + self.lags, RATES + self.lags + GROUP * (self.lags + 1)
        total = left + right
        now = torch.stack([total, left - right, left * left.abs(), right * right.abs()], -1)
        before = torch.where(started, now.repeat(*[1] * (now.ndim - 1), self.lags), past[..., begin : end - GROUP])
        found = [torch.ones_like(v), v, v * v.abs(), yaw_rate.abs() * v]
        rest = []
        if self.even:
            rest += [left.abs() + right.abs(), left * left + right * right, v * v, total * v]
        if self.turning:
            r = past[..., end + len(rest)]
            rest += [yaw_rate, torch.where(state.started, 0.0, yaw_rate - r)]
        if self.thrust_speed:
            rest += [left * v.abs(), right * v.abs()]
        groups = [torch.stack(found, -1), past[..., RATES:begin], now, before]
        return torch.cat([*groups, torch.stack(rest, -1)] if rest else groups, -1)

    def _projected(self, theta: Tensor, factor: Tensor) -> Tensor:
        """θ after (7)."""
        for a in self.drags.unbind(0):
            g, G, _ = rotated(factor, a)
            value = (a * theta).sum(-1).clamp(min=0) / (g * G).sum(-1)
            theta = theta - (parts(factor)[0] * G[..., None]).sum(-2) * value[..., None]
        return theta

    def _walked(self, factor: Tensor, turn: Tensor, h: Tensor) -> Tensor:
        """The factor after the walk (4) of the weight whose turn it is."""
        here = (torch.arange(len(self.names), device=turn.device) == turn[..., None]).to(factor.dtype)
        U, D = parts(factor)
        prior, own = (here * self.prior).sum(-1), ((U * here[..., None, :]).sum(-1).square() * D).sum(-1)
        share = len(self.names) * (h * self.walk())
        return added(factor, here, torch.minimum(share * prior, (prior - own).clamp(min=0)))

    def _remember(self, state: ARXState, features: Tensor, surge: Tensor, h: Tensor) -> ARXState:
        """The state that keeps f and the increment to the speed from which the next step departs."""
        past, end = features, RATES + self.lags
        if self.lags:
            rate = self._limit((surge - state.surge) / torch.where(h > 0, h, 1.0))[..., None]
            past = torch.cat([past[..., :RATES], rate, past[..., RATES : end - 1], past[..., end:]], -1)
        return state._replace(past=past, surge=surge, started=torch.zeros_like(state.started))


def parts(factor: Tensor) -> tuple[Tensor, Tensor]:
    """Uᵀ, `(*batch, p, p)`, and D, `(*batch, p)`, of P = U D Uᵀ."""
    eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
    return factor.tril(-1) + eye, factor.diagonal(dim1=-2, dim2=-1)


def joined(U: Tensor, D: Tensor) -> Tensor:
    """The inverse of `parts`; entries of U above its diagonal are ignored."""
    return U.tril(-1) + torch.diag_embed(D)


def rotated(factor: Tensor, phi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """g = Uᵀφ and G = Dg, `(*batch, p)`, and S = 1 + φᵀPφ, `(*batch,)`.

    >>> rotated(torch.tensor([[2.0, 0.0], [0.5, 1.0]]), torch.tensor([1.0, 1.0]))
    (tensor([1.0000, 1.5000]), tensor([2.0000, 1.5000]), tensor(5.2500))
    """
    U, D = parts(factor)
    g = (U * phi[..., None, :]).sum(-1)
    return g, D * g, 1 + (D * g * g).sum(-1)


def measured(factor: Tensor, g: Tensor, G: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """The gain, `(*batch, p)`, and the factor after a measurement whose noise has this variance: equation (5)."""
    U, D = parts(factor)
    after = noise[..., None] + (g * G).cumsum(-1)
    before = torch.cat([noise[..., None], after[..., :-1]], -1)
    sums = (U * G[..., None]).cumsum(-2)
    earlier = sums - U * G[..., None]
    return sums[..., -1, :] / after[..., -1:], joined(U - (g / before)[..., None] * earlier, D * before / after)


def added(factor: Tensor, here: Tensor, q: Tensor) -> Tensor:
    """The factor after q is added to a P_kk, k the place where `here` is 1: equation (6)."""
    U, D = parts(factor)
    a = torch.linalg.solve_triangular(U.mT, here[..., None], upper=True, unitriangular=True).squeeze(-1)
    squares = a * a / D
    c = q[..., None] / (1 + q[..., None] * (squares.flip(-1).cumsum(-1).flip(-1) - squares))
    new = D + c * a * a
    sums = U * a[..., None]
    rest = here[..., None, :] - (sums.flip(-2).cumsum(-2).flip(-2) - sums)  # a of (6) before its step j
    return joined(U * (D / new)[..., None] + rest * (c * a / new)[..., None], new)
