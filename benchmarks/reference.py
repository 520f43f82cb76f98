"""The estimators in C (`reference.c`), compiled with the machine's own compiler: how fast a step can be.

Each call runs one boat over samples `(time,)`, all of which are fresh and measured, from the state that the estimator
begins with.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import torch

from usvlearn import AID, RLS, RNN, Estimator, JointEKF, QuasiStatic, Sample, SIFtRLS, SwayEKF, YawEKF

SOURCE = Path(__file__).with_suffix(".c")
FLAGS = ("-std=c99", "-O3", "-march=native", "-ffast-math")  # no sample is NaN
P, N, ROWS, FILTER = 16, 520, 7, 24  # P_MAX, N_MAX, ROWS, FILTER_MAX
NUMBER, WHOLE = ctypes.c_double, ctypes.c_int
POINTER = ctypes.POINTER(NUMBER)


def fields(names: str, kind: type = NUMBER) -> list[tuple[str, type]]:
    return [(name, kind) for name in names.split()]


class Samples(ctypes.Structure):
    _fields_ = fields("left right heading yaw_rate dt surge", POINTER)


class LeastSquares(ctypes.Structure):
    _fields_ = fields("model p", WHOLE) + fields("mass surge_max memory floor forgetting trace_max")


class LeastSquaresState(ctypes.Structure):
    _fields_ = [("theta", NUMBER * P), ("columns", NUMBER * P * P), *fields("surge noise deviation")]


class Adaptive(ctypes.Structure):
    _fields_ = [("p", WHOLE), *fields("mass surge_max floor sigma bound"),
                *fields("gamma inverse_spread lower upper", NUMBER * P)]  # fmt: skip


class AdaptiveState(ctypes.Structure):
    _fields_ = [("theta", NUMBER * P), ("surge", NUMBER)]


class Network(ctypes.Structure):
    _fields_ = [("n", WHOLE), *fields("scale rate decay clip contraction_rate"), ("ratio", NUMBER * ROWS)]


class NetworkState(ctypes.Structure):
    _fields_ = [*fields("weights squares", NUMBER * N * ROWS), *fields("updates surge")]


class Joint(ctypes.Structure):
    _fields_ = [("n", WHOLE), *fields("disturbance disturbance_time current current_time drift_time outlier"),
                ("variance", NUMBER * FILTER)]  # fmt: skip


class Axis(ctypes.Structure):
    _fields_ = [("n", WHOLE), *fields("disturbance disturbance_time drift_time outlier"),
                ("variance", NUMBER * FILTER)]  # fmt: skip


class FilterState(ctypes.Structure):
    _fields_ = [*fields("mean D", NUMBER * FILTER), ("columns", NUMBER * FILTER * FILTER),
                *fields("noise updates turn deviation"), ("commands", NUMBER * 2)]  # fmt: skip


def compiler() -> str | None:
    """The C compiler of the machine, or None."""
    return shutil.which("gcc") or shutil.which("cc")


@cache
def library() -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as folder:
        part, built = Path(folder) / "reference.o", Path(folder) / "reference.so"
        # Linked without -ffast-math, with which a library makes denormal numbers 0 in the whole process that loads it.
        subprocess.run([compiler(), *FLAGS, "-c", "-fPIC", "-o", part, SOURCE], check=True)
        subprocess.run([compiler(), "-shared", "-o", built, part, "-lm"], check=True)
        return ctypes.CDLL(str(built))


@torch.no_grad()
def reference(estimator: Estimator, samples: Sample) -> Callable[[], np.ndarray] | None:
    """What runs the same estimator in C, and returns its predictions, m/s, `(time,)`; None where there is none."""
    makes = {AID: adaptive, RLS: least_squares, SIFtRLS: least_squares, RNN: network, JointEKF: joint, YawEKF: axis,
             SwayEKF: axis}  # fmt: skip
    make = makes.get(type(estimator))
    if make is None:
        return None
    function, settings, first = make(estimator)
    inputs = [np.ascontiguousarray(x, dtype=float) for x in (*samples.inputs, samples.surge)]
    seen, out = Samples(*(x.ctypes.data_as(POINTER) for x in inputs)), np.empty(len(inputs[0]))
    here, call = type(first)(), getattr(library(), function)
    call.restype, call.argtypes = None, [ctypes.c_long, *[ctypes.c_void_p] * 4]
    arguments = len(out), ctypes.byref(seen), ctypes.byref(settings), ctypes.byref(here), out.ctypes.data

    def run(_inputs=inputs) -> np.ndarray:  # which must outlive the pointers to them
        ctypes.pointer(here)[0] = first
        call(*arguments)
        return out

    return run


def numbers(values, length: int = P):
    """Numbers as a C array, filled up with zeros."""
    array = np.zeros(length)
    array[: len(values)] = values
    return (NUMBER * length)(*array)


def least_squares(estimator: RLS | SIFtRLS):
    model, begin, p = estimator.model, estimator.init(), len(estimator.model.names)
    settings = LeastSquares(isinstance(model, QuasiStatic), p, float(model.scale), estimator.surge_max)
    if isinstance(estimator, RLS):
        settings.forgetting, settings.trace_max = float(estimator.forgetting()), float(estimator.trace_max)
    else:
        settings.memory, settings.floor = float(estimator.memory()), estimator.floor
    first = LeastSquaresState(noise=float(begin.noise))
    for k in range(p):
        first.columns[k] = numbers(begin.factor[:, k])

    return "rls" if isinstance(estimator, RLS) else "sift", settings, first


def adaptive(aid: AID):
    p, gamma = len(aid.model.names), float(aid.gain()) * aid.spread**2
    settings = Adaptive(p, float(aid.model.mass), aid.surge_max, aid.floor, aid.sigma, aid.bound,
                        *map(numbers, (gamma, aid.inverse_spread, aid.lower, aid.upper)))  # fmt: skip
    return "aid", settings, AdaptiveState()


def network(rnn: RNN):
    n, begin = len(rnn.a), rnn.init()
    ratio = rnn.rate_ratio.tolist()
    settings = Network(n, rnn.scale, float(rnn.rate()), rnn.decay, rnn.clip, float(rnn.contraction_rate()),
                       numbers([ratio[0], ratio[n], *ratio[2 * n : 2 * n + 4], ratio[-1]], ROWS))  # fmt: skip
    a, w1, W2, b = (w.numpy() for w in begin.weights)
    first = NetworkState()
    for row, values in enumerate((a, w1, *W2.T, b)):
        first.weights[row] = numbers(values, N)
    return "rnn", settings, first


def joint(filter: JointEKF):
    tuned = (filter.disturbance, filter.disturbance_time, filter.current, filter.current_time, filter.drift_time)
    settings = Joint(4 + len(filter.names), *(float(each()) for each in tuned), float(filter.outlier),
                     numbers(filter.variance, FILTER))  # fmt: skip
    return "joint", settings, filter_state(filter)


def axis(filter: YawEKF | SwayEKF):
    tuned = (filter.disturbance, filter.disturbance_time, filter.drift_time)
    settings = Axis(2 + len(filter.names), *(float(each()) for each in tuned), float(filter.outlier),
                    numbers(filter.variance, FILTER))  # fmt: skip
    return "axis", settings, filter_state(filter)


def filter_state(filter: JointEKF | YawEKF | SwayEKF) -> FilterState:
    """The first state of a filter in C."""
    begin = filter.init()
    first = FilterState(noise=float(begin.noise))
    first.mean, first.D = numbers(begin.mean, FILTER), numbers(begin.factor.diagonal(), FILTER)
    for k in range(len(begin.mean)):
        first.columns[k][k] = 1.0
    return first
