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
    "rollout": "estimator",
    "Positive": "hyper",
    "UnitInterval": "hyper",
    "AID": "estimators.aid",
    "RLS": "estimators.rls",
    "SIFtRLS": "estimators.sift",
    "WithMemory": "estimators.memory",
    "Robust": "estimators.robust",
    "Projected": "estimators.projected",
    "RNN": "estimators.rnn",
    "Persistence": "estimators.persistence",
    "Acceleration": "estimators.acceleration",
    "Ensemble": "estimators.ensemble",
    "Bank": "estimators.ensemble",
    "Average": "estimators.combiners",
    "FixedWeights": "estimators.combiners",
    "RecursiveWeights": "estimators.combiners",
    "ExponentialWeights": "estimators.combiners",
    "BOA": "estimators.combiners",
    "SurgeDynamics": "estimators.regressors",
    "QuasiStatic": "estimators.regressors",
    "Online": "online",
    "Aligner": "logs.align",
    "UsvlearnError": "errors",
}
__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str):
    if name in _HOME:
        return getattr(importlib.import_module(f"usvlearn.{_HOME[name]}"), name)
    raise AttributeError(f"module 'usvlearn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
