"""Members of an ensemble that other code steps, made aboard as a run's settings say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from usvlearn.engine.parts import external_in
from usvlearn.errors import CheckpointError


def trusted_members(facts: Mapping[str, Any], trust: Sequence[str]) -> dict[str, Any]:
    """Such members of a checkpoint, by name, if modules are trusted: only they, and this package, are imported."""
    names, settings = external_in(facts["kernel"]) if trust else [], facts.get("configuration")
    known = settings.get("estimators") if isinstance(settings, dict) else None
    if lost := [name for name in names if not isinstance(known, dict) or name not in known]:
        raise CheckpointError(f"trust: the checkpoint does not say how {lost[0]} is made: start from that of a run")
    chosen = {name: known[name] for name in names} if isinstance(known, dict) else {}
    if chosen:  # by layers above this one
        import_module("usvlearn.runs.trust").check_settings("the checkpoint", chosen, list(trust))
        return import_module("usvlearn.composition.configuration").instantiate(chosen)
    return {}


def without(facts: Mapping[str, Any], members: Mapping[str, Any]) -> str:
    """What to say of those that are not made; or ""."""
    lost = [name for name in external_in(facts["kernel"]) if name not in members]
    return f"{', '.join(lost)} predicts nothing here: trust its module (--trust), if you do" if lost else ""
