"""Runs of boats in the plane over samples and poses, by the kernels."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from usvlearn.core.forecasts import Track
from usvlearn.core.samples import Inputs, PlanarSample, Sample, tree_map
from usvlearn.engine.backend import arrays_of, tree_of
from usvlearn.engine.validate import afresh
from usvlearn.errors import ConfigError

if TYPE_CHECKING:
    from usvlearn.estimators.planar.layer import Planar, PlanarState


def planar_stretches(
    planar: Planar, state: PlanarState, parts: Iterable[PlanarSample], record: Sequence[str]
) -> Iterator[tuple[PlanarState, dict[str, np.ndarray]]]:
    """`usvlearn.engine.rollouts.chunked_rollout` of a boat in the plane, of NumPy samples of consecutive stretches.

    Yields the state after each stretch, and the leaves that `record` names after each step, `(time, *batch, …)`.
    """
    from usvlearn.engine.external import first_pass, roll_both

    description, leaves = planar.description(), arrays_of(state)
    dtype, batch = leaves["surge.predictions"].dtype, leaves["surge.predictions"].shape[:-1]
    first = first_pass(description, planar, state)
    for part in parts:
        own: PlanarSample = tree_map(lambda x: x if x.dtype == bool else x.astype(dtype, copy=False), part)
        leaves, _, kept = roll_both(first, description, leaves, own, False, record, torch.get_num_threads())
        leaves, told = afresh(leaves, lambda: arrays_of(planar.init(batch)), first.ended if first else ())
        if told:
            warnings.warn(told, stacklevel=2)
        yield tree_of(state, leaves), kept


def forecast_tracks(planar: Any, state: PlanarState, inputs: Inputs) -> Track:
    """`usvlearn.forecast` of boats in the plane."""
    if not hasattr(planar, "yaw"):
        raise ConfigError(
            f"inputs.heading: found None with {type(planar).__name__}, expected headings, or a Planar, which forecasts "
            "them, too"
        )
    from usvlearn.engine.single_steps import PlanarStepper

    left, right, dt = (np.asarray(x, float) for x in (inputs.command_left, inputs.command_right, inputs.dt))
    if dt.size == 0 or not (dt == dt.flat[0]).all():
        raise ConfigError(f"inputs.dt: found {dt.size} lengths that differ, expected one for all steps, s")
    return PlanarStepper(planar.description(), arrays_of(state)).track(np.stack([left, right], -1), float(dt.flat[0]))


def with_poses(samples: Sample, poses: np.ndarray | None) -> PlanarSample:
    """Samples, leaves `(time, *batch)`, with what was measured beside them, `(time, *batch, 5)`; None: nothing was."""
    if poses is None:
        poses = np.full((*samples.surge.shape, len(PlanarSample._fields) - 1), np.nan)
    columns: list[Any] = [poses[..., i] for i in range(poses.shape[-1])]
    return PlanarSample(samples, *columns)
