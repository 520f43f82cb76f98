"""One estimator with several settings, as a member of an ensemble.

The derivation is in `docs/theory/estimators.md#memory-and-banks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor, nn

from usvlearn.core.protocol import Estimator, check_estimator, spec_of
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError


class Bank(nn.Module):
    """One estimator with several settings as batch elements: a member of an ensemble with one column for each setting.

    Its methods are those of an `Estimator`; predictions, and the leaves of the state, have the settings as their last
    batch axis. See `docs/theory/estimators.md`.

    Args:
        estimator: some hyperparameters of which have the shape `(settings,)`; what differs by boat is `(boats, 1)`.
        labels: of the settings, in that order: the columns are NAME_LABEL.

    Raises:
        ConfigError: no estimator, or labels that are not a list of names.

    >>> from usvlearn import AID, Ensemble
    >>> Ensemble({"aid": Bank(AID(gain=[0.3, 1.0, 3.0]), ["slow", "middle", "fast"])}).columns
    ('aid_slow', 'aid_middle', 'aid_fast')
    """

    def __init__(self, estimator: Estimator, labels: Sequence[str]):
        super().__init__()
        self.estimator = check_estimator("estimator of Bank", estimator)
        if isinstance(labels, str) or not labels:
            raise ConfigError(f"labels: found {labels!r}, expected a list of names, one for each setting")
        self.labels = tuple(labels)

    def init(self, batch: Sequence[int]) -> Any:
        return self.estimator.init((*batch, len(self.labels)))

    def predict(self, state: Any, inputs: Inputs) -> tuple[Any, Tensor]:
        """As `Estimator.predict`; the predictions are `(*batch, settings)`."""
        return self.estimator.predict(state, Inputs(*map(self._wide, inputs)))

    def learn(self, state: Any, inputs: Inputs, surge: Tensor) -> tuple[Any, Tensor]:
        return self.estimator.learn(state, Inputs(*map(self._wide, inputs)), self._wide(surge))

    def start(self, state: Any, surge: Tensor) -> Any:
        return self.estimator.start(state, self._wide(surge))

    def inflate_covariance(self, state: Any, factor: Tensor) -> Any:
        return self.estimator.inflate_covariance(state, self._wide(factor))

    def description(self) -> dict[str, Any] | None:
        inner = spec_of(self.estimator)
        return inner and {"kind": "bank", "inner": inner, "count": len(self.labels)}

    def monitor(self, state: Any) -> dict[str, Tensor]:
        return self.estimator.monitor(state)

    def _wide(self, x: Tensor) -> Tensor:
        return x[..., None].expand(*x.shape, len(self.labels))
