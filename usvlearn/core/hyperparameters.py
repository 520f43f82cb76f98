"""Hyperparameters: tuned numbers that stay legal, can be learned by gradient, and broadcast against the batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from usvlearn.errors import ConfigError, ShapeError

# The type of a hyperparameter's argument: a number, or numbers of any shape. A recursive type would accept a str.
Hyper = float | Sequence[float] | Sequence[Sequence[float]] | np.ndarray | Tensor


def as_tensor(value: Hyper, name: str = "value") -> Tensor:
    """A float64 tensor from numbers or a tensor: float32 cannot distinguish forgetting factors near 1."""
    if isinstance(value, Tensor):
        return value.detach().to(torch.float64, copy=True)
    try:
        return torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"{name}: found {value!r}, expected a number or numbers") from error


class Positive(nn.Module):
    """A positive number, stored as its logarithm.

    Args:
        value: number or tensor of any shape that broadcasts against the batch, as `(grid, 1)`; in the unit of what it
            is.
        name: its name in an error.
        learnable: whether gradients reach it.

    Raises:
        ConfigError: a value is not positive and finite.

    >>> Positive(0.5)()
    tensor(0.5000, dtype=torch.float64, grad_fn=<ExpBackward0>)
    """

    def __init__(self, value: Hyper, name: str = "value", learnable: bool = True):
        super().__init__()
        self.name, given = name, as_tensor(value, name)
        if not bool(((given > 0) & given.isfinite()).all()):
            raise ConfigError(f"{name}: found {given.tolist()}, expected a positive number")
        self.log = nn.Parameter(given.log(), requires_grad=learnable)

    def forward(self) -> Tensor:
        return self.log.exp()


class UnitInterval(nn.Module):
    """A number strictly between 0 and 1, stored as its logit.

    Args:
        value: number or tensor of any shape that broadcasts against the batch, as `(grid, 1)`; no unit.
        name: its name in an error.
        learnable: whether gradients reach it.

    Raises:
        ConfigError: a value is not inside (0, 1).

    >>> round(UnitInterval(0.995)().item(), 6)
    0.995
    """

    def __init__(self, value: Hyper, name: str = "value", learnable: bool = True):
        super().__init__()
        self.name, given = name, as_tensor(value, name)
        if not bool(((given > 0) & (given < 1)).all()):
            raise ConfigError(f"{name}: found {given.tolist()}, expected a number between 0 and 1, both excluded")
        self.logit = nn.Parameter(given.logit(), requires_grad=learnable)

    def forward(self) -> Tensor:
        return self.logit.sigmoid()


def numbers(**values: Any) -> dict[str, Any]:
    """Hyperparameters and constants as numbers, or lists of numbers, that JSON can store."""
    plain = {name: value() if isinstance(value, Positive | UnitInterval) else value for name, value in values.items()}
    return {
        name: value.detach().cpu().double().tolist() if isinstance(value, Tensor) else float(value)
        for name, value in plain.items()
    }


def check_broadcast(module: nn.Module, batch: tuple[int, ...]) -> None:
    """Raise a ShapeError unless every hyperparameter of an estimator broadcasts against the batch of its state."""
    for path, part in module.named_modules():
        if isinstance(part, Positive | UnitInterval):
            shape = tuple(next(part.parameters()).shape)
            try:
                fits = np.broadcast_shapes(shape, batch) == tuple(batch)
            except ValueError:
                fits = False
            if not fits:
                raise ShapeError(
                    f"{path or part.name}: found the shape {shape}, expected one that broadcasts against the batch "
                    f"{batch}: a grid is (grid, 1) beside a batch (grid, boats)"
                )
