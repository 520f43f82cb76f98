"""What a sample of several components is used for, and the samples that are learned again."""

from __future__ import annotations

import torch
from torch import Tensor

from usvlearn.core.samples import PLAUSIBLE, PLAUSIBLE_INPUTS, VectorSample
from usvlearn.estimators.rnn.kept import whole
from usvlearn.estimators.vector_rnn.state import Kept


def masks(sample: VectorSample) -> tuple[Tensor, Tensor, Tensor]:
    """`steps`, `known`, `starts`: a step is made; a component is a plausible number; a segment starts."""
    known, dt = sample.velocity.abs() < PLAUSIBLE, sample.inputs.dt
    steps = sample.fresh & (dt > 0)
    for name in ("command_left", "command_right", "heading", "dt"):
        steps = steps & (getattr(sample.inputs, name).abs() < getattr(PLAUSIBLE_INPUTS, name))
    return steps, known, (dt == 0) & known.any(-1)


def added(kept: Kept, sample: tuple[Tensor, ...]) -> Kept:
    """The samples with one more, the first five leaves of `Kept` without the axis M, in the place of the oldest."""
    size = kept.successive.shape[-1]
    count = whole(kept.learned, 2 * size)
    here = torch.arange(size, device=count.device) == (count % size)[..., None]  # (*batch, M)
    *others, successive = sample
    before, u, target, weight = (
        torch.where(here[..., None], new[..., None, :], old) for new, old in zip(others, kept[:4], strict=True)
    )
    successive = torch.where(here, successive[..., None], kept.successive)
    count = torch.where(count + 1 < 2 * size, count + 1, size)
    return Kept(before, u, target, weight, successive, count.to(successive), kept.turn)
