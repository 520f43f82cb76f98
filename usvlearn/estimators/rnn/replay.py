"""The samples that the network learns again, in torch: `Replay` and equation (5) of `state`."""

from __future__ import annotations

import torch
from torch import Tensor

from usvlearn.estimators.rnn.state import STRIDE, TURN, UNBROKEN, Replay


def kept(replay: Replay, sample: Tensor) -> Replay:
    """The samples with one more, `(*batch, 7)`, in the place of the oldest."""
    size, learned = replay.samples.shape[-2], replay.learned.long()
    here = torch.arange(size, device=sample.device) == (learned % size)[..., None]  # (*batch, M)
    samples = torch.where(here[..., None], sample[..., None, :], replay.samples)
    learned = torch.where(learned + 1 < 2 * size, learned + 1, size)
    return replay._replace(samples=samples, learned=learned.to(sample.dtype))


def due(replay: Replay) -> tuple[Replay, Tensor, Tensor, Tensor]:
    """The kept sample whose turn it is, (5): the next turn, it, the one before it, and whether that led to it.

    >>> samples = torch.arange(14.0).reshape(2, 7)
    >>> replay, sample, before, unbroken = due(Replay(samples, torch.tensor(2.0), torch.tensor(600000.0)))
    >>> sample[0], before[0], unbroken, replay.turn
    (tensor(7.), tensor(0.), tensor(True), tensor(199479.))
    """
    size, learned, turn = replay.samples.shape[-2], replay.learned.long(), replay.turn.long()
    place = turn * learned.clamp(max=size) // TURN

    def at(place: Tensor) -> Tensor:
        return replay.samples.take_along_dim(place[..., None, None], -2)[..., 0, :]

    sample = at(place)
    unbroken = (sample[..., UNBROKEN] > 0) & (place != learned % size)  # where the oldest lies once all are full
    turned = replay._replace(turn=((turn + STRIDE) % TURN).to(sample.dtype))
    return turned, sample, at((place - 1) % size), unbroken
