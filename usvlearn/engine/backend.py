"""Chooses the backend, torch or compiled, and converts states between them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from usvlearn.core.protocol import Estimator, KernelEstimator, spec_of
from usvlearn.core.samples import Sample, named_leaves, rebuild
from usvlearn.engine.parts import compilable
from usvlearn.errors import ConfigError, check_choice

BACKENDS = ("auto", "torch", "kernel")


def choose(estimator: Estimator, state: Any, samples: Sample, backend: str) -> dict[str, Any] | None:
    """The description that the kernels run (`Estimator.description`), or None where torch makes the steps.

    A ConfigError if the backend is unknown, or is "kernel" where the kernels cannot run.
    """
    if check_choice("backend", backend, BACKENDS) == "torch":
        return None
    if samples.surge.numel() == 0:
        return description_of(estimator, "there are no batch elements", backend)
    obstacle = obstacle_of(
        estimator, state, samples, "cuda" if backend == "kernel" and samples.surge.is_cuda else "cpu"
    )
    return description_of(estimator, obstacle, backend)


def obstacle_of(estimator: Estimator, state: Any, samples: Sample, device: str) -> str | None:
    """Why the kernels on a device cannot make steps of this state, if they cannot.

    Raises:
        ConfigError: no other code can make them.
    """
    given = [*tensors_in(state), *tensors_in(samples)]
    obstacle = out_of_reach([*given, *of_kernels(estimator)], device)
    obstacle = obstacle or _derivative([*given, *estimator.parameters(), *estimator.buffers()])
    if obstacle and isinstance(estimator, KernelEstimator):
        raise ConfigError(
            f"{type(estimator).__name__}: {obstacle}, expected tensors on the CPU and no derivative: only its kernel "
            "makes its steps. Torch makes those of AID, RLS, SIFtRLS, RNN, Persistence, and of combiners"
        )
    return obstacle


def of_kernels(estimator: Estimator) -> list[Tensor]:
    """The parameters and buffers of an estimator, without those of members that other code steps."""
    members: Any = getattr(estimator, "members", {})
    others = [members[name] for name in getattr(estimator, "external", ())]
    left = {id(x) for each in others for x in (*each.parameters(), *each.buffers())}
    return [x for x in (*estimator.parameters(), *estimator.buffers()) if id(x) not in left]


def array_of(x: Tensor) -> np.ndarray:
    """A tensor as an array that shares its memory where it can."""
    return x.detach().cpu().resolve_neg().numpy()  # numpy(force=True) takes ten times as long


def arrays_of(state: Any) -> dict[str, np.ndarray]:
    """A state's leaves as arrays, by dotted name."""
    return {name: array_of(leaf) for name, leaf in named_leaves(state)}


def tree_of(template: Any, leaves: dict[str, np.ndarray], device: torch.device | None = None) -> Any:
    """A state like the template, from leaves by dotted name."""
    return rebuild(template, {name: torch.as_tensor(leaf, device=device) for name, leaf in leaves.items()})


def description_of(estimator: Estimator, obstacle: str | None, backend: str) -> dict[str, Any] | None:
    """The description that the kernels run; where they cannot, None, or a ConfigError if they were asked for."""
    if not obstacle and importlib.util.find_spec("numba") is None:
        obstacle = "numba is not installed (pip install numba)"
    description = None if obstacle else spec_of(estimator)
    if not obstacle and not compilable(description):
        obstacle = f"{type(estimator).__name__}, or a part of it, has no compiled kernel"
    if backend == "kernel" and obstacle:
        raise ConfigError(f"backend: found kernel, but {obstacle}: use auto or torch")
    return None if obstacle else description


def out_of_reach(tensors: Sequence[Tensor], device: str = "cpu") -> str | None:
    """Why the kernels cannot read these numbers on a device, "cpu" or "cuda", if they cannot."""
    if any(map(is_transformed, tensors)):
        return "torch transforms this function"
    if any(x.device.type != device for x in tensors):
        return f"not all tensors are on the {'GPU' if device == 'cuda' else 'CPU'}"
    dtypes = {x.dtype for x in tensors if x.is_floating_point()}
    if dtypes not in ({torch.float64}, {torch.float32}):
        return f"the numbers are {' and '.join(sorted(map(str, dtypes)))}"
    return None


def is_transformed(x: Tensor) -> bool:
    """Whether `torch.func` maps over a tensor or differentiates by it, or `torch.compile` traces."""
    wrapped = torch._C._functorch.is_functorch_wrapped_tensor  # pyright: ignore  # torch has no stub of this module
    return torch.compiler.is_compiling() or bool(wrapped(x))


def _derivative(tensors: Sequence[Tensor]) -> str | None:
    """Which derivative is asked for, so that torch must make the steps, if one is."""
    if torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
        return "a gradient is asked for (inside torch.no_grad() none is)"
    if any(x.is_floating_point() and unpack_dual(x).tangent is not None for x in tensors):
        return "a forward derivative is asked for"
    return None


def tensors_in(tree: Any) -> Iterator[Tensor]:
    return (leaf for _, leaf in named_leaves(tree))
