"""What tests share: folders, random samples, and the estimators over which each property in test_contracts.py runs.

A new estimator is one line in that list. Each module of this package holds one kind of thing that several tests need.
"""

import functools
import inspect
import os
import shutil
from collections.abc import Callable, Container, Iterable
from pathlib import Path

import pytest
import torch

from usvlearn import (
    AID,
    ARX,
    BOA,
    RLS,
    RNN,
    Average,
    Ensemble,
    ExponentialWeights,
    FixedWeights,
    JointEKF,
    Persistence,
    QuasiStatic,
    RecursiveWeights,
    Robust,
    SIFtRLS,
    SurgeDynamics,
    SwayEKF,
    Trial,
    YawEKF,
)
from usvlearn.core.lock import Lock
from usvlearn.core.protocol import KernelEstimator
from usvlearn.testing import at as at
from usvlearn.testing import leaves as leaves
from usvlearn.testing import random_samples as random_samples

ROOT = Path(__file__).parents[2]
REAL_LOGS = ROOT.parent / "shared" / "data"


def _members() -> dict:
    return {"aid": AID(28.0), "rls": RLS(), "rnn": RNN(6)}


FAMILIES = {  # an estimator of each family
    "aid_estimate": lambda: AID(28.0, feedback="estimate", dead_zone=0.01),
    "robust_sift": lambda: Robust(SIFtRLS(SurgeDynamics(28.0), memory=5.0), threshold=1.345, scale=0.6),
    "rnn_replay": lambda: RNN(6, unroll=2, replay_size=7, replay_steps=3),
    "joint": lambda: JointEKF(2.5, 28.0),
    "yaw": lambda: YawEKF(2.5),
    "arx": ARX,
    "weighted": lambda: Ensemble(
        _members(), {"average": Average(["aid", "rls"]), "weighted": RecursiveWeights(forgetting=0.98)}
    ),
    "boa": lambda: Ensemble(
        {"aid": AID(28.0, gain=3.0), "rls": RLS(), "persistence": Persistence()},
        {"boa": BOA(prior={"rls": 0.5})},
    ),
}
ESTIMATORS = FAMILIES | {  # and other settings of them
    "aid": lambda: AID(28.0),
    "aid_exponential": lambda: AID(model=SurgeDynamics(28.0, cubic=True, exponential=True)),
    "rls": lambda: RLS(QuasiStatic(), forgetting=0.98),
    "dynamic_rls": lambda: RLS(SurgeDynamics(28.0), forgetting=0.98),
    "dynamic_rls_estimate": lambda: RLS(SurgeDynamics(28.0), forgetting=0.98, feedback="estimate"),
    "sift": lambda: SIFtRLS(QuasiStatic(), memory=5.0),
    "dynamic_sift": lambda: SIFtRLS(SurgeDynamics(28.0), memory=5.0),
    "dynamic_sift_estimate": lambda: SIFtRLS(SurgeDynamics(28.0), memory=5.0, feedback="estimate"),
    "exponential_sift": lambda: SIFtRLS(SurgeDynamics(28.0, cubic=True, exponential=True), memory=5.0),
    "robust_aid": lambda: Robust(AID(28.0), threshold=1.345),
    "rnn": lambda: RNN(6),
    "rnn_penalty": lambda: RNN(6, stability="penalty", penalty=1e-3, unroll=2, decay=None),
    "rnn_estimate": lambda: RNN(6, condition="interval", unroll=2, feedback="estimate"),
    "persistence": Persistence,
    "joint_odd": lambda: JointEKF(2.5, 28.0, disturbance=5.0, even=None, lag=0.3, outlier=8.0, estimate_every=2.0),
    "joint_trial": lambda: JointEKF(2.5, 28.0, estimate_every=2.0, trial=Trial(threshold=4.0, leads=1.0, steps=9)),
    "sway": lambda: SwayEKF(2.5),
    "arx_gaussian": lambda: ARX(
        lags=1, even=False, turning=True, thrust_speed=True, project=False, walk=1e-2, degrees=None
    ),
    "average": lambda: Ensemble(_members()),
    "fixed": lambda: Ensemble(_members(), {"fixed": FixedWeights({"aid": 0.5, "rls": 0.2, "rnn": 0.3})}),
    "exponential": lambda: Ensemble(
        {"aid": AID(28.0), "sift": SIFtRLS(), "persistence": Persistence()}, {"exponential": ExponentialWeights()}
    ),
}


def layers(estimators: dict[str, Callable]) -> dict[str, Callable]:
    """The estimators whose steps torch makes, too; an ensemble with forecasts takes it too long."""
    chosen = {name: make for name, make in estimators.items() if not name.startswith("forecasts")}
    return {name: make for name, make in chosen.items() if not isinstance(make(), KernelEstimator)}


def unaided(estimator):
    """The estimator; an ensemble without what the kernels alone make of its steps."""
    if not isinstance(estimator, Ensemble):
        return estimator
    return Ensemble(estimator.members, estimator.combiners, watched=False, conditional=False)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that one of the processes that test at the same time has filled; the others wait for it."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with Lock(folder.with_name(f"{name}_lock"), "name", wait=True):
        if not (folder / "made").exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            (folder / "made").touch()
    return folder


def few(values: Iterable, kept: Container, tier: str = "slow") -> list:
    """The values of `pytest.mark.parametrize`, of which those that are not kept run only in this tier.

    A tuple holds the values of several arguments.
    """
    marks = getattr(pytest.mark, tier)
    sets = [(value, value if type(value) is tuple else (value,)) for value in values]
    return [value if value in kept else pytest.param(*each, marks=marks) for value, each in sets]


def cases(default: int, thorough: int) -> Callable:
    """Makes a test over `count` cases: so many by default, and more of them in `thorough`."""
    return pytest.mark.parametrize("count", few([default, thorough], [default], "thorough"))


def each_family(values: Iterable) -> Callable:
    """Makes a test for each value of `name`; those that are not in FAMILIES run in `thorough`."""
    return pytest.mark.parametrize("name", few(values, FAMILIES, "thorough"))


# The kernels of single precision take a minute to compile where no code is kept.
each_dtype = pytest.mark.parametrize("dtype", few([torch.float64, torch.float32], [torch.float64], "thorough"), ids=str)
RECORDED = [  # boats with logs in REAL_LOGS: those of few logs in the default tests
    *few(["dalian", "pearl", "blueboat"], ["dalian", "pearl"], "thorough"),
    pytest.param("vtec", marks=pytest.mark.slow),
]


def over(argument: str, values: Iterable) -> Callable:
    """Makes one test that goes through all values of an argument; a failure names the value."""
    values = list(values)

    def decorate(test):
        @functools.wraps(test)
        def each(**others):
            for value in values:
                try:
                    test(**others, **{argument: value})
                except BaseException as error:
                    error.add_note(f"where {argument} is {value!r}")
                    raise

        signature = inspect.signature(test)
        left = [parameter for name, parameter in signature.parameters.items() if name != argument]
        each.__signature__ = signature.replace(parameters=left)
        return each

    return decorate
