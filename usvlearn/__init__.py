"""usvlearn: online identification of the surge dynamics of unmanned surface vehicles.

Names are imported when they are first used: importing the package imports no torch.
"""

import importlib

_HOME = {
    "Inputs": "signals",
    "Sample": "signals",
    "Run": "signals",
    "Fleet": "signals",
    "Estimator": "estimator",
    "rollout": "rollouts",
    "Positive": "hyper",
    "UnitInterval": "hyper",
    "AID": "estimators.aid.layer",
    "RLS": "estimators.least_squares.rls",
    "SIFtRLS": "estimators.least_squares.sift",
    "WithMemory": "estimators.wrappers.memory",
    "Robust": "estimators.wrappers.robust",
    "Projected": "estimators.least_squares.projected",
    "RNN": "estimators.rnn.layer",
    "Persistence": "estimators.baselines.persistence",
    "Acceleration": "estimators.baselines.acceleration",
    "Ensemble": "estimators.ensemble.layer",
    "Bank": "estimators.ensemble.layer",
    "Average": "estimators.ensemble.combiners",
    "FixedWeights": "estimators.ensemble.combiners",
    "RecursiveWeights": "estimators.ensemble.combiners",
    "ExponentialWeights": "estimators.ensemble.combiners",
    "BOA": "estimators.ensemble.combiners",
    "SurgeDynamics": "estimators.regressors.layer",
    "QuasiStatic": "estimators.regressors.layer",
    "Online": "online",
    "Aligner": "logs.align",
    "UsvlearnError": "errors",
    "read": "api",
    "learn": "api",
}
__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str):
    if name in _HOME:
        return getattr(importlib.import_module(f"usvlearn.{_HOME[name]}"), name)
    raise AttributeError(f"module 'usvlearn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
