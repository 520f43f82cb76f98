"""Settings that earlier versions have saved: names that have changed since then, and arguments that are newer."""

from __future__ import annotations

from typing import Any

_PUBLIC = {  # module before version 0.2 -> its classes, which are now named by the package itself
    "aid": ["AID"], "rls": ["RLS"], "sift": ["SIFtRLS"], "projected": ["Projected"], "rnn": ["RNN"],
    "persistence": ["Persistence"], "acceleration": ["Acceleration"], "robust": ["Robust"], "memory": ["WithMemory"],
    "ensemble": ["Ensemble", "Bank"], "regressors": ["SurgeDynamics", "QuasiStatic"],
    "combiners": ["Average", "FixedWeights", "RecursiveWeights", "ExponentialWeights", "BOA"],
}  # fmt: skip
_READERS = {  # class -> the rooms of its module in version 0.2, and now
    "Alog": ("alog", "formats.moos.alog"), "DataFlash": ("dataflash", "formats.ardupilot.dataflash"),
    "Rosbag": ("rosbag", "formats.ros.rosbag"), "Table": ("csv_table", "formats.csv.table"),
    "Tlog": ("tlog", "formats.ardupilot.tlog"), "Ulog": ("ulog", "formats.px4.ulog"),
}  # fmt: skip
TARGETS = {  # of several names of one class the last is the first one that it had
    **{f"usvlearn.logs.{old}.{name}": f"usvlearn.logs.{new}.{name}" for name, (old, new) in _READERS.items()},
    **{f"usvlearn.estimators.{old}.{name}": f"usvlearn.{name}" for old, names in _PUBLIC.items() for name in names},
    "usvlearn.logs.table.Table": "usvlearn.logs.formats.csv.table.Table",
    "usvlearn.Forecasts": "usvlearn.ForecastSettings",
    "usvlearn.logs.fleet.align_fleet": "usvlearn.logs.recordings.align_fleet",
}
MEMBERS = {
    "sift_map": "rls",
    "joint_averaged": "reader",
}  # of the default ensemble, the name of today and the first one
ADDED: dict[str, dict[str, Any]] = {  # arguments, and what they were before
    "usvlearn.SurgeDynamics": {"cubic": False, "exponential": False},
    "usvlearn.RNN": {"replay_size": 0, "replay_steps": 8},
    "usvlearn.JointEKF": {"trial": None},
}
ARGUMENTS = {"usvlearn.simulate.fleet.fleet": {"hulls": "fleet_seed"}}


def first_named(settings: Any) -> Any:
    """Settings with the names of the first version. A run is identified by these, so every version finds the same one.

    A newer argument is left out where its value changes nothing.

    >>> first_named({"aid": {"_target_": "usvlearn.AID", "gain": 1.0}})
    {'aid': {'_target_': 'usvlearn.estimators.aid.AID', 'gain': 1.0}}
    """
    named = _renamed(_without_added(settings), {new: old for old, new in TARGETS.items()}, {})
    for new, old in MEMBERS.items():
        if not _names(named, old):
            named = _with_name(named, new, old)
    return named


def _without_added(settings: Any) -> Any:
    """Settings without the arguments of `ADDED` that change nothing."""
    if isinstance(settings, list):
        return [_without_added(each) for each in settings]
    if not isinstance(settings, dict):
        return settings
    target = settings.get("_target_")
    added = ADDED.get(target, {}) if isinstance(target, str) else {}
    return {
        key: _without_added(value) for key, value in settings.items() if key not in added or value is not added[key]
    }


def _names(settings: Any, name: str) -> bool:
    """Whether a name is a key or a value anywhere in settings."""
    if isinstance(settings, dict):
        return name in settings or any(_names(each, name) for each in settings.values())
    return any(_names(each, name) for each in settings) if isinstance(settings, list) else settings == name


def _with_name(settings: Any, new: str, old: str) -> Any:
    """Settings in which each key and each value `new` is `old`."""
    if isinstance(settings, dict):
        return {old if key == new else key: _with_name(value, new, old) for key, value in settings.items()}
    if isinstance(settings, list):
        return [_with_name(each, new, old) for each in settings]
    return old if settings == new else settings


def current(settings: Any) -> Any:
    """Saved settings with the names of this version.

    >>> current({"aid": {"_target_": "usvlearn.estimators.aid.AID", "gain": 1.0}})
    {'aid': {'_target_': 'usvlearn.AID', 'gain': 1.0}}
    """
    return _renamed(settings, TARGETS, ARGUMENTS)


def _renamed(settings: Any, targets: dict[str, str], arguments: dict[str, dict[str, str]], levels: int = 100) -> Any:
    """Settings with targets and arguments renamed; anything nested deeper than `levels` stays unchanged."""
    if not isinstance(settings, dict | list) or not levels:
        return settings
    if isinstance(settings, list):
        return [_renamed(each, targets, arguments, levels - 1) for each in settings]
    target = settings.get("_target_")
    names = arguments.get(target, {}) if isinstance(target, str) else {}
    found = {names.get(key, key): _renamed(value, targets, arguments, levels - 1) for key, value in settings.items()}
    if isinstance(target, str):
        found["_target_"] = targets.get(target, target)
    return found
