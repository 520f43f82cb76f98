"""Runs of boats in the plane over samples and poses, by the kernels."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from usvlearn.core.samples import PlanarSample, Sample, tree_map
from usvlearn.engine.backend import arrays_of, tree_of

if TYPE_CHECKING:
    from usvlearn.estimators.planar.layer import Planar, PlanarState


def planar_stretches(
    planar: Planar, state: PlanarState, parts: Iterable[PlanarSample], record: Sequence[str]
) -> Iterator[tuple[PlanarState, dict[str, np.ndarray]]]:
    """`usvlearn.engine.rollouts.stretches` of a boat in the plane.

    Args:
        planar, state: as of `Online`.
        parts: NumPy samples of consecutive stretches, leaves `(time, *batch)`.
        record: names of leaves of the state, such as "surge.predictions" and "track.due".

    Yields:
        The state after each stretch; the leaves after each of its steps, `(time, *batch, …)`.
    """
    from usvlearn.engine.run import roll

    description, leaves = planar.spec(), arrays_of(state)
    dtype = leaves["surge.predictions"].dtype
    for part in parts:
        own: PlanarSample = tree_map(lambda x: x if x.dtype == bool else x.astype(dtype, copy=False), part)
        leaves, _, kept = roll(description, leaves, own, record=record, threads=torch.get_num_threads())
        yield tree_of(state, leaves), kept


def with_poses(samples: Sample, poses: np.ndarray | None) -> PlanarSample:
    """Samples, leaves `(time, *batch)`, with what was measured beside them, `(time, *batch, 5)`; None: nothing was."""
    if poses is None:
        poses = np.full((*samples.surge.shape, len(PlanarSample._fields) - 1), np.nan)
    columns: list[Any] = [poses[..., i] for i in range(poses.shape[-1])]
    return PlanarSample(samples, *columns)
