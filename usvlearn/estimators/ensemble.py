"""An ensemble: several estimators side by side, and rules that combine their predictions.

AVE is the mean (paper, section V); WE weights the members, v_WE = Σ c_i v̂_i, with c by recursive least squares (paper,
section VI-B), learned online and predicting before it learns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from usvlearn.errors import ConfigError
from usvlearn.estimator import Estimator
from usvlearn.estimators.rls import rls_step
from usvlearn.hyper import Positive, UnitInterval, as_tensor, check_broadcast
from usvlearn.signals import Inputs, named_leaves


class WeightsState(NamedTuple):
    """What `RecursiveWeights` identifies."""

    weights: Tensor  # (*batch, members)
    factor: Tensor  # (*batch, members, members) square root of their covariance


class EnsembleState(NamedTuple):
    """The members' states, the rules' states, and what each predicted last."""

    members: dict[str, Any]
    combiners: dict[str, Any]
    predictions: Tensor  # (*batch, members + combiners) m/s, in the order of `Ensemble.names`


class Average(nn.Module):
    """AVE: the mean of the members' predictions; `members` names those that count, all by default."""

    def __init__(self, members: Sequence[str] | None = None):
        super().__init__()
        self.members = members

    def init(self, batch: Sequence[int], count: int, like: Tensor) -> dict:
        return {}

    def combine(self, state: dict, predictions: Tensor) -> Tensor:
        return predictions.mean(-1)

    def learn(self, state: dict, predictions: Tensor, surge: Tensor) -> dict:
        return state

    def monitor(self, state: dict, members: Sequence[str]) -> dict[str, Tensor]:
        return {}


class FixedWeights(Average):
    """Σ c_i v̂_i with given c, one weight per member named in `weights`.

    >>> FixedWeights({"aid": 0.7, "rls": 0.3}).combine({}, torch.tensor([1.0, 2.0], dtype=torch.float64))
    tensor(1.3000, dtype=torch.float64)
    """

    def __init__(self, weights: Mapping[str, float]):
        super().__init__(tuple(weights))
        self.register_buffer("weights", as_tensor(list(weights.values())))

    def combine(self, state: dict, predictions: Tensor) -> Tensor:
        return (self.weights * predictions).sum(-1)


class RecursiveWeights(nn.Module):
    """WE: Σ c_i v̂_i with c by recursive least squares, starting from equal weights.

    The members' predictions are almost collinear, so c is poorly determined: it may leave [0, 1], and the sum
    can be worse than its members. The covariance is kept in bounds as in `rls`.

    Args:
        members: names of those that count, all by default.
        forgetting: λ; broadcasts against the batch.
        covariance: initial variance of each weight; broadcasts against the batch.
        trace_max: limit on the covariance's trace above which nothing is forgotten.
        surge_max: physical limit of the prediction, m/s.
    """

    def __init__(
        self,
        members: Sequence[str] | None = None,
        forgetting=0.999,
        covariance=1.0,
        trace_max: float = 1e4,
        surge_max: float = 10.0,
    ):
        super().__init__()
        self.members, self.trace_max, self.surge_max = members, trace_max, surge_max
        self.forgetting, self.covariance = UnitInterval(forgetting, "forgetting"), Positive(covariance, "covariance")

    def init(self, batch: Sequence[int], count: int, like: Tensor) -> WeightsState:
        eye = torch.eye(count, dtype=like.dtype, device=like.device)
        factor = (self.covariance().sqrt()[..., None, None] * eye).expand(*batch, count, count)
        return WeightsState(like.new_full((*batch, count), 1.0 / count), factor)

    def combine(self, state: WeightsState, predictions: Tensor) -> Tensor:
        return (state.weights * predictions).sum(-1).clamp(-self.surge_max, self.surge_max)

    def learn(self, state: WeightsState, predictions: Tensor, surge: Tensor) -> WeightsState:
        innovation = surge - (state.weights * predictions).sum(-1)
        return WeightsState(
            *rls_step(state.weights, state.factor, predictions, innovation, self.forgetting(), self.trace_max)
        )

    def monitor(self, state: WeightsState, members: Sequence[str]) -> dict[str, Tensor]:
        weights = dict(zip([f"weight_{m}" for m in members], state.weights.unbind(-1), strict=True))
        return {**weights, "covariance_trace": (state.factor**2).sum((-2, -1))}


class Ensemble(Estimator):
    """Estimators side by side; predicts by one of its combiners and publishes every prediction in its state.

    Args:
        members: estimators by name.
        combiners: rules by name, `{"average": Average()}` by default.
        output: the combiner whose prediction is the ensemble's own; the last by default.

    Raises:
        ConfigError: no members, a name that is used twice, or a combiner of members that do not exist.

    >>> from usvlearn import AID, Persistence
    >>> ensemble = Ensemble({"aid": AID(), "persistence": Persistence()})
    >>> ensemble.names
    ('aid', 'persistence', 'average')
    """

    def __init__(
        self,
        members: Mapping[str, Estimator],
        combiners: Mapping[str, nn.Module] | None = None,
        output: str | None = None,
    ):
        super().__init__()
        combiners = {"average": Average()} if combiners is None else dict(combiners)
        if not members or not combiners:
            raise ConfigError(f"ensemble: found {len(members)} members, expected at least one, and one combiner")
        for name, member in members.items():
            if not isinstance(member, Estimator):
                raise ConfigError(f"ensemble member {name}: found {member!r}, expected an estimator")
            if not name.isidentifier() or hasattr(nn.ModuleDict, name):
                raise ConfigError(f"ensemble member {name!r}: expected a plain name of letters, digits and _")
        if twice := set(members) & set(combiners):
            raise ConfigError(f"ensemble: {', '.join(sorted(twice))} names both a member and a combiner")
        self.names = (*members, *combiners)
        self.output = list(combiners)[-1] if output is None else output
        if self.output not in combiners:
            raise ConfigError(f"ensemble output: found {output!r}, expected one of {', '.join(combiners)}")
        self.members, self.combiners = nn.ModuleDict(members), nn.ModuleDict(combiners)
        self._places: dict[str, list[int]] = {}  # combiner -> places of its members
        for name, combiner in combiners.items():
            chosen = list(members) if combiner.members is None else combiner.members
            chosen = [chosen] if isinstance(chosen, str) else list(chosen)
            if not chosen or (unknown := sorted(set(chosen) - set(members))):
                raise ConfigError(
                    f"ensemble combiner {name}: found members {', '.join(chosen) or 'none'}, "
                    f"expected some of {', '.join(members)}" + (f" (unknown: {', '.join(unknown)})" if chosen else "")
                )
            self._places[name] = [list(members).index(member) for member in chosen]

    def init(self, batch: Sequence[int] = ()) -> EnsembleState:
        batch = tuple(batch)
        check_broadcast(self, batch)
        members = {name: member.init(batch) for name, member in self.members.items()}
        like = next(leaf for _, leaf in named_leaves(members) if leaf.is_floating_point())
        combiners = {
            name: combiner.init(batch, len(self._places[name]), like) for name, combiner in self.combiners.items()
        }
        return EnsembleState(members, combiners, like.new_zeros((*batch, len(self.names))))

    def predict(self, state: EnsembleState, inputs: Inputs) -> tuple[EnsembleState, Tensor]:
        coasted = {name: member.predict(state.members[name], inputs) for name, member in self.members.items()}
        single = [surge for _, surge in coasted.values()]
        combined = self._combine(state, self._choose(single))
        members = {name: new for name, (new, _) in coasted.items()}
        published = torch.stack([*single, *combined.values()], -1)
        return EnsembleState(members, state.combiners, published), combined[self.output]

    def update(self, state: EnsembleState, inputs: Inputs, surge: Tensor) -> EnsembleState:
        single = [member.predict(state.members[name], inputs)[1] for name, member in self.members.items()]
        members = {name: m.update(state.members[name], inputs, surge) for name, m in self.members.items()}
        chosen = self._choose(single)
        published = torch.stack([*single, *self._combine(state, chosen).values()], -1)
        combiners = {
            name: combiner.learn(state.combiners[name], chosen[name], surge)
            for name, combiner in self.combiners.items()
        }
        return EnsembleState(members, combiners, published)

    def learn(self, state: EnsembleState, inputs: Inputs, surge: Tensor) -> tuple[EnsembleState, Tensor]:
        learned = self.update(state, inputs, surge)
        return learned, learned.predictions[..., self.names.index(self.output)]

    def start(self, state: EnsembleState, surge: Tensor) -> EnsembleState:
        members = {name: member.start(state.members[name], surge) for name, member in self.members.items()}
        return state._replace(members=members)

    def monitor(self, state: EnsembleState) -> dict[str, Tensor]:
        """The members' and combiners' numbers, as `name/number`."""
        parts = [(name, member.monitor(state.members[name])) for name, member in self.members.items()]
        parts += [
            (name, combiner.monitor(state.combiners[name], combiner.members or tuple(self.members)))
            for name, combiner in self.combiners.items()
        ]
        return {f"{name}/{key}": value for name, numbers in parts for key, value in numbers.items()}

    def _choose(self, single: list[Tensor]) -> dict[str, Tensor]:
        """What each combiner sees of the members' predictions, m/s, `(*batch, its members)`."""
        return {name: torch.stack([single[i] for i in places], -1) for name, places in self._places.items()}

    def _combine(self, state: EnsembleState, chosen: dict[str, Tensor]) -> dict[str, Tensor]:
        """The combiners' predictions, m/s, `(*batch,)` each."""
        return {name: rule.combine(state.combiners[name], chosen[name]) for name, rule in self.combiners.items()}
