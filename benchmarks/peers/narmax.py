"""Polynomial NARMAX by forward regression with orthogonal least squares (FROLS), of SysIdentPy.

    v_k = Σ_j θ_j Π (v_(k−1), …, v_(k−L), x_k, …, x_(k−L+1)) + c e_(k−1) + e_k

Π are products of at most `degree` factors; x_k are the inputs in force over the step to k; e_k is the error one step
ahead. Terms are chosen by their error reduction ratio. c is 0, or found with θ by extended least squares; as in the
library, predictions leave e out.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np

from peers.batch import HIGHEST, Fitted, Stepper, choose, features, need, stretches
from usvlearn.core.samples import Sample, masks

MODULE = "sysidentpy"
ORDERS = ((1, 1), (1, 2), (1, 3), (2, 2), (3, 1), (3, 2))  # lags, degree
TERMS = (6, 12, 24)
REPEATS = 10  # of extended least squares


class Narmax(Stepper):
    """The chosen terms; its state is the last speeds, and the last values of each input, newest first."""

    def __init__(self, basis, places: np.ndarray, theta: np.ndarray, lags: int, heading: bool):
        self.basis, self.places, self.theta, self.lags, self.heading = basis, places, theta, lags, heading

    def begin(self, speeds, inputs):
        return np.concatenate([speeds[:, None], inputs], -1).repeat(self.lags, -1)

    def step(self, state, inputs):
        now = state.reshape(len(state), -1, self.lags).copy()
        now[:, 1:] = np.concatenate([inputs[..., None], now[:, 1:, :-1]], -1)
        regressors = np.concatenate([np.ones((len(now), 1)), now.reshape(len(now), -1)], -1)
        terms = self.basis.transform(regressors, 0, predefined_regressors=self.places)
        speeds = (terms @ self.theta).clip(-HIGHEST, HIGHEST)
        now[:, 0] = np.concatenate([speeds[:, None], now[:, 0, :-1]], -1)
        return now.reshape(state.shape), speeds

    def correct(self, state, speeds):
        return np.concatenate([speeds[:, None], state[:, 1:]], -1)


def one(runs: Sequence[Sample], lags: int, degree: int, terms: int, heading: bool, noise: bool) -> Narmax:
    """The model of one setting."""
    need(MODULE, "SysIdentPy")
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares
    from sysidentpy.utils.information_matrix import build_lagged_matrix

    count, basis, every = 5 if heading else 3, Polynomial(degree=degree), list(range(1, lags + 1))
    psi, y = [], []
    for run in runs:
        use, x = masks(run), features(run, heading)
        for begin, end in stretches(use.learns, use.starts):
            if end - begin > lags:  # the library's x(k−1) is the input of the step to k
                rows, shifted = slice(begin, end), np.append(x[begin + 1 : end], x[end - 1 : end], 0)
                lagged = build_lagged_matrix(shifted, run.surge[rows, None], [every] * count, every, "NARMAX")
                psi.append(basis.fit(lagged, lags, every, [every] * count, "NARMAX"))
                y.append(run.surge[begin + lags : end])
    psi, y = np.concatenate(psi), np.concatenate(y)[:, None]
    terms = min(terms, psi.shape[1])
    frols = FROLS(ylag=every, xlag=[every] * count, basis_function=basis, order_selection=False, n_terms=terms)
    unused = np.zeros((lags, 1))  # the library leaves out the first speeds
    _, places, chosen = frols.error_reduction_ratio(psi, np.append(unused, y, 0), terms)
    theta = LeastSquares().optimize(chosen, y)
    # The library's extended least squares adds a second constant, and returns half of the sum for the first.
    for _ in range(REPEATS if noise else 0):
        e = y - chosen @ theta
        chosen = np.append(chosen[:, :terms], np.append(np.zeros((1, 1)), e[:-1], 0), 1)
        theta = LeastSquares().optimize(chosen, y)
    return Narmax(basis, places, theta[:terms, 0], lags, heading)


def fit(runs: Sequence[Sample], top: float) -> Fitted:
    """The best of the settings; the top speed is not used."""
    settings = {
        f"{lags} lags, degree {degree}, {terms} terms{', heading' * heading}{', noise model' * noise}": partial(
            one, lags=lags, degree=degree, terms=terms, heading=heading, noise=noise
        )
        for (lags, degree), terms, heading, noise in product(ORDERS, TERMS, (False, True), (False, True))
    }
    return choose(settings, runs)
