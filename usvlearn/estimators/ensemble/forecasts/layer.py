"""Forecasts over several horizons in torch: equations (1) to (3) of `state`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from usvlearn.core.protocol import Estimator, spec_of
from usvlearn.core.samples import Inputs, named_leaves, rebuild, tree_map, where
from usvlearn.errors import ConfigError, check_not_negative, check_positive
from usvlearn.estimators.ensemble.combiners.layer import BOA, fill_inactive
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
            if name not in members or not isinstance(members[name], Estimator):
                known = ", ".join(key for key, each in members.items() if isinstance(each, Estimator))
                raise ConfigError(f"forecasts.members: found {name}, expected some of {known}, or forecasts: null")
        if not names or len(set(names)) < len(names):
            raise ConfigError(f"forecasts.members: found {', '.join(names) or 'none'}, expected each member once")
        self.names, self.coverage, self.surge_max, self.knows = tuple(names), coverage, surge_max, knows
        self.rule.bind(names)
        # A subclass may need other leaves than its class. `spec_of` reads hyperparameters, which waits for a device.
        self._frozen = {name: None if spec_of(members[name]) is None else members[name].frozen for name in names}

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

    def step(
        self,
        state: ForecastState,
        members: Mapping[str, Any],
        states: Mapping[str, Any],
        inputs: Inputs,
        surge: Tensor | None,
    ) -> ForecastState:
        """One step of all that is under way; learns from what became due, and opens an origin, if `surge` is given.

        Args:
            state: before the step.
            members: of the ensemble, by name.
            states: of the members after the step.
            inputs: of the step.
            surge: measured after it, m/s, `(*batch,)`; None where it was not.
        """
        dt, under_way = inputs.dt[..., None], state.elapsed >= 0
        moved = {name: self._free(members[name], states[name], state.frozen[name], inputs) for name in self.names}
        x = self._awake(torch.stack([predicted for _, predicted in moved.values()], -1))  # (*batch, slots, M)
        frozen = {name: _where(under_way, moved[name][0], state.frozen[name]) for name in self.names}
        before, after, half = state.elapsed[..., None], (state.elapsed + dt)[..., None], dt[..., None] / 2
        horizons = self.horizons.to(dt.dtype)
        due = under_way[..., None] & (before + half < horizons) & (horizons <= after + half)
        combined = (state.weights * fill_inactive(x[..., None, :], state.weights)).sum(-1)  # (1)
        wide = [x[..., None, :].expand(*combined.shape, -1), state.origin[..., None].expand_as(combined), combined]
        rows = torch.cat([wide[0], wide[1][..., None], wide[2][..., None]], -1)  # (*batch, slots, H, M + 2)
        predictions = torch.full_like(state.predictions, math.nan)
        halfwidths = torch.full_like(state.halfwidths, math.nan)
        widths, facts, known = state.widths, None, state.conditional
        if known:
            sides = (x[..., None].expand_as(state.elapsed) for x in (inputs.command_left, inputs.command_right))
            paths = where(under_way, conditional.extend_path(known.paths, *sides), known.paths)
            spread = _spread(state.weights, x[..., None, :], combined)
            far, group = (f(paths)[..., None].expand_as(spread) for f in (conditional.far_of, conditional.group_of))
            widths = conditional.halfwidth_held(known.held, widths, spread, far, group)
            facts, found = torch.stack([spread, far, group], -1), torch.full_like(known.due, math.nan)
        for slot in range(self.slots):  # two may be due at once where steps differ in length
            predictions = torch.where(due[..., slot, :, None], rows[..., slot, :, :], predictions)
            halfwidths = torch.where(due[..., slot, :], widths[..., slot, :], halfwidths)
            if facts is not None:
                found = torch.where(due[..., slot, :, None], facts[..., slot, :, :], found)
        if known:
            path = conditional.extend_path(known.path, inputs.command_left, inputs.command_right)
            known = known._replace(path=path, paths=paths, due=found)
        elapsed = torch.where(under_way, after[..., 0], at.EMPTY)
        ends = horizons[state.reach.clamp(0, len(horizons) - 1).long()]
        elapsed = torch.where(elapsed + half[..., 0] >= ends, at.EMPTY, elapsed)
        state = state._replace(
            frozen=frozen, elapsed=elapsed, predictions=predictions, halfwidths=halfwidths,
            since=state.since + dt, conditional=known,
        )  # fmt: skip
        if surge is None:
            return state._replace(coasted=state.coasted + inputs.dt)
        return self._opened(self._learned(state, surge, inputs.dt), members, states, inputs, surge)

    def weights_after(self, state: ForecastState, time: Tensor) -> Tensor:
        """The weights of a forecast over `time`, s, `(*batch,)`, between those of the horizons: `(*batch, M)`."""
        place = self._place(time)[..., None]
        return (place * self._weights(state)).sum(-2)

    def halfwidth_after(self, state: ForecastState, time: Tensor, x: Tensor, surge: Tensor) -> Tensor:
        """Its half-width, m/s; infinite beyond the longest horizon, and where too few errors are known.

        Args:
            state: whose `path` has seen the commands until then, where intervals know the manoeuvre.
            time: s.
            x: the members' predictions, m/s, `(*batch, M)`.
            surge: the forecast, m/s.
        """
        place, widths = self._place(time), self._halfwidths(state)
        if known := state.conditional:
            spread = _spread(self.weights_after(state, time), self._awake(x), surge)
            facts = (x[..., None] for x in (spread, conditional.far_of(known.path), conditional.group_of(known.path)))
            widths = conditional.halfwidth_held(conditional.hold(known.learned, state.errors), widths, *facts)
        width = torch.where(place > 0, place * widths, 0.0).sum(-1)
        return torch.where(time > self.horizons[-1] * at.BEYOND, math.inf, width)

    def combine(self, state: ForecastState, predictions: Tensor, time: Tensor) -> Tensor:
        """The forecast over `time`, s, of members' predictions, m/s, `(*batch, M)`."""
        weights = self.weights_after(state, time)
        return (weights * fill_inactive(self._awake(predictions), weights)).sum(-1)

    def plan(
        self, state: ForecastState, members: Mapping[str, Any], states: Mapping[str, Any], inputs: Inputs
    ) -> tuple[Tensor, Tensor]:
        """A forecast from now on: predictions and half-widths, m/s, `(time, *batch)` each.

        Its time counts from the last measured speed.

        Args:
            state: as after the last sample.
            members: of the ensemble, by name.
            states: of the members, by name.
            inputs: of the plan's steps, `(time, *batch)`.
        """
        states, found = {name: members[name].open_loop(states[name]) for name in self.names}, []
        elapsed = state.coasted
        for k in range(len(inputs.dt)):
            now = Inputs(*(x[k] for x in inputs))
            stepped = {name: members[name].free_step(states[name], now) for name in self.names}
            states = {name: new for name, (new, _) in stepped.items()}
            elapsed = elapsed + now.dt
            x = torch.stack([predicted for _, predicted in stepped.values()], -1)
            if known := state.conditional:
                path = conditional.extend_path(known.path, now.command_left, now.command_right)
                state = state._replace(conditional=known._replace(path=path))
            surge = self.combine(state, x, elapsed)
            found.append((surge, self.halfwidth_after(state, elapsed, x, surge)))
        surges, widths = (torch.stack(column) for column in zip(*found, strict=True))
        return surges, widths

    def description(self, columns: Sequence[str]) -> dict[str, Any]:
        """As `Estimator.description`, of the forecasts; `columns` are the ensemble's."""
        prior, costs = self.rule.log_prior.exp(), (-self.rule.log_prior).clamp(min=TINY)
        assert self.rule.memory is not None
        return {
            "members": [list(columns).index(name) for name in self.names],
            "slots": self.slots,
            "numbers": {
                "overlap": self.overlap, "coverage": self.coverage, "tiny": TINY, "scale": self.rule.scale,
                "share": self.rule.share,
            },
            "vectors": {
                "horizons": self.horizons.tolist(), "memory": self.rule.memory().tolist(),
                "prior": prior.tolist(), "costs": costs.tolist(),
            },
        }  # fmt: skip

    def monitor(self, state: ForecastState) -> dict[str, Tensor]:
        """Weights and half-widths by horizon, as `weight_MEMBER_at_10` and `halfwidth_at_10`."""
        found: dict[str, Tensor] = {}
        weights = self._weights(state)
        for k, h in enumerate(self.labels):
            own = weights[..., k, :].unbind(-1)
            found |= {f"weight_{name}_at_{h}": weight for name, weight in zip(self.names, own, strict=True)}
            found[f"halfwidth_at_{h}"] = self._halfwidths(state)[..., k]
        return found

    def _leaves(self, member: str, state: Any) -> dict[str, Tensor]:
        """The leaves of a member's state that its open-loop simulation needs, by dotted name."""
        leaves, names = dict(named_leaves(state)), self._frozen[member]
        return leaves if names is None else {name: leaves[name] for name in names}

    def _free(
        self, member: Estimator, state: Any, frozen: Mapping[str, Tensor], inputs: Inputs
    ) -> tuple[dict[str, Tensor], Tensor]:
        """One step of a member's copies, leaves `(*batch, slots, …)`; and what they predict, `(*batch, slots)`.

        The slots come first for the member, because its hyperparameters broadcast against the batch.
        """
        axis = inputs.dt.ndim
        own = {name: leaf.movedim(axis, 0) for name, leaf in frozen.items()}
        every = {name: own.get(name, leaf.expand(self.slots, *leaf.shape)) for name, leaf in named_leaves(state)}
        wide = tree_map(lambda x: x.expand(self.slots, *x.shape), inputs)
        stepped, predicted = member.free_step(rebuild(state, every), wide)
        after = dict(named_leaves(stepped))
        return {name: after[name].movedim(0, axis) for name in frozen}, predicted.movedim(0, axis)

    def _awake(self, x: Tensor) -> Tensor:
        return torch.where(x.abs() < self.surge_max, x, math.nan)

    def _learned(self, state: ForecastState, surge: Tensor, dt: Tensor) -> ForecastState:
        """What became due is compared with the measured speed."""
        x, y = state.predictions[..., :-2], surge[..., None].expand_as(state.halfwidths)
        combined = state.predictions[..., -1]
        known = combined.isfinite()
        unit = (self.horizons.to(x.dtype) / at.STEP).sqrt()
        target = torch.where(known, y, 0.0) / unit
        safe = torch.where(known[..., None], x, 0.0) / unit[:, None]
        spacing = torch.maximum(self.horizons.to(x.dtype) / self.overlap, dt[..., None])
        rule = self.rule.learn(state.rule, safe, target, spacing)
        e = torch.where(known, combined - y, 0.0).abs()
        k = state.errors + known
        error = state.error + (1 / k.clamp(min=1)).clamp(min=at.SHARE) * (e - state.error)  # (2)
        miss = (e > (state.quantile * state.error).clamp(min=at.NARROWEST)).to(e.dtype)
        quantile = state.quantile * ((miss - (1 - self.coverage)) / (at.DELAY + self.overlap)).exp()  # (3)
        before, facts = (state.quantile * state.error).clamp(min=at.NARROWEST), state.conditional
        if facts:
            spread, far, group = torch.where(known[..., None], facts.due, 0.0).unbind(-1)
            new = conditional.learn_error(
                facts.learned, k, e, before, spread, far, group, self.overlap, 1 - self.coverage
            )
            facts = facts._replace(learned=tree_map(lambda new, old: where(known, new, old), new, facts.learned))
        return state._replace(
            rule=tree_map(lambda new, old: where(known, new, old), rule, state.rule),
            error=torch.where(known, error, state.error),
            quantile=torch.where(known, quantile.clamp(at.LEAST, at.MOST), state.quantile),
            errors=k,
            conditional=facts,
        )

    def _opened(
        self, state: ForecastState, members: Mapping[str, Any], states: Mapping[str, Any], inputs: Inputs, surge: Tensor
    ) -> ForecastState:
        """An origin, where a slot is empty."""
        empty = state.elapsed < 0
        opens = empty & (empty.cumsum(-1) == 1)
        horizons = self.horizons.to(state.since.dtype)
        ready = state.since + inputs.dt[..., None] / 2 >= horizons / self.overlap
        places = torch.arange(len(horizons), device=horizons.device)
        reach = torch.where(ready, places, 0).amax(-1, keepdim=True)
        begun = opens.any(-1, keepdim=True) & (places <= reach)
        now = {name: self._leaves(name, members[name].open_loop(states[name])) for name in self.names}
        frozen = {
            name: {key: where(opens, now[name][key].unsqueeze(opens.ndim - 1), leaf) for key, leaf in leaves.items()}
            for name, leaves in state.frozen.items()
        }
        weights, widths = self._weights(state)[..., None, :, :], self._halfwidths(state)[..., None, :]
        if facts := state.conditional:
            facts = conditional.opened(facts, opens, inputs.command_left, inputs.command_right, state.errors)
        return state._replace(
            frozen=frozen,
            elapsed=torch.where(opens, 0.0, state.elapsed),
            reach=torch.where(opens, reach.to(state.reach.dtype), state.reach),
            origin=torch.where(opens, surge[..., None], state.origin),
            weights=torch.where(opens[..., None, None], weights, state.weights),
            widths=torch.where(opens[..., None], widths, state.widths),
            since=torch.where(begun, 0.0, state.since),
            coasted=torch.zeros_like(state.coasted),
            conditional=facts,
        )

    def _weights(self, state: ForecastState) -> Tensor:
        """The weights of each horizon, `(*batch, H, M)`: those of a shorter one where too few errors are known."""
        own, known = state.rule.weights, state.errors >= FEW
        found = [own[..., 0, :]]
        for k in range(1, own.shape[-2]):
            found.append(torch.where(known[..., k, None], own[..., k, :], found[-1]))
        return torch.stack(found, -2)

    def _halfwidths(self, state: ForecastState) -> Tensor:
        """q s, `(*batch, H)`, which do not know the manoeuvre; infinite where too few errors are known."""
        width = (state.quantile * state.error).clamp(min=at.NARROWEST)
        return torch.where(state.errors >= FEW, width, math.inf)

    def _place(self, time: Tensor) -> Tensor:
        """The share of each horizon in a time, s, `(*batch, H)`."""
        h, t = self.horizons.to(time.dtype), time[..., None]
        if len(h) == 1:
            return torch.ones_like(t)
        rise = ((t - h[:-1]) / (h[1:] - h[:-1])).clamp(0, 1)  # of the horizon above
        one = torch.ones_like(t)
        return torch.cat([one, rise], -1) - torch.cat([rise, 0 * one], -1)


def _where(mask: Tensor, new: Mapping[str, Tensor], old: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: where(mask, new[name], leaf) for name, leaf in old.items()}


def _spread(weights: Tensor, x: Tensor, combined: Tensor) -> Tensor:
    """The members' spread about a forecast; an inactive one counts as the forecast."""
    squares = weights * (x - combined[..., None]) ** 2
    return torch.where(x.isnan() | combined.isnan()[..., None], 0.0, squares).detach().sum(-1).sqrt()
