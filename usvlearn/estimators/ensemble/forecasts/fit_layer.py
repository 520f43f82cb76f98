"""Forecasts with a batch fit as a member, for runs in compiled code alone: torch has no step of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from usvlearn.errors import ConfigError
from usvlearn.estimators.ensemble.forecasts import state as at
from usvlearn.estimators.ensemble.forecasts.layer import ForecastSettings
from usvlearn.estimators.ensemble.forecasts.state import ForecastState
from usvlearn.estimators.joint.layer import JointEKF


class FittedForecasts(ForecastSettings):
    """`ForecastSettings` with the table of a fit (`usvlearn.model.fit.hand_over.table_of`), `(*boats, TABLE)`."""

    def __init__(self, fit: Any = (0.0,) * at.TABLE, **settings: Any):
        super().__init__(**settings)
        self.fit = np.asarray(fit, float)
        if self.fit.shape[-1:] != (at.TABLE,) or not np.isfinite(self.fit).all():
            raise ConfigError(f"forecasts.fit: found {self.fit.size} numbers, expected {at.TABLE}, all finite")

    def bind(self, names: Sequence[str], members: Mapping[str, Any], *given: Any) -> None:
        super().bind(names, members, *given)
        joints = [name for name in names if isinstance(members[name], JointEKF)]
        if not joints or at.FIT in members:
            raise ConfigError(
                "forecasts.fit: found a fit, expected a joint EKF that is weighed, and no member named fit"
            )
        self.copied, self.prior, self.names = joints[0], self.rule.log_prior.exp().tolist(), (*names, at.FIT)
        self.rule.bind(self.names)
        self.rule.log_prior.copy_(torch.tensor(at.with_fit(self.prior)["prior"]).log())
        self._frozen[at.FIT] = self._frozen[self.copied]

    def init(self, batch: Sequence[int], members: Mapping[str, Any], states: Mapping[str, Any]) -> ForecastState:
        return super().init(batch, members, {**states, at.FIT: states[self.copied]})

    def description(self, columns: Sequence[str]) -> dict[str, Any]:
        described = super().description([*columns, at.FIT])
        fit = {"column": list(columns).index(self.copied), "table": self.fit.tolist()}
        vectors = described["vectors"] | at.with_fit(self.prior)
        return {**described, "members": described["members"][:-1], "vectors": vectors, at.FIT: fit}
