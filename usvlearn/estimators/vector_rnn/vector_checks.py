"""What `VectorRNN` checks before it starts: its arguments, the samples of a rollout, and the file that it writes."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.samples import VectorSample, named_leaves
from usvlearn.errors import ConfigError, ShapeError
from usvlearn.estimators.vector_rnn.state import VectorRNNState


def listed(name: str, values: Any, expected: str) -> list[Any]:
    """The items of a sequence, an array or a tensor.

    Raises:
        ConfigError: one number instead of a sequence, or no number at all.

    >>> listed("maxima", 3.0, "one for each of 1 to 6 components")
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: maxima: found 3.0, expected numbers, one for each of 1 to 6 components: write (3.0,)
    """
    found = values.tolist() if isinstance(values, np.ndarray | Tensor) else values
    if isinstance(found, Iterable) and not isinstance(found, str | Mapping):
        return list(found)
    example = f"write ({found!r},)" if isinstance(found, int | float) else "give a tuple of numbers"
    raise ConfigError(f"{name}: found {found!r:.80}, expected numbers, {expected}: {example}")


def check_width(name: str, value: Any, components: int) -> None:
    """Raise a ShapeError unless a value is a tensor `(…, components)`."""
    if not isinstance(value, Tensor):
        raise ShapeError(f"{name}: found {type(value).__name__}, expected a torch tensor: use torch.as_tensor")
    if value.ndim == 0 or value.shape[-1] != components:
        raise ShapeError(
            f"{name}: {_width(value)}, expected {components}, as maxima has: give a column for each component"
        )


def check_samples(state: VectorRNNState, samples: VectorSample, components: int) -> None:
    """Raise a ShapeError unless the samples of a rollout fit each other, the components and the state.

    Args:
        state: leaves `(*batch, …)`.
        samples: leaves `(time, *batch)`, and `(time, *batch, components)`.
        components: q.
    """
    if not isinstance(samples, VectorSample):
        raise ShapeError(
            f"samples: found {type(samples).__name__}, expected a VectorSample: a run of read_velocities has it in its "
            "field samples"
        )
    leaves, device = list(named_leaves(samples)), state.velocity.device
    for name, leaf in leaves:
        if not isinstance(leaf, Tensor):
            raise ShapeError(
                f"samples: {name} is {type(leaf).__name__}, expected a torch tensor: convert all with "
                "usvlearn.core.samples.tree_map(torch.from_numpy, samples)"
            )
        if leaf.device != device:
            raise ShapeError(
                f"samples: {name} is on {leaf.device}, the state on {device}: move all with .to({str(device)!r})"
            )
    check_width("velocity", samples.velocity, components)
    check_width("measured", samples.measured, components)
    check_width("the state's velocity", state.velocity, components)
    shape = samples.velocity.shape[:-1]
    if not shape or shape[0] == 0:
        found = "no sample" if shape else "no axis of time"
        raise ShapeError(f"samples: found {found}, expected (time, *batch) of at least one step: give a longer run")
    for name, leaf in leaves:
        if name in ("fresh", "measured") and leaf.dtype != torch.bool:
            raise ShapeError(f"samples: {name} is {leaf.dtype}, expected torch.bool: convert it with .bool()")
        own = leaf.shape[:-1] if name in ("velocity", "measured") else leaf.shape
        if own != shape:
            raise ShapeError(
                f"samples: {name} has the axes {tuple(own)} before the components, velocity {tuple(shape)}: expected "
                "(time, *batch), the same for all, so cut or expand one of them"
            )
    batch = tuple(shape[1:])
    if state.updates.shape != batch or state.velocity.shape[:-1] != batch:
        has = (state.updates if state.updates.shape != batch else state.velocity[..., 0]).shape
        raise ShapeError(f"samples have the batch {batch}, the state {tuple(has)}: make the state by rnn.init({batch})")


def _width(value: Tensor) -> str:
    return f"found {value.shape[-1]} components" if value.ndim else "found one number without an axis of components"


def write_npz(path: str | Path, arrays: Mapping[str, np.ndarray]) -> Path:
    """Write arrays as .npz, completely or not at all; the folder is made, and the suffix added where it is missing.

    Raises:
        ConfigError: the file cannot be written.
    """
    path = Path(path)
    path = path if path.suffix == ".npz" else path.with_name(f"{path.name}.npz")
    content, unfinished = io.BytesIO(), path.with_name(f".{path.name}.unfinished")
    np.savez(content, **arrays)  # type: ignore[arg-type]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished.write_bytes(content.getvalue())
        os.replace(unfinished, path)
    except OSError as error:
        with suppress(OSError):
            unfinished.unlink()
        raise ConfigError(
            f"{path}: cannot be written ({error.strerror}): give a file in a folder that can be written"
        ) from error
    return path
