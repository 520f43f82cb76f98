"""Tuning numbers of one estimator; what is here imports nothing heavy, because a replay asks, too."""

from collections.abc import Mapping
from typing import Any

from usvlearn.errors import ConfigError

WAYS = ("grid", "learn", "search")


def asked(configuration: Mapping[str, Any]) -> str | None:
    """The method that a configuration asks for, or None."""
    if "study" in configuration:
        raise ConfigError("experiment: found a study, expected settings: run `python evaluate.py experiment=…`")
    ways = [way for way in WAYS if configuration.get(way) is not None]
    if len(ways) > 1:
        raise ConfigError(f"{' and '.join(ways)}: found {len(ways)} ways to tune, expected one: leave out the others")
    return ways[0] if ways else None
