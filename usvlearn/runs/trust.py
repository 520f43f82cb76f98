"""Which saved settings may be instantiated. A run may come from anybody, and Hydra calls each `_target_` in it.

Allowed are the public classes of usvlearn, the classes that a module below PACKAGES defines itself, and FUNCTIONS. They
compute or read, and do not call their arguments. A re-exported name (`usvlearn.estimators.rnn.layer.torch`) or an
attribute of a class is refused. Users can allow their own modules by `trust`. No module is imported before its name is
allowed.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Sequence
from types import FunctionType
from typing import Any

import usvlearn
from usvlearn.errors import CheckpointError, ConfigError

PACKAGES = ("usvlearn.estimators", "usvlearn.logs", "usvlearn.simulate")
FUNCTIONS = ("usvlearn.external", "usvlearn.logs.read.read_recordings", "usvlearn.simulate.fleet.fleet",
             "usvlearn.simulate.planar_fleet.planar_fleet")  # fmt: skip
DEEPEST = 50  # levels of settings


def check_settings(where: str, settings: Any, trust: str | Sequence[str] | None = None) -> None:
    """Raise an error unless settings are plain data, and each `_target_` is allowed or of a module in `trust`."""
    trusted = [trust] if isinstance(trust, str) else list(trust or ())
    for module in trusted:
        if not (isinstance(module, str) and all(part.isidentifier() for part in module.split("."))):
            raise ConfigError(f"trust: found {module!r}, expected the name of a module, such as boats.estimators")
    for keys, value in _leaves(where, settings):
        if keys and keys[-1] == "_target_":
            if not _allowed(value, trusted):
                raise CheckpointError(
                    f"{where}: {_path(keys)}: found {_short(value)}, expected a class below {', '.join(PACKAGES[:-1])} "
                    f"or {PACKAGES[-1]}: if you know that module and trust its code, add trust=MODULE"
                )
        elif any(isinstance(each, str) and ("${" in each or each == "???") for each in (*keys, value)):
            raise CheckpointError(
                f"{where}: {_path(keys)}: found {_short(value)}, expected plain data without interpolations: "
                "make the run anew with train.py"
            )


def check_setting(where: str, setting: Any) -> dict[str, float]:
    """Return a tuned setting if it has only finite numbers by dotted paths, so that it cannot name code."""
    if not isinstance(setting, dict):
        raise ConfigError(f"{where}: found the setting {_short(setting)}, expected numbers by name: remove that file")
    for path, value in setting.items():
        named = all(part.isidentifier() and not part.startswith("_") for part in path.split("."))
        if not (named and type(value) in (int, float) and math.isfinite(value)):
            raise ConfigError(
                f"{where}: found the setting {_short(path)}: {_short(value)}, expected a hyperparameter and a finite "
                "number: remove that file"
            )
    return setting


def _leaves(where: str, settings: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The keys and the value of each scalar, and of anything given as a `_target_`."""
    waiting: list[tuple[tuple[str, ...], Any]] = [((), settings)]
    while waiting:
        keys, value = waiting.pop()
        if len(keys) > DEEPEST:
            raise CheckpointError(f"{where}: {_path(keys)}: found more than {DEEPEST} levels: make the run anew")
        if keys[-1:] == ("_target_",) or not isinstance(value, dict | list):
            yield keys, value
        else:
            items = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [((*keys, str(key)), each) for key, each in items]


def _allowed(target: Any, trusted: Sequence[str]) -> bool:
    """Whether a target is a class of usvlearn, one of FUNCTIONS, or defined by a trusted module."""
    if not isinstance(target, str) or not all(part.isidentifier() for part in target.split(".")):
        return False
    module, _, name = target.rpartition(".")
    if module == "usvlearn":  # its public names
        return target in FUNCTIONS or (name in usvlearn.__all__ and isinstance(getattr(usvlearn, name), type))
    own, theirs = _within(module, PACKAGES) and "._" not in target, _within(module, trusted)
    if not (own or theirs):
        return False
    try:
        value = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        if theirs:
            raise ConfigError(f"trust: {module} cannot be imported ({error}): add its folder to PYTHONPATH") from error
        return False
    if not isinstance(value, type | FunctionType):
        return False
    if theirs and _within(value.__module__, trusted):
        return True
    ours = isinstance(value, type) or target in FUNCTIONS
    return own and ours and (value.__module__, value.__qualname__) == (module, name)


def _within(module: str, packages: Sequence[str]) -> bool:
    return any(module == each or module.startswith(f"{each}.") for each in packages)


def _path(keys: Sequence[str]) -> str:
    """A dotted path, shortened and escaped so that it prints on one line."""
    path = ".".join(keys)
    return path if path.isprintable() and len(path) <= 80 else _short(path)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
