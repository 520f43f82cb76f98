"""One key, `seed`, for all that is drawn: it is added to every seed of the data, the estimators and the tuning.

`seed=0` changes nothing. `seeds=5` in a command makes `seed` an axis of its sweep: 0, 1, 2, 3, 4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from usvlearn.errors import ConfigError

SEED, SEEDS = "seed", "seeds"
MOST = 1000


def seeded(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration in which `seed` is added to every seed of the data, the estimators and the tuning."""
    seed = configuration.get(SEED, 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ConfigError(f"seed: found {seed!r}, expected a whole number, 0 or more")

    def added(node: Any) -> Any:
        if not isinstance(node, Mapping):
            return node
        return {
            key: value + seed if key == SEED and type(value) is int else added(value) for key, value in node.items()
        }

    parts = {name: added(configuration[name]) for name in ("data", "estimators", "tuning")}
    return {**configuration, **parts, SEED: 0}


def with_seeds(arguments: Sequence[str]) -> list[str]:
    """A command line in which `seeds=N` is a sweep over N seeds."""
    rest, several = [], False
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if key.lstrip("+") == SEEDS and equals:
            if not value.isdecimal() or not 1 <= int(value) <= MOST:
                raise ConfigError(f"seeds: found {value!r}, expected a whole number from 1 to {MOST}")
            argument, several = f"{SEED}=range({int(value)})", True
        rest.append(argument)
    if not several:
        return rest
    if sum(each.partition("=")[0].lstrip("+") == SEED for each in rest) > 1:
        raise ConfigError("seeds: found seed=… too, expected one of them: seeds=N stands for seed=0,1, … N-1")
    return rest if {"-m", "--multirun"} & set(rest) else ["-m", *rest]
