"""Robust learning around an estimator: its arguments, its first state, and its diagnostics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, check_broadcast
from usvlearn.core.protocol import Estimator, KernelEstimator, check_estimator, numbers_of, spec_of
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.wrappers.robust.state import FAMILY, RobustState


def clipped_moment(c: float) -> float:
    """β of (2): E min(z², c²) of a standard normal z."""
    tail = math.erfc(c / math.sqrt(2))
    return 1 - tail - c * math.sqrt(2 / math.pi) * math.exp(-c * c / 2) + c * c * tail


class Robust(KernelEstimator):
    """Huber-clips the innovations of an estimator.

    Huber 1964; the escape and the gate are derived in `docs/theory/estimators.md`.

    Args:
        estimator: one of this package, not an ensemble; no gradient reaches its hyperparameters any more.
        threshold: c, a number of standard deviations. 4 clips gross outliers only, and not the errors of an imperfect
            model. Huber's 1.345 is for regressions: an estimator that departs from the last speed would replace a sixth
            of all samples by its own predictions (`docs/benchmarks/stress.md`).
        patience: number of clipped samples in a row after which the next is accepted. 1 follows a boat's steps sooner;
            but with 2 % of outliers, two in a row then sometimes spoil the parameters.
        inflation: factor of the estimator's covariance where a change is accepted, no unit, 1 or more; broadcasts
            against the batch.
        scale: s at the start, m/s; broadcasts against the batch.
        memory: 1/b, the number of samples over which the scale is taken.
        scale_min: least scale, m/s, so that a log without noise is not all outliers.

    Raises:
        ConfigError: no estimator, one without a kernel, or a number outside its range.

    >>> from usvlearn import AID
    >>> robust = Robust(AID(mass=28.0))
    >>> sorted(robust.monitor(robust.init()))[:3]
    ['clipped', 'drag_cross', 'drag_linear']
    """

    def __init__(
        self,
        estimator: Estimator,
        threshold: float = 4.0,
        patience: int = 2,
        inflation: Hyper = 20.0,
        scale: Hyper = 0.2,
        memory: float = 200.0,
        scale_min: float = 1e-3,
    ):
        super().__init__()
        self.estimator = check_estimator("estimator of Robust", estimator).requires_grad_(False)
        if (spec_of(estimator) or {"kind": "robust"})["kind"] in ("robust", "ensemble"):
            raise ConfigError(
                f"estimator of Robust: found {type(estimator).__name__}, expected one with a kernel, and no "
                "Robust or Ensemble: learn without Robust"
            )
        self.threshold = check_positive("threshold", threshold, "of standard deviations")
        if not (isinstance(patience, int) and patience >= 1):
            raise ConfigError(f"patience: found {patience!r}, expected a whole number of samples, 1 or more")
        self.patience = patience
        self.inflation = Positive(inflation, "inflation", learnable=False)  # not every estimator has a covariance
        self.scale = Positive(scale, "scale", learnable=False)
        if not bool((self.inflation() >= 1 - 1e-9).all()):
            raise ConfigError(f"inflation: found {inflation}, expected 1 or more")
        self.share = 1 / check_positive("memory", memory, "of samples, 1 or more")
        if self.share > 1:
            raise ConfigError(f"memory: found {memory}, expected a number of samples, 1 or more")
        self.variance_min = check_positive("scale_min", scale_min, "of m/s") ** 2
        self.moment = clipped_moment(self.threshold)

    def init(self, batch: Sequence[int] = ()) -> RobustState:
        check_broadcast(self, tuple(batch))
        inner = self.estimator.init(batch)
        zero = self.scale.log.new_zeros(tuple(batch))
        return RobustState(inner, (self.scale() ** 2).expand(tuple(batch)).clone(), zero, zero, zero, zero)

    @property
    def frozen(self) -> tuple[str, ...] | None:  # type: ignore[override]  # of the estimator within
        inner = self.estimator.frozen
        return None if inner is None else tuple(f"inner.{name}" for name in inner)

    def description(self) -> dict[str, Any] | None:
        inner = spec_of(self.estimator)
        return inner and {"kind": "robust", "inner": inner, "numbers": numbers_of(FAMILY.numbers, self)}

    def monitor(self, state: RobustState) -> dict[str, Tensor]:
        counts = {"clipped": state.clipped, "rejected": state.rejected, "escaped": state.escaped}
        return {**self.estimator.monitor(state.inner), **counts, "scale": state.variance.sqrt()}
