"""Online: an estimator with the state of one vehicle (or of a batch), for a program that just wants to call it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from usvlearn import checkpoint
from usvlearn.estimator import Estimator
from usvlearn.signals import Inputs, Sample, named_leaves, tree_map


class Online:
    """Owns a state; learns one sample at a time, without gradients.

    Args:
        estimator: any `Estimator`.
        batch: `()` for one vehicle.

    Attributes:
        state: the estimator's state, to read, or to set from elsewhere.

    >>> from usvlearn import AID
    >>> online = Online(AID(mass=28.0))
    >>> inputs = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
    >>> for speed in (0.1, 0.2, 0.3):
    ...     predicted = online.step(Sample(inputs, surge=speed, fresh=True, measured=True))
    >>> bool(0.2 < online.predict(inputs) < 0.5)
    True
    """

    def __init__(self, estimator: Estimator, batch: Sequence[int] = ()):
        self.estimator = estimator
        self.state: Any = tree_map(Tensor.detach, estimator.init(batch))
        self._like = next(leaf for _, leaf in named_leaves(self.state) if leaf.is_floating_point())

    @torch.no_grad()
    def predict(self, inputs: Inputs) -> Tensor:
        """The predicted surge at the end of the step, m/s; nothing is learned."""
        return self.estimator.predict(self.state, Inputs(*map(self._float, inputs)))[1]

    @torch.no_grad()
    def step(self, sample: Sample) -> Tensor:
        """Predict, then learn from one sample (numbers, arrays or tensors); returns the prediction, m/s."""
        inputs, surge, fresh, measured = sample
        sample = Sample(Inputs(*map(self._float, inputs)), self._float(surge), self._bool(fresh), self._bool(measured))
        self.state, predicted = self.estimator(self.state, sample)
        return predicted

    def save(self, path: str | Path, **metadata: Any) -> Path:
        """Save the state; see `usvlearn.checkpoint.save`."""
        return checkpoint.save(path, self.state, estimator=type(self.estimator).__name__, **metadata)

    def load(self, path: str | Path) -> dict[str, Any]:
        """Go on from a saved state (the newest readable one where `path` is a folder); returns its metadata."""
        restore = checkpoint.restore_newest if Path(path).is_dir() else checkpoint.restore
        self.state, metadata = restore(path, self.state, type(self.estimator).__name__)
        return metadata

    def _float(self, value) -> Tensor:
        return torch.as_tensor(value, dtype=self._like.dtype, device=self._like.device)

    def _bool(self, value) -> Tensor:
        return torch.as_tensor(value, dtype=torch.bool, device=self._like.device)
