"""An ensemble of estimators in torch: members, combiners, intervals, monitors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, cast

import torch
from torch import Tensor, nn

from usvlearn.core.forecasts import NONE
from usvlearn.core.protocol import Estimator, KernelEstimator, describe, has_kernel, kernel_step, numbers_of, spec_of
from usvlearn.core.samples import Inputs, named_leaves
from usvlearn.errors import ConfigError, check_positive, did_you_mean, under
from usvlearn.estimators.ensemble.accommodation import layer as accommodation
from usvlearn.estimators.ensemble.combiners.layer import Average, Combiner
from usvlearn.estimators.ensemble.conformal.layer import conformal_start, conformal_step, published
from usvlearn.estimators.ensemble.conformal.state import Number as Interval
from usvlearn.estimators.ensemble.forecasts.layer import ForecastSettings
from usvlearn.estimators.ensemble.monitors import layer as monitors
from usvlearn.estimators.ensemble.state import EnsembleState, Number
from usvlearn.estimators.external.state import FAMILY as EXTERNAL


class Ensemble(Estimator):
    """Estimators side by side; predicts by one of its combiners and publishes every prediction in its state.

    A member whose prediction is not finite, or at `surge_max` and beyond, is inactive: the combiners leave it out.
    Gradients pass through members whose steps torch makes, and through the combiners.

    The combiners are from Wintenberger 2017 and the paper, section V; the intervals from Gibbs and Candès 2021. All are
    derived in `docs/theory/ensemble.md`.

    Args:
        members: estimators by name.
        combiners: combiners by name, `{"average": Average()}` by default.
        output: the combiner whose prediction is the ensemble's own; the last by default.
        coverage: share of the measurements that the intervals are to cover, 0 … 1.
        surge_max: physical limit of a speed, m/s; a measured one at or beyond it counts as missing.
        watched: whether whiteness and the thrusters are watched (`monitors`), and filters that make trials get what is
            found (`accommodation`).
        forecasts: seconds ahead (`forecasts`); None: none are made.
        conditional: whether half-widths know the manoeuvre (`conditional`), of one step and of forecasts.

    Attributes:
        columns: the names of the members.
        names: those and the combiners'.
        averaged: name of the first averaged joint EKF (`estimate_every`), or None.
        external: names of the members without a kernel: each runs alone, and the kernels read its predictions.
        accommodated: names of the members that are given what the monitor of the thrusters finds.
        aided: whether kernels make a part of each step: intervals by manoeuvre, monitors or forecasts.

    Raises:
        ConfigError: no members, a name that is used twice, a combiner of members that do not exist, or one of another
            class than those of this package together with `watched`, `conditional` or `forecasts`.

    >>> from usvlearn import AID, Persistence
    >>> ensemble = Ensemble({"aid": AID(), "persistence": Persistence()})
    >>> ensemble.names
    ('aid', 'persistence', 'average')
    """

    members: Mapping[str, Estimator]
    combiners: Mapping[str, Combiner]

    def __init__(
        self,
        members: Mapping[str, Estimator],
        combiners: Mapping[str, Combiner] | None = None,
        output: str | None = None,
        coverage: float = 0.9,
        surge_max: float = 10.0,
        watched: bool = True,
        forecasts: ForecastSettings | None = None,
        conditional: bool = True,
    ):
        super().__init__()
        rules: Mapping[str, Combiner] = {"average": Average()} if combiners is None else dict(combiners)
        if not members or not rules:
            raise ConfigError(f"ensemble: found {len(members)} members, expected at least one, and one combiner")
        for name, member in members.items():
            if not isinstance(member, Estimator):
                raise ConfigError(f"estimators.{name}: found {member!r}, expected an estimator")
            if not name.isidentifier() or hasattr(nn.ModuleDict, name):
                raise ConfigError(
                    f"estimators: found the name {name!r}, expected a plain name of letters, digits and _"
                )
        self.columns = tuple(members)
        self.names = (*self.columns, *rules)
        if twice := sorted({name for name in self.names if self.names.count(name) > 1}):
            raise ConfigError(f"ensemble: {', '.join(twice)} names two members, or a member and a combiner")
        self.output = list(rules)[-1] if output is None else output
        if self.output not in rules:
            raise ConfigError(f"output: found {output!r}, expected one of {', '.join(rules)}")
        self.watched, self.coverage, self.conditional = watched, coverage, bool(conditional)
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.surge_limit = min(self.surge_limit, self.surge_max)
        if not 0 < coverage < 1:
            raise ConfigError(f"coverage: found {coverage!r}, expected a number between 0 and 1, both excluded")
        reads = (name for name, member in members.items() if math.isfinite(getattr(member, "estimate_every", math.inf)))
        self.averaged = next(reads, None)
        self.external = tuple(name for name, member in members.items() if not has_kernel(member))
        self.accommodated = accommodation.accommodated(members) if watched else ()
        # A `ModuleDict` behaves as a mapping of what is in it, but its type forgets of what.
        self.members = cast("Mapping[str, Estimator]", nn.ModuleDict(members))
        self.combiners = cast("Mapping[str, Combiner]", nn.ModuleDict(rules))
        self._places: dict[str, list[int]] = {}  # combiner -> places of its members
        for name, combiner in rules.items():
            chosen = self._named(combiner.members, name)
            self._places[name] = [self.columns.index(column) for column in chosen]
            with under(f"combiners.{name}"):
                combiner.bind(chosen)
        self.forecasts = forecasts
        self.aided = watched or self.conditional or forecasts is not None  # by kernels, in each step
        if self.aided and (names := [name for name, rule in rules.items() if spec_of(rule) is None]):
            raise ConfigError(
                f"combiners.{names[0]}: found {type(rules[names[0]]).__name__}, which has no kernel, expected "
                "watched: false, conditional: false and forecasts: null beside it"
            )
        if forecasts is not None:
            names = [name for name in self.weighed if has_kernel(members[name])] or self.weighed
            chosen = names if forecasts.members is None else forecasts.members
            forecasts.bind(chosen, members, coverage, self.surge_max, self.conditional)

    def _named(self, members: Sequence[str] | None, combiner: str) -> list[str]:
        """The members that a combiner means."""
        chosen = list(self.columns if members is None else members)
        if not chosen or (unknown := sorted(set(chosen) - set(self.columns))):
            hint = chosen and (did_you_mean(unknown[0], self.columns) or f": correct the members of {combiner}")
            raise ConfigError(
                f"combiners.{combiner}.members: found {', '.join(chosen) or 'none'}, "
                f"expected some of {', '.join(self.columns)}"
                + (f" (unknown: {', '.join(unknown)}){hint}" if chosen else "")
            )
        if len(set(chosen)) < len(chosen):
            raise ConfigError(f"combiners.{combiner}.members: found {', '.join(chosen)}, expected each member once")
        return chosen

    @property
    def weighed(self) -> list[str]:
        """The names of the members' predictions that the output is made of."""
        return [self.columns[k] for k in self._places[self.output]]

    def init(self, batch: Sequence[int] = ()) -> EnsembleState:
        batch = tuple(batch)
        members = {}
        for name, member in self.members.items():
            with under(f"estimators.{name}"):
                members[name] = member.init(batch)
        like = next(leaf for _, leaf in named_leaves(members) if leaf.is_floating_point())
        combiners = {}
        for name, combiner in self.combiners.items():
            with under(f"combiners.{name}"):
                combiners[name] = combiner.init(batch, like)
        conformal = conformal_start(batch, len(self.names), like, self.conditional)
        watched = monitors.init(batch, len(self.names), like) if self.watched else {}
        width = torch.full_like(conformal.halfwidth, math.inf)
        forecasting = {} if self.forecasts is None else self.forecasts.init(batch, self.members, members)
        given = accommodation.init(batch, like) if self.accommodated else {}
        return EnsembleState(members, combiners, conformal, torch.zeros_like(width), width, watched, forecasting, given)

    def predict(self, state: EnsembleState, inputs: Inputs) -> tuple[EnsembleState, Tensor]:
        return self._stepped(state, inputs, None)

    def update(self, state: EnsembleState, inputs: Inputs, surge: Tensor) -> EnsembleState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: EnsembleState, inputs: Inputs, surge: Tensor) -> tuple[EnsembleState, Tensor]:
        return self._stepped(state, inputs, surge)

    def _stepped(self, state: EnsembleState, inputs: Inputs, surge: Tensor | None) -> tuple[EnsembleState, Tensor]:
        """One step on; nothing is learned where `surge` is None.

        Members and combiners step by torch, so that gradients pass; the kernels make the rest.
        """
        members, surges = dict(state.members), {}
        for name, member in self.members.items():
            if self.aided and isinstance(member, KernelEstimator):
                member.check_step(members[name], inputs, inputs.dt if surge is None else surge)
            elif surge is None:
                members[name], surges[name] = member.predict(members[name], inputs)
            else:
                members[name], surges[name] = member.learn(members[name], inputs, surge)
        new = state
        if self.aided:
            target = torch.full_like(inputs.dt, math.nan) if surge is None else surge
            description, given = self.description(), [surges[name] for name in self.external]
            assert description is not None, "expected combiners with kernels, as `__init__` does"
            new, _ = kernel_step(description, state, inputs, target, True, surge is not None, given)
            members = {name: members[name] if name in surges else member for name, member in new.members.items()}
        columns = new.predictions.unbind(-1)
        single = torch.stack([surges.get(name, columns[k]) for k, name in enumerate(self.columns)], -1)
        seen, rules, before = self._seen(single), self.combiners.items(), state.combiners
        together = [rule.combine(before[name], seen[name]) for name, rule in rules]
        predictions = torch.cat([single, torch.stack(together, -1)], -1)
        if self.forecasts is not None:  # after steps without measured speed the output is a forecast
            predictions = torch.where(state.forecasts.coasted[..., None] > 0, new.predictions, predictions)
        if surge is not None:
            learned = {name: rule.learn(before[name], seen[name], surge, inputs.dt) for name, rule in rules}
            new = new._replace(combiners=learned)
        if not self.aided:
            new = new._replace(halfwidths=published(state.conformal))
            if surge is not None:
                innovations = surge[..., None] - predictions
                new = new._replace(conformal=conformal_step(state.conformal, innovations, self.coverage))
        return new._replace(members=members, predictions=predictions), predictions[..., self.names.index(self.output)]

    def start(self, state: EnsembleState, surge: Tensor) -> EnsembleState:
        members = {name: member.start(state.members[name], surge) for name, member in self.members.items()}
        forecasting = state.forecasts if self.forecasts is None else self.forecasts.start(state.forecasts)
        return state._replace(members=members, forecasts=forecasting)

    def forecast(self, state: EnsembleState, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """Predictions and half-widths of a plan, given its inputs.

        Args:
            state: after the last sample, leaves `(*batch, …)`.
            inputs: of the plan's steps, leaves `(time, *batch)`.

        Returns:
            Predicted speeds and the half-widths of their intervals, m/s, `(time, *batch)` each.

        Raises:
            ConfigError: the ensemble makes no forecasts.

        >>> from usvlearn import AID, ForecastSettings
        >>> ensemble = Ensemble({"aid": AID()}, forecasts=ForecastSettings())
        >>> one = torch.ones(75, dtype=torch.float64)
        >>> surge, halfwidth = ensemble.forecast(ensemble.init(), Inputs(one, one, 0 * one, 0 * one, 0.4 * one))
        >>> surge.shape, float(halfwidth[0])  # no interval before the first measurements
        (torch.Size([75]), inf)
        """
        if self.forecasts is None:
            raise ConfigError(NONE)
        rollouts = import_module("usvlearn.engine.rollouts")  # of a layer above this one
        return rollouts.kernel_forecast(self.description(), state, inputs)

    def description(self) -> dict[str, Any] | None:
        columns = {name: describe(EXTERNAL, self, column=k) for k, name in enumerate(self.external)}
        members = {name: columns.get(name) or spec_of(member) for name, member in self.members.items()}
        rules = {
            name: (described := spec_of(rule)) and {**described, "columns": self._places[name]}
            for name, rule in self.combiners.items()
        }
        if None in rules.values():
            return None
        return {
            "kind": "ensemble", "members": members, "output": self.output, "columns": list(self.columns),
            "rules": rules, "numbers": numbers_of(Number, self), "conformal": numbers_of(Interval, self),
            "monitors": monitors.description() if self.watched else None,
            **({"conditional": 1} if self.conditional else {}),
            **({"accommodation": self._accommodation()} if self.accommodated else {}),
            **({} if self.forecasts is None else {"forecasts": self.forecasts.description(self.columns)}),
        }  # fmt: skip

    def _accommodation(self) -> dict[str, Any]:
        """Columns of the filters that get what the monitor finds, and the numbers of this part."""
        columns = [self.columns.index(name) for name in self.accommodated]
        return {"members": columns, "numbers": accommodation.description()}

    def monitor(self, state: EnsembleState) -> dict[str, Tensor]:
        """The members' and combiners' numbers, as `name/number`; whiteness and thrusters as `monitors/number`."""
        shown: dict[str, Tensor] = {}
        for name, member in self.members.items():
            for key, value in member.monitor(state.members[name]).items():
                shown[f"{name}/{key}"] = value
        for name, combiner in self.combiners.items():
            shown |= {f"{name}/{key}": value for key, value in combiner.monitor(state.combiners[name]).items()}
        if self.watched:
            report = monitors.monitor_report(state.monitors, self.names)
            shown |= {f"monitors/{key}": value for key, value in report.items()}
        if self.forecasts is not None:
            report = self.forecasts.monitor(state.forecasts)
            shown |= {f"forecasts/{key}": value for key, value in report.items()}
        return shown

    def _seen(self, predictions: Tensor) -> dict[str, Tensor]:
        """Of each combiner what its members predict, m/s, `(*batch, its members)`, NaN where they are inactive."""
        active = torch.where(predictions.abs() < self.surge_max, predictions, torch.nan)
        every, columns = list(range(len(self.columns))), active.unbind(-1)
        return {  # no index that is a list: it would be copied to the device at every step
            name: active if places == every else torch.stack([columns[k] for k in places], -1)
            for name, places in self._places.items()
        }
