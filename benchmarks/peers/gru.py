"""A gated recurrent unit (GRU) in torch, trained on windows.

    h_k = GRU([v_(k−1)/V, x_k], h_(k−1)),   v_k = v_(k−1) + V (wᵀ h_k + b)

x_k are the inputs in force over the step to k, V is the top speed. v_(k−1) is the measured speed while the network is
told it, and its own prediction afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from peers.batch import HIGHEST, Fitted, Stepper, choose, windows
from usvlearn.core.samples import Sample

SETTINGS = ((16, False), (16, True), (32, False), (32, True))  # units; whether the inputs have the heading
UPDATES, LANES, RATE, DECAY, BEND = 400, 64, 5e-3, 1e-2, 0.05  # BEND: share of V where the loss becomes linear


class Gru(nn.Module, Stepper):
    """The network; its state is h and v/V."""

    def __init__(self, units: int, heading: bool, top: float):
        super().__init__()
        self.heading, self.top = heading, top
        self.cell, self.out = nn.GRUCell((5 if heading else 3) + 1, units), nn.Linear(units, 1)

    def forward(self, h: Tensor, v: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """h and v/V after a step."""
        h = self.cell(torch.cat([v[:, None], x], -1), h)
        return h, (v + self.out(h)[:, 0]).clamp(-HIGHEST / self.top, HIGHEST / self.top)

    def begin(self, speeds, inputs):
        return np.concatenate([np.zeros((len(speeds), self.cell.hidden_size)), speeds[:, None] / self.top], -1)

    @torch.no_grad()
    def step(self, state, inputs):
        state, x = (torch.as_tensor(part, dtype=torch.float32) for part in (state, inputs))
        h, v = self(state[:, :-1], state[:, -1], x)
        return torch.cat([h, v[:, None]], -1).numpy().astype(float), self.top * v.numpy().astype(float)

    def correct(self, state, speeds):
        return np.concatenate([state[:, :-1], speeds[:, None] / self.top], -1)


def one(runs: Sequence[Sample], top: float, units: int, heading: bool, updates: int = UPDATES) -> Gru:
    """The network of one setting."""
    data = windows(runs, heading)
    x, first, speeds = (torch.as_tensor(part, dtype=torch.float32) for part in data[:3])
    given, scored = (torch.as_tensor(part) for part in data[3:])
    first, speeds = first / top, speeds / top
    torch.manual_seed(0)
    net = Gru(units, heading, top)
    with torch.no_grad():
        net.out.weight *= 0.1
    optimiser = torch.optim.AdamW(net.parameters(), RATE, weight_decay=DECAY)
    rates = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    for _ in range(updates):
        elements = torch.randint(len(first), (min(LANES, len(first)),))
        h, v, predicted = torch.zeros(len(elements), units), first[elements], []
        for k in range(len(x)):
            h, v = net(h, v, x[k, elements])
            predicted.append(v)
            v = torch.where(given[k, elements], speeds[k, elements], v)
        judged = scored[:, elements]
        loss = nn.functional.smooth_l1_loss(torch.stack(predicted)[judged], speeds[:, elements][judged], beta=BEND)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        rates.step()
    return net


def fit(runs: Sequence[Sample], top: float) -> Fitted:
    """The best of the settings."""
    settings = {
        f"{units} units{', heading' * heading}": partial(one, top=top, units=units, heading=heading)
        for units, heading in SETTINGS
    }
    return choose(settings, runs)
