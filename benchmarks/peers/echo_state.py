"""An echo state network (Jaeger 2001): fixed random recurrent units; ridge regression learns the output alone.

    h_k = (1 − a) h_(k−1) + a tanh(R h_(k−1) + S z + b),   v_k/V = v_(k−1)/V + w (h_k, z, 1),   z = (v_(k−1)/V, x_k)

x_k are the inputs in force over the step to k, V is the top speed; the spectral radius of R is given. v_(k−1) is
measured while the model is told it, and predicted afterwards; h begins at 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from peers.batch import HIGHEST, Fitted, Stepper, choose, windows
from usvlearn.core.samples import Sample

UNITS = 100
SETTINGS = tuple(product((0.5, 0.9), (0.1, 0.5), (1e-6, 1e-3), (False, True)))
# spectral radius, leak a, penalty of the squared weights per row, whether the inputs have the heading


class EchoState(Stepper):
    """The network; its state is v/V and h."""

    def __init__(self, count: int, radius: float, leak: float, heading: bool, top: float):
        rng = np.random.default_rng(0)
        recurrent = rng.standard_normal((UNITS, UNITS))
        self.recurrent = recurrent * radius / np.abs(np.linalg.eigvals(recurrent)).max()
        self.into, self.bias = rng.uniform(-1, 1, (1 + count, UNITS)), rng.uniform(-1, 1, UNITS)
        self.leak, self.heading, self.top = leak, heading, top
        self.out = np.zeros(UNITS + 2 + count)

    def begin(self, speeds, inputs):
        return np.concatenate([speeds[:, None] / self.top, np.zeros((len(speeds), UNITS))], -1)

    def rows(self, state, inputs):
        """What the output is linear in, `(elements, n)`: it begins with h after the step."""
        z, h = np.concatenate([state[:, :1], inputs], -1), state[:, 1:]
        h = h + self.leak * (np.tanh(h @ self.recurrent + z @ self.into + self.bias) - h)
        return np.concatenate([h, z, np.ones((len(z), 1))], -1)

    def step(self, state, inputs):
        rows = self.rows(state, inputs)
        speed = (state[:, 0] + rows @ self.out).clip(-HIGHEST / self.top, HIGHEST / self.top)
        return np.concatenate([speed[:, None], rows[:, :UNITS]], -1), self.top * speed

    def correct(self, state, speeds):
        return np.concatenate([speeds[:, None] / self.top, state[:, 1:]], -1)


def one(runs: Sequence[Sample], top: float, radius: float, leak: float, penalty: float, heading: bool) -> EchoState:
    """The model of one setting; it is told each measured speed of the windows, and learns the change to the next."""
    data = windows(runs, heading)
    model = EchoState(data.inputs.shape[-1], radius, leak, heading, top)
    state, known, regressors, change = model.begin(data.first, data.inputs[0]), np.ones(len(data.first), bool), [], []
    for inputs, speeds, given in zip(data.inputs, data.speeds / top, data.told | data.scored, strict=True):
        rows = model.rows(state, inputs)
        regressors.append(rows[known & given])
        change.append((speeds - state[:, 0])[known & given])
        state, known = np.concatenate([np.where(given, speeds, state[:, 0])[:, None], rows[:, :UNITS]], -1), given
    rows, goal = np.concatenate(regressors), np.concatenate(change)
    model.out = np.linalg.solve(rows.T @ rows + penalty * len(rows) * np.eye(rows.shape[1]), rows.T @ goal)
    return model


def fit(runs: Sequence[Sample], top: float) -> Fitted:
    """The best of the settings."""
    settings = {
        f"radius {radius:g}, leak {leak:g}, penalty {penalty:g}{', heading' * heading}": partial(
            one, top=top, radius=radius, leak=leak, penalty=penalty, heading=heading
        )
        for radius, leak, penalty, heading in SETTINGS
    }
    return choose(settings, runs)
