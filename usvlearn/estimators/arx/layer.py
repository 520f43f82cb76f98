"""The ARX filter in torch: equations (1) to (4) of `state`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.core.protocol import Estimator, describe
from usvlearn.core.samples import Inputs, tree_map, where
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.arx.state import (
    COMMANDS,
    FAMILY,
    LONGEST,
    MOST_LAGS,
    RATES,
    REST_SQUARE,
    REST_TIME,
    STEP,
    ARXState,
    deviations,
)
from usvlearn.estimators.least_squares.state import LOOSEST, NOISE, NOISE_LEAST, NOISE_SHARE
from usvlearn.estimators.ud_factorization.layer import (
    added,
    inflate_covariance,
    measured,
    packed,
    projected,
    rotated,
    unpacked,
    variances,
)

GROUP = len(COMMANDS)


class ARX(Estimator):
    """Predicts the increment of the speed from the last increments and commands; learns by a Kalman filter.

    The weights of outliers are those of West 1981; the filter is derived in `docs/theory/estimators.md`.

    Args:
        lags: L, the number of increments and of earlier commands that the prediction uses.
        even: adds four features that are the same forwards and backwards.
        turning: adds the yaw rate and its change.
        thrust_speed: adds each side's command times |v|.
        project: keeps the weights of the drag where drag slows the boat, so that open-loop simulations do not run away.
        scale: s, of the prior deviations of the weights, as multiples of the noise; broadcasts against the batch.
        walk: variance by which the weights walk in 0.4 s, as a share of the prior's; broadcasts against the batch.
        degrees: ν of Student's t distribution of the noise, no unit; broadcasts against the batch. None and infinity:
            Gaussian noise.
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a number outside its range, or an option that is neither true nor false.

    >>> arx = ARX(lags=3)
    >>> len(arx.names), arx.init((8,)).factor.shape
    (27, torch.Size([8, 27, 27]))
    """

    ratios: Tensor  # (p,) prior deviations over `scale`
    drags: Tensor  # (3, p) each d of the drag

    frozen = FAMILY.frozen

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
        _, _, _, spread = self._spread(state, h[..., None] * features)
        state = state._replace(deviation=(state.noise * spread).sqrt())
        return self._remember(state, features, predicted, h), predicted

    def free_step(self, state: ARXState, inputs: Inputs) -> tuple[ARXState, Tensor]:
        """As `predict`, without the deviation."""
        h, features, estimate = self._estimate(state, inputs)
        predicted = self._limit(estimate)
        return self._remember(state, features, predicted, h), predicted

    def update(self, state: ARXState, inputs: Inputs, surge: Tensor) -> ARXState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: ARXState, inputs: Inputs, surge: Tensor) -> tuple[ARXState, Tensor]:
        h, features, estimate = self._estimate(state, inputs)
        error, tails = surge - estimate, self._tails()
        U, D, g, spread = self._spread(state, h[..., None] * features)
        state = state._replace(deviation=(state.noise * spread).sqrt())
        seen = error * error / spread
        weight = (1 + tails) / (1 + tails * seen / state.noise)  # (2)
        U, D, gain, S = measured(U, D, g, 1 / weight)
        noise = (state.noise + NOISE_SHARE * (weight * seen - state.noise)).clamp(min=NOISE_LEAST**2)  # (3)
        theta = state.theta + gain * (error / S)[..., None]
        if self.project:
            for d in self.drags.unbind(0):
                theta = projected(theta, U, D, d)
        # A member that diverged may hold any number.
        turn = torch.where((state.turn >= 0) & (state.turn < len(self.names)), state.turn, 0.0).floor()
        learned = state._replace(
            theta=theta,
            factor=packed(*self._walked(U, D, turn, h)),
            noise=noise,
            turn=torch.where(turn + 1 < len(self.names), turn + 1, 0.0),
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
        trace = variances(*unpacked(state.factor)).sum(-1)
        return state._replace(factor=inflate_covariance(state.factor, factor, LOOSEST * self.prior.sum(-1) / trace))

    def description(self) -> dict[str, Any]:
        return describe(FAMILY, self, size=len(self.names), tails=self._tails())

    def monitor(self, state: ARXState) -> dict[str, Tensor]:
        trace = variances(*unpacked(state.factor)).sum(-1)
        weights = dict(zip(self.names, state.theta.unbind(-1), strict=True))
        return {**weights, "covariance_trace": trace, "deviation": state.deviation}

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

    def _spread(self, state: ARXState, phi: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """U, D, g = Uᵀφ and S of (2)."""
        U, D = unpacked(state.factor)
        g = rotated(U, phi)
        return U, D, g, 1 + (D * g * g).sum(-1)

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

    def _walked(self, U: Tensor, D: Tensor, turn: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
        """U and D after the walk (4) of the weight whose turn it is."""
        here = (torch.arange(len(self.names), device=turn.device) == turn[..., None]).to(D.dtype)
        prior, own = (here * self.prior).sum(-1), (here * variances(U, D)).sum(-1)
        share = len(self.names) * (h * self.walk())
        return added(U, D, here, torch.minimum(share * prior, (prior - own).clamp(min=0)))

    def _remember(self, state: ARXState, features: Tensor, surge: Tensor, h: Tensor) -> ARXState:
        """The state that keeps f and the increment to the speed from which the next step departs."""
        past, end = features, RATES + self.lags
        if self.lags:
            rate = self._limit((surge - state.surge) / torch.where(h > 0, h, 1.0))[..., None]
            past = torch.cat([past[..., :RATES], rate, past[..., RATES : end - 1], past[..., end:]], -1)
        return state._replace(past=past, surge=surge, started=torch.zeros_like(state.started))
