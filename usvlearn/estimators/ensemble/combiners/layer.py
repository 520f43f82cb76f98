"""The combiners in torch: equations (1) to (4) of `state`."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from usvlearn.core.family import Family
from usvlearn.core.hyperparameters import Hyper, Positive, UnitInterval, as_tensor, check_broadcast
from usvlearn.core.protocol import numbers_of
from usvlearn.errors import ConfigError, check_choice, check_not_negative, check_positive
from usvlearn.estimators.ensemble.combiners import state as at
from usvlearn.estimators.ensemble.combiners.state import LOSSES, TINY, BOAState, ExponentialState, WeightsState
from usvlearn.estimators.least_squares.rls import rls_step


def fill_inactive(predictions: Tensor, weights: Tensor) -> Tensor:
    """Replace each NaN (a member that is inactive) by the weighted mean of the other members, `(*batch, members)`."""
    active = ~predictions.isnan()
    present = torch.where(active, predictions, 0.0)
    shares = active * (weights + TINY)
    total = shares.sum(-1, keepdim=True)
    together = (shares * present).sum(-1, keepdim=True) / torch.where(total > 0, total, 1.0)
    return torch.where(active, present, torch.where(total > 0, together, torch.nan))


def members_or_target(predictions: Tensor, weights: Tensor, surge: Tensor) -> Tensor:
    """`fill_inactive`; where all are inactive, `surge`, m/s, `(*batch,)`, so that every loss is 0."""
    x = fill_inactive(predictions, weights)
    return torch.where(x.isnan(), surge[..., None], x)


class Combiner(nn.Module, abc.ABC):
    """A combiner; `members` names the members that it combines, all by default.

    An `Ensemble` binds it to the names of its members. `predictions` are m/s, `(*batch, its members)`, NaN where a
    member is inactive.
    """

    def __init__(self, members: str | Sequence[str] | None = None):
        super().__init__()
        self.members = [members] if isinstance(members, str) else members
        self.names: tuple[str, ...] = ()

    def bind(self, names: Sequence[str]) -> None:
        """Set the names of the members that it combines."""
        self.names = tuple(names)

    def init(self, batch: Sequence[int], like: Tensor) -> Any:
        """The state before the first sample."""
        return {}

    @abc.abstractmethod
    def combine(self, state: Any, predictions: Tensor) -> Tensor:
        """The prediction, m/s, `(*batch,)`."""

    def learn(self, state: Any, predictions: Tensor, surge: Tensor, dt: Tensor) -> Any:
        """The state after `surge`, m/s, was measured."""
        return state

    def description(self) -> dict[str, Any] | None:
        """As `Estimator.description`, of the combiner."""
        return None

    def monitor(self, state: Any) -> dict[str, Tensor]:
        """Diagnostics of the state."""
        return {}

    def _weights(self, weights: Tensor) -> dict[str, Tensor]:
        return dict(zip([f"weight_{name}" for name in self.names], weights.unbind(-1), strict=True))


class Average(Combiner):
    """AVE: the mean of the predictions (paper, section V).

    Args:
        members: names of those that count, all by default.

    >>> Average().combine({}, torch.tensor([1.0, 2.0, torch.nan]))
    tensor(1.5000)
    """

    def combine(self, state: Any, predictions: Tensor) -> Tensor:
        return fill_inactive(predictions, torch.ones_like(predictions)).mean(-1)

    def description(self) -> dict[str, Any]:
        return {"kind": "average", "numbers": numbers_of(at.Plain, self)}


class FixedWeights(Combiner):
    """Σ c_i v̂_i with given c, one weight per member named in `weights`.

    A weighted mean in place of the average of the paper, section V.

    Args:
        weights: c by member, no unit. They may have any sum.

    >>> FixedWeights({"aid": 0.7, "rls": 0.3}).combine({}, torch.tensor([1.0, 2.0], dtype=torch.float64))
    tensor(1.3000, dtype=torch.float64)
    """

    weights: Tensor  # (members,)

    def __init__(self, weights: Mapping[str, float]):
        super().__init__(tuple(weights))
        self.register_buffer("weights", as_tensor(list(weights.values())))

    def combine(self, state: Any, predictions: Tensor) -> Tensor:
        return (self.weights * fill_inactive(predictions, self.weights.abs())).sum(-1)

    def description(self) -> dict[str, Any]:
        return {"kind": "fixed", "numbers": numbers_of(at.Plain, self), "vector": self.weights.tolist()}


class RecursiveWeights(Combiner):
    """WE: Σ c_i v̂_i with c by recursive least squares, starting from equal weights (paper, section VI-B).

    The members' predictions are almost collinear, so c is poorly determined: it may leave [0, 1], and the sum
    can be worse than its members. The covariance is kept in bounds as in `rls`.

    Args:
        members: names of those that count, all by default.
        forgetting: λ, between 0 and 1, no unit; broadcasts against the batch.
        covariance: initial variance of each weight, no unit; broadcasts against the batch.
        trace_max: limit on the covariance's trace, no unit, above which nothing is forgotten.
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a number outside its range.

    >>> rule = RecursiveWeights()
    >>> rule.bind(["aid", "rls"])
    >>> state = rule.init((), torch.zeros(()).double())
    >>> rule.combine(state, torch.tensor([1.0, 2.0]).double())
    tensor(1.5000, dtype=torch.float64)
    """

    def __init__(
        self,
        members: Sequence[str] | None = None,
        forgetting: Hyper = 0.999,
        covariance: Hyper = 1.0,
        trace_max: float = 1e4,
        surge_max: float = 10.0,
    ):
        super().__init__(members)
        self.trace_max, self.surge_max = check_positive("trace_max", trace_max), check_positive("surge_max", surge_max)
        self.forgetting, self.covariance = UnitInterval(forgetting, "forgetting"), Positive(covariance, "covariance")

    def init(self, batch: Sequence[int], like: Tensor) -> WeightsState:
        check_broadcast(self, tuple(batch))
        count = len(self.names)
        eye = torch.eye(count, dtype=like.dtype, device=like.device)
        factor = (self.covariance().sqrt()[..., None, None] * eye).expand(*batch, count, count)
        return WeightsState(like.new_full((*batch, count), 1.0 / count), factor)

    def combine(self, state: WeightsState, predictions: Tensor) -> Tensor:
        active = fill_inactive(predictions, torch.ones_like(predictions))
        return (state.weights * active).sum(-1).clamp(-self.surge_max, self.surge_max)

    def learn(self, state: WeightsState, predictions: Tensor, surge: Tensor, dt: Tensor) -> WeightsState:
        inactive = predictions.isnan().all(-1)
        x = torch.where(inactive[..., None], 0.0, fill_inactive(predictions, torch.ones_like(predictions)))
        forgetting = torch.where(inactive, 1.0, self.forgetting())
        innovation = surge - (state.weights * x).sum(-1)
        return WeightsState(*rls_step(state.weights, state.factor, x, innovation, forgetting, self.trace_max))

    def description(self) -> dict[str, Any]:
        return {"kind": "recursive", "numbers": numbers_of(at.Recursive, self)}

    def monitor(self, state: WeightsState) -> dict[str, Tensor]:
        return {**self._weights(state.weights), "covariance_trace": (state.factor**2).sum((-2, -1))}


class Prior(Combiner):
    """A combiner with a prior weight for each member; arguments are those of `ExponentialWeights`."""

    log_prior: Tensor  # (members,)

    def __init__(
        self, members: str | Sequence[str] | None, memory: Hyper | None, loss: str, prior: Mapping[str, float] | None
    ):
        super().__init__(members)
        self.memory = None if memory is None else Positive(memory, "memory")
        self.loss = check_choice("loss", loss, LOSSES)
        self.prior = {name: check_positive(f"prior.{name}", weight) for name, weight in (prior or {}).items()}

    def bind(self, names: Sequence[str]) -> None:
        super().bind(names)
        if unknown := sorted(set(self.prior) - set(names)):
            raise ConfigError(
                f"prior: found {', '.join(unknown)}, expected some of {', '.join(names)}: take out the rest"
            )
        prior = as_tensor([self.prior.get(name, 1.0) for name in names])
        self.register_buffer("log_prior", (prior / prior.sum()).log(), persistent=False)

    def combine(self, state: ExponentialState | BOAState, predictions: Tensor) -> Tensor:
        return (state.weights * fill_inactive(predictions, state.weights)).sum(-1)

    def monitor(self, state: ExponentialState | BOAState) -> dict[str, Tensor]:
        return self._weights(state.weights)

    def _spec(self, family: Family[Any]) -> dict[str, Any]:
        values, prior = numbers_of(family.numbers, self), self.log_prior.exp().tolist()
        return {"kind": family.kinds[0], "loss": self.loss, "numbers": values, "vector": prior}

    def _kept(self, dt: Tensor) -> Tensor | float:
        """κ, `(*batch, 1)`."""
        return 1.0 if self.memory is None else (-dt / self.memory()).exp()[..., None]


class ExponentialWeights(Prior):
    """w_k ∝ w0_k exp(−rate · Σ κ^(t−s) loss_k(s)): Vovk's and Littlestone & Warmuth's rule.

    It finds the best member, not the best mixture, and its rate has to be chosen; BOA needs neither.

    Vovk 1990; Littlestone & Warmuth 1994.

    Args:
        members: names of those that count, all by default.
        rate: per unit of the loss, s/m (s²/m² of the square); broadcasts against the batch.
        memory: s, over which losses are forgotten; None never forgets; broadcasts against the batch.
        loss: "absolute", which MAE measures, or "square".
        prior: weights at the start by member, no unit, relative to 1 of those not named.

    Raises:
        ConfigError: a number outside its range, or another loss.

    >>> rule = ExponentialWeights(rate=10.0, memory=None)
    >>> rule.bind(["aid", "rls"])
    >>> state = rule.init((), torch.zeros(()).double())
    >>> x = torch.tensor([1.0, 1.2]).double()
    >>> rule.learn(state, x, torch.tensor(1.0).double(), torch.tensor(0.4).double()).weights  # 1 : e⁻²
    tensor([0.8808, 0.1192], dtype=torch.float64, grad_fn=<SoftmaxBackward0>)
    """

    def __init__(
        self,
        members: str | Sequence[str] | None = None,
        rate: Hyper = 20.0,
        memory: Hyper | None = 20.0,
        loss: str = "absolute",
        prior: Mapping[str, float] | None = None,
    ):
        super().__init__(members, memory, loss, prior)
        self.rate = Positive(rate, "rate")

    def init(self, batch: Sequence[int], like: Tensor) -> ExponentialState:
        check_broadcast(self, tuple(batch))
        zeros = like.new_zeros((*batch, len(self.names)))
        return ExponentialState(self.log_prior.exp().expand_as(zeros), zeros)

    def learn(self, state: ExponentialState, predictions: Tensor, surge: Tensor, dt: Tensor) -> ExponentialState:
        error = members_or_target(predictions, state.weights, surge) - surge[..., None]
        losses = self._kept(dt) * state.losses + (error.abs() if self.loss == "absolute" else error * error)
        return ExponentialState((self.log_prior - self.rate()[..., None] * losses).softmax(-1), losses)

    def description(self) -> dict[str, Any]:
        return self._spec(at.EXPONENTIAL)


class BOA(Prior):
    """Bernstein online aggregation: weight goes to members that improve the mixture.

    The equations, and where κ departs from the published rule, are in `state` (Wintenberger 2017).

    Args:
        members: names of those that count, all by default.
        memory: s, over which losses are forgotten; None never forgets; broadcasts against the batch.
        loss: "absolute", which MAE measures, or "square".
        scale: E₀, least range of the losses, m/s (m²/s² of the square): how far predictions lie apart, roughly.
        share: of the weight that goes to the members by the priors at every step, a share of 0 … 1.
        prior: weights at the start by member, no unit, relative to 1 of those not named.

    Raises:
        ConfigError: a number outside its range, or another loss.

    >>> boa = BOA(prior={"rnn": 0.1})
    >>> boa.bind(["aid", "rls", "rnn"])
    >>> boa.init((), torch.zeros(()).double()).weights
    tensor([0.4762, 0.4762, 0.0476], dtype=torch.float64)
    """

    def __init__(
        self,
        members: str | Sequence[str] | None = None,
        memory: Hyper | None = 30.0,
        loss: str = "absolute",
        scale: float = 0.01,
        share: float = 0.01,
        prior: Mapping[str, float] | None = None,
    ):
        super().__init__(members, memory, loss, prior)
        self.scale, self.share = check_positive("scale", scale, "of m/s"), check_not_negative("share", share)
        if share > 1:
            raise ConfigError(f"share: found {share}, expected a number between 0 and 1")

    def init(self, batch: Sequence[int], like: Tensor) -> BOAState:
        check_broadcast(self, tuple(batch))
        zeros = like.new_zeros((*batch, len(self.names)))
        return BOAState(self.log_prior.exp().expand_as(zeros), zeros, zeros, zeros + self.scale)

    def learn(self, state: BOAState, predictions: Tensor, surge: Tensor, dt: Tensor) -> BOAState:
        x = members_or_target(predictions, state.weights, surge)
        combined = (state.weights * x).sum(-1, keepdim=True)
        error = combined - surge[..., None]
        loss = (error.sign() if self.loss == "absolute" else 2 * error) * (x - combined)
        kappa = self._kept(dt)
        ranges = torch.maximum((kappa * state.ranges).clamp(min=self.scale), loss.abs())  # (1)
        surprising = self._rates(ranges, state.squares) * loss
        surcharge = torch.where(surprising > 0.5, ranges, 0.0)
        losses = kappa * state.losses + 0.5 * (loss * (1 + surprising) + surcharge)  # (2)
        squares = kappa * state.squares + loss * loss
        rates = self._rates(ranges, squares)  # (3)
        weights = (self.log_prior + rates.log() - rates * losses).softmax(-1)  # (4)
        weights = torch.lerp(weights, self.log_prior.exp(), self.share)
        return BOAState(weights, losses, squares, ranges)

    def description(self) -> dict[str, Any]:
        described = self._spec(at.BOA)
        return described | {"vector": [*described["vector"], *self._costs().tolist()]}

    def _costs(self) -> Tensor:
        """c = log(1/w0) of (3), `(members,)`."""
        return (-self.log_prior).clamp(min=TINY)

    def _rates(self, ranges: Tensor, squares: Tensor) -> Tensor:
        """η of (3) as √(c / max(V, c E²)), whose slope is finite where V = 0; c > 0 even with one member."""
        c = self._costs()
        return (c / torch.maximum(squares, c * ranges * ranges)).sqrt()
