"""Cross-validation: saved checkpoints, simulated free on runs that they were not saved in (paper, section VI-B).

The definitions are in `docs/theory/ensemble.md#scores`. Each pair of a checkpoint and a run is an element of one batch.
A simulation uses the inputs, and the speed at which each segment starts.

A combiner that weighs the members has two rows in the tables: with the saved weights, and as NAME+, with weights that
continue to learn along the run, each prediction before its measurement. The paper's weighted ensemble was evaluated in
the second way. NAME+ is no open-loop simulation, since its weights use the measured speed.

A simulation *diverges* if it leaves ± surge_max of the ensemble, or is not finite. It is counted. While it is beyond
the limit, its error is that of the limit, so that means are finite and no simulation is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.samples import Inputs, Sample, masks, named_leaves, tree_map
from usvlearn.engine.backend import array_of, arrays_of, choose
from usvlearn.errors import ConfigError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.season import Season

ELEMENTS = 2048  # of one batch; about what fits into a processor's cache


class FreeErrors(NamedTuple):
    """Errors of free simulations; arrays are `(checkpoints, runs, methods)` unless stated otherwise."""

    methods: tuple[str, ...]
    mae: np.ndarray  # m/s; NaN where a run has no measured step
    mse: np.ndarray  # m²/s²
    diverged: np.ndarray  # bool
    steps: np.ndarray  # (runs,) measured steps

    def pooled(self, errors: np.ndarray, some: np.ndarray | None = None) -> np.ndarray:
        """`mae` or `mse` of each checkpoint over its runs, with equal weight per step, `(checkpoints, methods)`."""
        weight = np.broadcast_to(self.steps, errors.shape[:2]) * (1.0 if some is None else some)
        with np.errstate(invalid="ignore"):
            return (weight[..., None] * np.nan_to_num(errors)).sum(1) / weight.sum(1)[:, None]

    def unseen(self, season: Season) -> dict[str, float | None]:
        """MAE of the runs of a boat, each with the newest checkpoint that has not learned from it, m/s, by method."""
        some = np.zeros(self.mae.shape[:2], bool)
        for run in np.flatnonzero(self.steps > 0).tolist():
            place, learned = season.checkpoint_before(run)
            some[place, run] = not learned
        if not some.any():
            return dict.fromkeys(self.methods)
        weight = (self.steps * some)[..., None]
        total = (weight * np.nan_to_num(self.mae)).sum((0, 1)) / weight.sum()
        return dict(zip(self.methods, total.tolist(), strict=True))


def methods(ensemble: Ensemble) -> tuple[str, ...]:
    """The ensemble's names, and NAME+ for each combiner whose weights can continue to learn."""
    return (*ensemble.names, *(f"{name}+" for name in _learning(ensemble)))


def _learning(ensemble: Ensemble) -> list[str]:
    like = next(chain(ensemble.parameters(), ensemble.buffers()), torch.zeros((), dtype=torch.float64))
    return [name for name, rule in ensemble.combiners.items() if any(True for _ in named_leaves(rule.init((), like)))]


@torch.no_grad()
def cross_validate(
    ensemble: Ensemble,
    state: Any,
    runs: Sequence[Sample],
    elements: int = ELEMENTS,
    advance: Callable[[int], object] = lambda steps: None,
) -> FreeErrors:
    """Simulate every checkpoint, leaves `(checkpoints, ...)`, free on every run, leaves `(time,)`.

    At most so many `elements`, or all checkpoints on one run, are in a batch. `advance` receives the number of measured
    steps done over all batch elements.
    """
    names = methods(ensemble)
    count = next(leaf for _, leaf in named_leaves(state)).shape[0]
    shape = (count, len(runs), len(names))
    errors = FreeErrors(
        names, np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape, bool), np.zeros(len(runs))
    )
    order = np.argsort([-len(run.surge) for run in runs], kind="stable")
    at_once = max(1, elements // count)
    for first in range(0, len(runs), at_once):
        some = order[first : first + at_once]  # of nearly the same length
        absolute, square, diverged, steps = _simulated(ensemble, state, [runs[k] for k in some], advance)
        errors.steps[some] = steps
        with np.errstate(invalid="ignore"):
            errors.mae[:, some], errors.mse[:, some] = absolute / steps[:, None], square / steps[:, None]
        errors.diverged[:, some] = diverged
    return errors


def _simulated(ensemble: Ensemble, state: Any, runs: Sequence[Sample], advance: Callable[[int], object]):
    """Sums of |error| and error², `(checkpoints, runs, methods)`; which diverged; measured steps of each run."""
    dtype, count = state.predictions.dtype, state.predictions.shape[0]
    from usvlearn.engine.external import first_pass
    from usvlearn.engine.open_loop_scores import free_totals

    samples = _side_by_side(runs, dtype)  # (time, runs)
    batch = (count, len(runs))
    state = tree_map(lambda x: x[:, None].expand(*batch, *x.shape[1:]), state)
    learning = _learning(ensemble)
    scored = masks(samples, ensemble.surge_limit).learns.to(dtype).sum(0).cpu().numpy()
    whole = tree_map(lambda x: x[:, None].expand(-1, *batch), samples)
    if (description := choose(ensemble, state, whole, "auto")) is None:
        raise ConfigError(
            "cross-validation: found a combiner of other code, or a GPU, expected our combiners, on the CPU"
        )
    rules = [list(ensemble.combiners).index(name) for name in learning]
    arrays, first = (arrays_of(state), tree_map(array_of, whole)), first_pass(description, ensemble, state)
    given = None if first is None else first.run(*arrays, True)[1]
    totals = free_totals(description, *arrays, rules, torch.get_num_threads(), given)
    advance(scored.sum().item() * count)
    return totals[..., 0], totals[..., 1], totals[..., 2] > 0, scored


def _side_by_side(runs: Sequence[Sample], dtype: torch.dtype) -> Sample:
    """Runs as batch elements `(time, runs)`, padded to the longest with samples that are never fresh."""
    longest = max(len(run.surge) for run in runs)

    def padded(*leaves) -> Tensor:
        elements = [torch.as_tensor(leaf) for leaf in leaves]
        whole = torch.zeros((longest, len(elements)), dtype=dtype if elements[0].is_floating_point() else torch.bool)
        for element, leaf in enumerate(elements):
            whole[: len(leaf), element] = leaf
        return whole

    inputs = Inputs(*(padded(*leaves) for leaves in zip(*(run.inputs for run in runs), strict=True)))
    surge, fresh, measured = (padded(*leaves) for leaves in zip(*(run[1:] for run in runs), strict=True))
    for element, run in enumerate(runs):
        inputs.dt[len(run.surge) :, element] = 1.0  # 0 would start a segment
    return Sample(inputs, surge, fresh, measured)
