"""The samples that the network keeps to learn them again, in torch: `Replay` and equation (5) of `state`."""

from __future__ import annotations

import torch
from torch import Tensor

from usvlearn.estimators.rnn.state import STRIDE, TURN, UNBROKEN, Replay


def whole(value: Tensor, end: int) -> Tensor:
    """Numbers as indices from 0 … end − 1; 0 where they are none, as in a member that has diverged."""
    return torch.where((value >= 0) & (value < end), value, 0.0).long()


def added(replay: Replay, sample: Tensor) -> Replay:
    """The samples with one more, `(*batch, 7)`, in the place of the oldest."""
    size = replay.samples.shape[-2]
    learned = whole(replay.learned, 2 * size)
    here = torch.arange(size, device=sample.device) == (learned % size)[..., None]  # (*batch, M)
    samples = torch.where(here[..., None], sample[..., None, :], replay.samples)
    learned = torch.where(learned + 1 < 2 * size, learned + 1, size)
    return replay._replace(samples=samples, learned=learned.to(sample.dtype))


def due(replay: Replay, count: int) -> tuple[Replay, Tensor, Tensor, Tensor]:
    """The next turn, and the kept samples whose turn it is, (5), `(*batch, count, 7)`.

    After them the samples one place earlier, and whether their steps led to these, `(*batch, count)`.
    """
    size = replay.samples.shape[-2]
    learned = whole(replay.learned, 2 * size)[..., None]
    turns = whole(replay.turn, TURN)[..., None] + STRIDE * torch.arange(count + 1, device=replay.turn.device)
    place = turns[..., :-1] % TURN * learned.clamp(max=size) // TURN

    def at(place: Tensor) -> Tensor:
        return replay.samples.take_along_dim(place[..., None], -2)

    again = at(place)
    unbroken = (again[..., UNBROKEN] > 0) & (place != learned % size)  # where the oldest lies once all are full
    turned = replay._replace(turn=(turns[..., -1] % TURN).to(again.dtype))
    return turned, again, at((place - 1) % size), unbroken
