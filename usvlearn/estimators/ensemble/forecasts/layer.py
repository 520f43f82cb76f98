"""Forecasts over several horizons: their arguments, their first state, and what their state tells."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from usvlearn.core.protocol import has_kernel, numbers_of
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.errors import ConfigError, check_not_negative, check_positive
from usvlearn.estimators.ensemble.combiners.layer import BOA
from usvlearn.estimators.ensemble.combiners.state import TINY
from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.forecasts import state as at
from usvlearn.estimators.ensemble.forecasts.state import ForecastState
from usvlearn.estimators.ensemble.manoeuvre_intervals import layer as conditional


class ForecastSettings(nn.Module):
    """Open-loop simulations of an ensemble's members from regular origins; weighs them, and makes intervals, for each
    horizon.

    Args:
        horizons: s, increasing.
        members: names of the members that are weighed; those of the ensemble's output combiner by default.
        overlap: n, how many forecasts over a horizon are under way at the same time: an origin goes on to the horizon h
            every h/n s. Each costs one step of all members at every step.
        memory: s over which losses are forgotten at horizon 0,
        growth: and what is added to it, s for each s of the horizon.
        scale: least range of the losses at 0.4 s, m/s.
        share: of the weight that goes to the members equally at every loss, a share of 0 … 1.

    Raises:
        ConfigError: horizons that are not increasing, too many of them, or a number outside its range.

    >>> from usvlearn import AID, Ensemble, Persistence
    >>> ensemble = Ensemble({"aid": AID(), "persistence": Persistence()}, forecasts=ForecastSettings((0.4, 10.0)))
    >>> ensemble.init((8,)).forecasts.weights.shape  # (boats, slots, horizons, members)
    torch.Size([8, 11, 2, 2])
    """

    horizons: Tensor  # (H,) s

    def __init__(
        self,
        horizons: Sequence[float] = at.HORIZONS,
        members: Sequence[str] | None = None,
        overlap: float = 5.0,
        memory: float = 30.0,
        growth: float = 4.0,
        scale: float = 0.01,
        share: float = 0.01,
    ):
        super().__init__()
        if not isinstance(horizons, Sequence) or isinstance(horizons, str):
            raise ConfigError(f"forecasts.horizons: found {horizons!r}, expected a list of times, s")
        chosen = [check_positive("forecasts.horizons", h, "of s") for h in horizons]
        if not chosen or sorted(set(chosen)) != chosen or len(chosen) > at.MOST_HORIZONS:
            raise ConfigError(
                f"forecasts.horizons: found {list(horizons)}, expected 1 … {at.MOST_HORIZONS} times, increasing"
            )
        self.overlap = check_positive("forecasts.overlap", overlap)
        begins = [0.0, *chosen[:-1]]  # of the ages at which a forecast has not yet reached the horizon
        self.slots = sum(int(overlap * (1 - a / b) + 1e-9) + 1 for a, b in zip(begins, chosen, strict=True))
        if self.slots > at.MOST_SLOTS:
            raise ConfigError(
                f"forecasts.overlap: found {overlap}, expected less: {self.slots} forecasts would be under way at the "
                f"same time, of {at.MOST_SLOTS} at most"
            )
        self.members = [members] if isinstance(members, str) else None if members is None else list(members)
        memory, growth = check_positive("forecasts.memory", memory, "of s"), check_not_negative("growth", growth)
        self.register_buffer("horizons", torch.tensor(chosen, dtype=torch.float64))
        self.labels = tuple(f"{h:g}" for h in chosen)
        self.rule = BOA(memory=[memory + growth * h for h in chosen], scale=scale, share=share)
        self.names: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the last axis of what is published."""
        return (*self.names, at.PERSISTENCE, at.ENSEMBLE)

    def bind(
        self, names: Sequence[str], members: Mapping[str, Any], coverage: float, surge_max: float, knows: bool
    ) -> None:
        """Set the members that are weighed, and what the ensemble decides; `knows` whether intervals know the
        manoeuvre.
        """
        for name in names:
            if name not in members or not has_kernel(members[name]):
                known = ", ".join(key for key, each in members.items() if has_kernel(each))
                raise ConfigError(
                    f"forecasts.members: found {name}, expected some of those with a kernel, {known or 'none'}, or "
                    "forecasts: null"
                )
        if not names or len(set(names)) < len(names):
            raise ConfigError(f"forecasts.members: found {', '.join(names) or 'none'}, expected each member once")
        self.names, self.coverage, self.surge_max, self.knows = tuple(names), coverage, surge_max, knows
        self.rule.bind(names)
        self._frozen = {name: members[name].frozen for name in names}

    def init(self, batch: Sequence[int], members: Mapping[str, Any], states: Mapping[str, Any]) -> ForecastState:
        """The state before the first sample, of an ensemble whose members have these states."""
        H, M, slots, batch = len(self.horizons), len(self.names), self.slots, tuple(batch)
        frozen = {
            name: {
                key: leaf[(..., None, *[slice(None)] * (leaf.ndim - len(batch)))]
                .expand(*batch, slots, *leaf.shape[len(batch) :])
                .clone()
                for key, leaf in self._leaves(name, states[name]).items()
            }
            for name in self.names
        }
        like = next(leaf for leaves in frozen.values() for leaf in leaves.values() if leaf.is_floating_point())
        zero = like.new_zeros(batch)
        wide = zero[..., None].expand(*batch, H).clone()
        rule = self.rule.init((*batch, H), like)
        return ForecastState(
            frozen=frozen,
            elapsed=like.new_full((*batch, slots), at.EMPTY),
            reach=like.new_zeros((*batch, slots)),
            origin=like.new_zeros((*batch, slots)),
            weights=rule.weights[..., None, :, :].expand(*batch, slots, H, M).clone(),
            widths=like.new_zeros((*batch, slots, H)),
            since=wide + self.horizons.to(like.dtype),
            coasted=zero,
            rule=tree_map(torch.clone, rule),
            error=wide,
            quantile=wide + at.FIRST,
            errors=wide,
            predictions=like.new_full((*batch, H, M + 2), math.nan),
            halfwidths=wide + math.nan,
            conditional=conditional.init_horizons(batch, slots, H, like) if self.knows else at.NONE,
        )

    def start(self, state: ForecastState) -> ForecastState:
        """A segment starts: what is under way is dropped, and the next measured step is an origin."""
        return state._replace(
            elapsed=torch.full_like(state.elapsed, at.EMPTY),
            since=self.horizons.to(state.since.dtype).expand_as(state.since).clone(),
            coasted=torch.zeros_like(state.coasted),
        )

    def description(self, columns: Sequence[str]) -> dict[str, Any]:
        """As `Estimator.description`, of the forecasts; `columns` are the ensemble's."""
        prior, costs = self.rule.log_prior.exp(), (-self.rule.log_prior).clamp(min=TINY)
        assert self.rule.memory is not None
        return {
            "members": [list(columns).index(name) for name in self.names],
            "slots": self.slots,
            "numbers": numbers_of(at.Number, self, scale=self.rule.scale, share=self.rule.share),
            "vectors": {
                "horizons": self.horizons.tolist(), "memory": self.rule.memory().tolist(),
                "prior": prior.tolist(), "costs": costs.tolist(),
            },
        }  # fmt: skip

    def monitor(self, state: ForecastState) -> dict[str, Tensor]:
        """Weights and half-widths by horizon, as `weight_MEMBER_at_10` and `halfwidth_at_10`."""
        values: dict[str, Tensor] = {}
        weights = self._weights(state)
        for k, h in enumerate(self.labels):
            split = weights[..., k, :].unbind(-1)
            values |= {f"weight_{name}_at_{h}": weight for name, weight in zip(self.names, split, strict=True)}
            values[f"halfwidth_at_{h}"] = self._halfwidths(state)[..., k]
        return values

    def _leaves(self, member: str, state: Any) -> dict[str, Tensor]:
        """The leaves of a member's state that its open-loop simulation needs, by dotted name."""
        leaves, names = dict(named_leaves(state)), self._frozen[member]
        return leaves if names is None else {name: leaves[name] for name in names}

    def _weights(self, state: ForecastState) -> Tensor:
        """The weights of each horizon, `(*batch, H, M)`: those of a shorter one where too few errors are known."""
        weights, known = state.rule.weights, state.errors >= FEW
        filled = [weights[..., 0, :]]
        for k in range(1, weights.shape[-2]):
            filled.append(torch.where(known[..., k, None], weights[..., k, :], filled[-1]))
        return torch.stack(filled, -2)

    def _halfwidths(self, state: ForecastState) -> Tensor:
        """q s, `(*batch, H)`, which do not know the manoeuvre; infinite where too few errors are known."""
        width = (state.quantile * state.error).clamp(min=at.NARROWEST)
        return torch.where(state.errors >= FEW, width, math.inf)
