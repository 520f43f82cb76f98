"""Settings that earlier versions have saved: what has another name since then."""

from __future__ import annotations

from typing import Any

_PUBLIC = {  # module that a class was in before version 0.2: its classes, which are now named by the package itself
    "aid": ["AID"], "rls": ["RLS"], "sift": ["SIFtRLS"], "projected": ["Projected"], "rnn": ["RNN"],
    "persistence": ["Persistence"], "acceleration": ["Acceleration"], "robust": ["Robust"], "memory": ["WithMemory"],
    "ensemble": ["Ensemble", "Bank"], "regressors": ["SurgeDynamics", "QuasiStatic"],
    "combiners": ["Average", "FixedWeights", "RecursiveWeights", "ExponentialWeights", "BOA"],
}  # fmt: skip
TARGETS = {
    **{f"usvlearn.estimators.{old}.{name}": f"usvlearn.{name}" for old, names in _PUBLIC.items() for name in names},
    "usvlearn.logs.table.Table": "usvlearn.logs.csv_table.Table",
    "usvlearn.logs.fleet.align_fleet": "usvlearn.logs.recordings.align_fleet",
}
ARGUMENTS = {"usvlearn.simulate.fleet.fleet": {"hulls": "fleet_seed"}}


def current(settings: Any, levels: int = 100) -> Any:
    """Saved settings with the names of this version, down to so many levels.

    >>> current({"aid": {"_target_": "usvlearn.estimators.aid.AID", "gain": 1.0}})
    {'aid': {'_target_': 'usvlearn.AID', 'gain': 1.0}}
    """
    if isinstance(settings, list) and levels:
        return [current(each, levels - 1) for each in settings]
    if not isinstance(settings, dict) or not levels:
        return settings
    target = settings.get("_target_")
    if not isinstance(target, str):
        return {key: current(value, levels - 1) for key, value in settings.items()}
    renamed = ARGUMENTS.get(target, {})
    rest = {renamed.get(key, key): current(value, levels - 1) for key, value in settings.items()}
    return rest | {"_target_": TARGETS.get(target, target)}
