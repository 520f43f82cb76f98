"""Robust learning around any estimator in torch: equations (1) and (2) of `state`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, check_broadcast
from usvlearn.core.protocol import Estimator, check_estimator, numbers_of, spec_of
from usvlearn.core.samples import Inputs, named_leaves, tree_map, where
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.wrappers.robust.state import FAMILY, RobustState


def clipped_moment(c: float) -> float:
    """β of (2): E min(z², c²) of a standard normal z."""
    tail = math.erfc(c / math.sqrt(2))
    return 1 - tail - c * math.sqrt(2 / math.pi) * math.exp(-c * c / 2) + c * c * tail


class Robust(Estimator):
    """Huber-clips the innovations of any estimator.

    Huber 1964; the escape and the gate are derived in `docs/theory/estimators.md`.

    Args:
        estimator: any.
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
        ConfigError: no estimator, or a number outside its range.

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
        self.estimator = check_estimator("estimator of Robust", estimator)
        self.threshold = check_positive("threshold", threshold, "of standard deviations")
        if not (isinstance(patience, int) and patience >= 1):
            raise ConfigError(f"patience: found {patience!r}, expected a whole number of samples, 1 or more")
        self.patience = patience
        self.inflation = Positive(inflation, "inflation", learnable=False)  # not every estimator has a covariance
        self.scale = Positive(scale, "scale")
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

    def predict(self, state: RobustState, inputs: Inputs) -> tuple[RobustState, Tensor]:
        inner, surge = self.estimator.predict(state.inner, inputs)
        return state._replace(inner=inner), surge

    @property
    def frozen(self) -> tuple[str, ...] | None:  # type: ignore[override]  # of the estimator within
        inner = self.estimator.frozen
        return None if inner is None else tuple(f"inner.{name}" for name in inner)

    def open_loop(self, state: RobustState) -> RobustState:
        return state._replace(inner=self.estimator.open_loop(state.inner))

    def free_step(self, state: RobustState, inputs: Inputs) -> tuple[RobustState, Tensor]:
        inner, surge = self.estimator.free_step(state.inner, inputs)
        return state._replace(inner=inner), surge

    def update(self, state: RobustState, inputs: Inputs, surge: Tensor) -> RobustState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: RobustState, inputs: Inputs, surge: Tensor) -> tuple[RobustState, Tensor]:
        predicted = self.estimator.predict(state.inner, inputs)[1]
        innovation = surge - predicted
        bound = self.threshold * state.variance.sqrt()
        beyond = innovation.abs() > bound
        escapes = beyond & (state.run >= self.patience)
        first = escapes & (state.run < self.patience + 1)
        clips = beyond & ~escapes
        within = torch.where(clips, innovation.clamp(-bound, bound), innovation)  # (1)
        inner = self.estimator.inflate_covariance(state.inner, torch.where(first, self.inflation(), 1.0))
        inner = self.estimator.update(inner, inputs, torch.where(clips, predicted + within, surge))
        seen = torch.minimum(innovation * innovation, bound * bound) / self.moment
        variance = torch.lerp(state.variance, seen, self.share).clamp(min=self.variance_min)  # (2)
        learned = RobustState(
            inner,
            variance,
            torch.where(beyond, state.run + 1, 0.0),
            state.clipped + clips,
            state.rejected,
            state.escaped + first,
        )
        refused = state._replace(rejected=state.rejected + 1)
        sane = finite(inner, surge.ndim) | ~finite(state.inner, surge.ndim)
        keep = sane & (innovation * innovation).isfinite()
        return tree_map(lambda new, old: where(keep, new, old), learned, refused), predicted

    def start(self, state: RobustState, surge: Tensor) -> RobustState:
        return state._replace(inner=self.estimator.start(state.inner, surge), run=torch.zeros_like(state.run))

    def inflate_covariance(self, state: RobustState, factor: Tensor) -> RobustState:
        return state._replace(inner=self.estimator.inflate_covariance(state.inner, factor))

    def description(self) -> dict[str, Any] | None:
        inner = spec_of(self.estimator)
        return inner and {"kind": "robust", "inner": inner, "numbers": numbers_of(FAMILY.numbers, self)}

    def monitor(self, state: RobustState) -> dict[str, Tensor]:
        counts = {"clipped": state.clipped, "rejected": state.rejected, "escaped": state.escaped}
        return {**self.estimator.monitor(state.inner), **counts, "scale": state.variance.sqrt()}


def finite(tree: Any, batch_dims: int) -> Tensor:
    """Whether all numbers of each batch element are finite, `(*batch,)` bool."""
    total: Tensor | float = 0.0
    for _, leaf in named_leaves(tree):
        if leaf.is_floating_point():  # a sum is finite where all its terms are, short of 1e308
            total = total + (leaf.flatten(batch_dims).sum(-1) if leaf.ndim > batch_dims else leaf)
    return torch.as_tensor(total).isfinite()
