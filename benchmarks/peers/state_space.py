"""A recurrent state space by jax-sysid: output error over windows, by Adam and then L-BFGS.

    (v_k/V, h_k) = (v_(k−1)/V, h_(k−1)) + A z + B₂ tanh(B₁ z + b₁) + b₂,   z = (v_(k−1)/V, h_(k−1), x_k)

x_k are the inputs in force over the step to k, V is the top speed, h hidden states that begin at 0. v_(k−1) is the
measured speed while the model is told it, and its own prediction afterwards. All windows are batch elements of one
experiment, with the speeds that are told as further inputs.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from functools import partial

import numpy as np

from peers.batch import HIGHEST, Fitted, Stepper, choose, need, windows
from usvlearn.core.samples import Sample

MODULE = "jax_sysid"
SETTINGS = ((2, 1e-4, False), (4, 1e-4, False), (2, 1e-4, True), (4, 1e-4, True), (4, 1e-5, True))
# hidden states, penalty of the squared parameters, whether the inputs have the heading
UNITS, ADAM, LBFGS, RATE = 12, 300, 300, 1e-2
BEND = 0.05  # share of V where the loss becomes linear


def transition(x, u, params):
    """The next states `(elements, n)`, from inputs `(elements, m)`; the speed is the first state, per top speed."""
    import jax.numpy as jnp

    linear, into, bias, out, offset = params
    z = jnp.concatenate([x, u], -1)
    return x + z @ linear + jnp.tanh(z @ into + bias) @ out + offset


class StateSpace(Stepper):
    """The trained transition; its state is v/V and h."""

    def __init__(self, params: Sequence, heading: bool, top: float):
        import jax

        self.heading, self.top, self.hidden = heading, top, len(params[-1]) - 1
        self.next = jax.jit(partial(transition, params=params))

    def begin(self, speeds, inputs):
        return np.concatenate([speeds[:, None] / self.top, np.zeros((len(speeds), self.hidden))], -1)

    def step(self, state, inputs):
        state = np.array(self.next(state, inputs))
        state[:, 0] = state[:, 0].clip(-HIGHEST / self.top, HIGHEST / self.top)
        return state, self.top * state[:, 0]

    def correct(self, state, speeds):
        return np.concatenate([speeds[:, None] / self.top, state[:, 1:]], -1)


def one(
    runs: Sequence[Sample], top: float, hidden: int, penalty: float, heading: bool, adam: int = ADAM, lbfgs: int = LBFGS
) -> StateSpace:
    """The model of one setting."""
    need(MODULE, "jax-sysid")
    import jax
    import jax.numpy as jnp
    from jax_sysid.models import Model

    jax.config.update("jax_enable_x64", True)
    data = windows(runs, heading)
    steps, elements, m = data.inputs.shape
    n = 1 + hidden
    speeds = data.speeds / top
    begin = np.concatenate([data.first[:, None] / top, np.zeros((elements, hidden))], -1)

    def state_fcn(x, u, params):
        u = u.reshape(elements, m + 2)
        x = transition(x.reshape(elements, n), u[:, :m], params)
        return x.at[:, 0].set(jnp.where(u[:, m + 1] > 0, u[:, m], x[:, 0])).reshape(-1)

    def output_fcn(x, u, params):
        return x.reshape(elements, n)[:, 0]

    def loss(predicted, measured):
        known = jnp.isfinite(measured)
        wrong = jnp.abs(jnp.where(known, predicted - jnp.where(known, measured, 0.0), 0.0))
        bent = jnp.where(wrong < BEND, wrong**2 / (2 * BEND), wrong - BEND / 2)
        return bent.sum() / known.sum()

    rng = np.random.default_rng(0)
    into = rng.standard_normal((n + m, UNITS)) / np.sqrt(n + m)
    out = 0.1 * rng.standard_normal((UNITS, n)) / np.sqrt(UNITS)
    model = Model(n * elements, elements, (m + 2) * elements, state_fcn, output_fcn)
    linear = np.zeros((n + m, n))
    linear[range(n), range(n)] = -0.1
    model.init([linear, into, np.zeros(UNITS), out, np.zeros(n)], x0=begin.reshape(-1))
    model.loss(output_loss=loss, rho_th=penalty, train_x0=False)
    model.optimization(adam_eta=RATE, adam_epochs=adam, lbfgs_epochs=lbfgs, iprint=-1)
    inputs = np.concatenate([data.inputs, speeds[..., None], data.told[..., None]], -1).reshape(steps, -1)
    outputs = np.where(data.scored, speeds, np.nan)
    # An output of the library is that of the state before its step: the first one is given, the last step idle.
    with contextlib.redirect_stdout(io.StringIO()):
        model.fit(np.append(np.full_like(outputs[:1], np.nan), outputs, 0), np.append(inputs, 0 * inputs[:1], 0))
    return StateSpace([jnp.asarray(part) for part in model.params], heading, top)


def fit(runs: Sequence[Sample], top: float) -> Fitted:
    """The best of the settings."""
    settings = {
        f"{hidden} hidden states, penalty {penalty:g}{', heading' * heading}": partial(
            one, top=top, hidden=hidden, penalty=penalty, heading=heading
        )
        for hidden, penalty, heading in SETTINGS
    }
    return choose(settings, runs)
