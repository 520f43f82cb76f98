"""Other libraries' models of y = xᵀθ, behind one pair of calls: padasip, river, filterpy, kalman-py and plain RLS.

They start from P = 10 in units of the noise's variance and forget over 200 steps, as `benchmarks/stress.py` explains.
"""

import importlib.util
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from torch import Tensor

LAM, P, NOISE = 0.995, 9, 0.02  # forgetting per step; parameters; m/s, of a measured speed
NLMS_RATE, SGD_RATE = 0.3, 0.03
MODULES = {
    "padasip_rls": "padasip", "padasip_nlms": "padasip", "river_bayesian": "river", "river_linear": "river",
    "filterpy_kalman": "filterpy", "kalman_py": "kalman_py",
}  # fmt: skip


class Peer(NamedTuple):
    """Another library's model of y = xᵀθ, behind the calls that it documents."""

    predict: Callable[[np.ndarray], float]
    learn: Callable[[np.ndarray, float], object]
    numbers: Callable[[], list[np.ndarray]]  # its state


def plain_rls() -> Peer:
    theta, cov = np.zeros(P), 10 * np.eye(P)

    def learn(x: np.ndarray, y: float) -> None:
        K = cov @ x / (LAM + x @ cov @ x)
        theta[:] = theta + K * (y - x @ theta)
        cov[:] = (cov - np.outer(K, x @ cov)) / LAM

    return Peer(lambda x: x @ theta, learn, lambda: [theta, cov])


def plain_nlms(rate: float = NLMS_RATE, least: float = 1e-3) -> Peer:
    """θ ← θ + μ x e/(ε + xᵀx), as padasip's."""
    theta = np.zeros(P)

    def learn(x: np.ndarray, y: float) -> None:
        theta[:] = theta + rate * x * (y - x @ theta) / (least + x @ x)

    return Peer(lambda x: x @ theta, learn, lambda: [theta])


def padasip_rls() -> Peer:
    from padasip.filters import FilterRLS

    rls = FilterRLS(P, mu=LAM, eps=0.1, w="zeros")
    return Peer(rls.predict, lambda x, y: rls.adapt(y, x), lambda: [rls.w, rls.R])


def padasip_nlms(rate: float = NLMS_RATE) -> Peer:
    from padasip.filters import FilterNLMS

    nlms = FilterNLMS(P, mu=rate, w="zeros")
    return Peer(nlms.predict, lambda x, y: nlms.adapt(y, x), lambda: [nlms.w])


def river_bayesian() -> Peer:
    from river.linear_model import BayesianLinearRegression

    # With smoothing a sample weighs 1 − λ, so that this is the common prior.
    bayes = BayesianLinearRegression(alpha=10 / (1 - LAM), smoothing=LAM)
    unit = [{i: float(i == j) for i in range(P)} for j in range(P)]
    return Peer(
        lambda x: bayes.predict_one(dict(enumerate(x))),
        lambda x, y: bayes.learn_one(dict(enumerate(x)), y),
        lambda: [np.array([bayes.predict_one(x) for x in unit])],
    )


def river_linear(rate: float = SGD_RATE) -> Peer:
    from river import linear_model, optim

    sgd = linear_model.LinearRegression(optim.SGD(rate), intercept_lr=0.0)
    return Peer(
        lambda x: sgd.predict_one(dict(enumerate(x))),
        lambda x, y: sgd.learn_one(dict(enumerate(x)), y),
        lambda: [np.array([sgd.weights.get(i, 0.0) for i in range(P)])],
    )


def random_walk(C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """P0, Q and R of parameters that walk at random, with the common memory."""
    noise = 2 * NOISE**2  # of an increment
    walk = noise * (P * (1 - LAM) / np.sqrt(np.linalg.eigvalsh(C).clip(0)).sum()) ** 2
    return 10 * noise * np.eye(P), walk * np.eye(P), np.array([[noise]])


def filterpy_kalman(C: np.ndarray) -> Peer:
    from filterpy.kalman import KalmanFilter

    kf = KalmanFilter(dim_x=P, dim_z=1)
    kf.x = np.zeros((P, 1))
    kf.P, kf.Q, kf.R = random_walk(C)

    def predict(x: np.ndarray) -> float:
        kf.predict()
        return (x @ kf.x).item()

    return Peer(predict, lambda x, y: kf.update(y, H=x[None]), lambda: [kf.x, kf.P])


def kalman_py(C: np.ndarray) -> Peer:
    from kalman_py import KalmanFilter

    P0, Q, R = random_walk(C)
    kf = KalmanFilter(F=np.eye(P), H=np.zeros((1, P)), Q=Q, R=R, x0=np.zeros(P), P0=P0)

    def predict(x: np.ndarray) -> float:
        kf.predict()
        return x @ kf.x

    return Peer(predict, lambda x, y: kf.update(y, H=x[None]), lambda: [kf.x, kf.P])


def peers(C: Tensor) -> dict[str, Callable[[], Peer]]:
    """Those whose library is installed; C is the mean of φφᵀ."""
    kalman = {make.__name__: partial(make, C.numpy()) for make in (filterpy_kalman, kalman_py)}
    others = {make.__name__: make for make in (padasip_rls, padasip_nlms, river_bayesian, river_linear)} | kalman
    installed = {name: make for name, make in others.items() if importlib.util.find_spec(MODULES[name])}
    return {"plain_rls": plain_rls, **installed}
