"""usvlearn: online identification of the surge dynamics of unmanned surface vehicles.

Names are imported when they are first used: importing the package imports no torch.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors see; a test compares it with _HOME
    from usvlearn.api import learn as learn
    from usvlearn.api import read as read
    from usvlearn.core.forecasts import Forecast as Forecast
    from usvlearn.core.forecasts import Track as Track
    from usvlearn.core.hyperparameters import Positive as Positive
    from usvlearn.core.hyperparameters import UnitInterval as UnitInterval
    from usvlearn.core.protocol import Estimator as Estimator
    from usvlearn.core.samples import Fleet as Fleet
    from usvlearn.core.samples import Inputs as Inputs
    from usvlearn.core.samples import PlanarSample as PlanarSample
    from usvlearn.core.samples import Run as Run
    from usvlearn.core.samples import Sample as Sample
    from usvlearn.core.samples import VectorSample as VectorSample
    from usvlearn.engine.online import Online as Online
    from usvlearn.engine.rollouts import forecast as forecast
    from usvlearn.engine.rollouts import rollout as rollout
    from usvlearn.errors import UsvlearnError as UsvlearnError
    from usvlearn.estimators.aid.layer import AID as AID
    from usvlearn.estimators.arx.layer import ARX as ARX
    from usvlearn.estimators.axis.layer import SwayEKF as SwayEKF
    from usvlearn.estimators.axis.layer import YawEKF as YawEKF
    from usvlearn.estimators.baselines.persistence.layer import Persistence as Persistence
    from usvlearn.estimators.ensemble.combiners.layer import BOA as BOA
    from usvlearn.estimators.ensemble.combiners.layer import Average as Average
    from usvlearn.estimators.ensemble.combiners.layer import ExponentialWeights as ExponentialWeights
    from usvlearn.estimators.ensemble.combiners.layer import FixedWeights as FixedWeights
    from usvlearn.estimators.ensemble.combiners.layer import RecursiveWeights as RecursiveWeights
    from usvlearn.estimators.ensemble.forecasts.layer import ForecastSettings as ForecastSettings
    from usvlearn.estimators.ensemble.layer import Ensemble as Ensemble
    from usvlearn.estimators.external.adapter import external as external
    from usvlearn.estimators.external.online_module import OnlineModule as OnlineModule
    from usvlearn.estimators.external.own_numba import kernel as kernel
    from usvlearn.estimators.joint.change_detection import Trial as Trial
    from usvlearn.estimators.joint.layer import JointEKF as JointEKF
    from usvlearn.estimators.least_squares.rls import RLS as RLS
    from usvlearn.estimators.least_squares.sift import SIFtRLS as SIFtRLS
    from usvlearn.estimators.planar.layer import Planar as Planar
    from usvlearn.estimators.regressors.layer import QuasiStatic as QuasiStatic
    from usvlearn.estimators.regressors.layer import SurgeDynamics as SurgeDynamics
    from usvlearn.estimators.rnn.layer import RNN as RNN
    from usvlearn.estimators.wrappers.robust.layer import Robust as Robust
    from usvlearn.logs.alignment.align import Aligner as Aligner

_HOME = {
    "Inputs": "core.samples",
    "Sample": "core.samples",
    "PlanarSample": "core.samples",
    "VectorSample": "core.samples",
    "Run": "core.samples",
    "Fleet": "core.samples",
    "Estimator": "core.protocol",
    "rollout": "engine.rollouts",
    "forecast": "engine.rollouts",
    "Forecast": "core.forecasts",
    "Track": "core.forecasts",
    "Positive": "core.hyperparameters",
    "UnitInterval": "core.hyperparameters",
    "AID": "estimators.aid.layer",
    "ARX": "estimators.arx.layer",
    "RLS": "estimators.least_squares.rls",
    "SIFtRLS": "estimators.least_squares.sift",
    "Robust": "estimators.wrappers.robust.layer",
    "RNN": "estimators.rnn.layer",
    "OnlineModule": "estimators.external.online_module",
    "external": "estimators.external.adapter",
    "kernel": "estimators.external.own_numba",
    "Persistence": "estimators.baselines.persistence.layer",
    "JointEKF": "estimators.joint.layer",
    "YawEKF": "estimators.axis.layer",
    "SwayEKF": "estimators.axis.layer",
    "Planar": "estimators.planar.layer",
    "Trial": "estimators.joint.change_detection",
    "Ensemble": "estimators.ensemble.layer",
    "ForecastSettings": "estimators.ensemble.forecasts.layer",
    "Average": "estimators.ensemble.combiners.layer",
    "FixedWeights": "estimators.ensemble.combiners.layer",
    "RecursiveWeights": "estimators.ensemble.combiners.layer",
    "ExponentialWeights": "estimators.ensemble.combiners.layer",
    "BOA": "estimators.ensemble.combiners.layer",
    "SurgeDynamics": "estimators.regressors.layer",
    "QuasiStatic": "estimators.regressors.layer",
    "Online": "engine.online",
    "Aligner": "logs.alignment.align",
    "UsvlearnError": "errors",
    "read": "api",
    "learn": "api",
}
__all__ = sorted(_HOME)
__version__ = "0.3.0"


if not TYPE_CHECKING:  # to a type checker a name that is not above is an error

    def __getattr__(name: str) -> Any:
        if name in _HOME:
            return getattr(importlib.import_module(f"usvlearn.{_HOME[name]}"), name)
        raise AttributeError(f"module 'usvlearn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
