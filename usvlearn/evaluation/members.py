"""Facts about the members of an ensemble, without their wrappers."""

from __future__ import annotations

from typing import Any

from usvlearn.estimators.ensemble.combiners.layer import Average
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.regressors.layer import QuasiStatic, SurgeDynamics
from usvlearn.evaluation.metrics import PERSISTENCE


def unwrapped(estimator: Any, state: Any = None) -> tuple[Any, Any]:
    """The innermost estimator, without wrappers, and its state."""
    while hasattr(estimator, "estimator"):
        estimator, state = estimator.estimator, getattr(state, "inner", state)
    return estimator, state


def physical_members(ensemble: Ensemble) -> list[str]:
    """The members that identify the surge dynamics without further terms."""
    found = []
    for name, member in ensemble.members.items():
        model = getattr(unwrapped(member)[0], "model", None)
        if isinstance(model, SurgeDynamics) and not model.cubic:
            found.append(name)
    return found


def remarks(ensemble: Ensemble) -> dict[str, str]:
    """Remarks beside names in a table of errors: the baseline, a quasi-static map, an average that includes one.

    >>> from usvlearn import RLS, Persistence
    >>> remarks(Ensemble({"map": RLS(), "persistence": Persistence()}))
    {'persistence': 'baseline', 'map': 'quasi-static map', 'average': 'with map'}
    """
    found = {PERSISTENCE: "baseline"} if PERSISTENCE in ensemble.names else {}
    found |= dict.fromkeys(_maps(ensemble), "quasi-static map")
    return found | {rule: f"with {', '.join(maps)}" for rule, maps in _averages(ensemble).items()}


def explained(ensemble: Ensemble) -> list[str]:
    """A sentence about the quasi-static maps, if there are any."""
    if not (maps := _maps(ensemble)):
        return []
    shared = f" Averages with this error: {', '.join(rules)}." if (rules := _averages(ensemble)) else ""
    return [
        f"{', '.join(maps)}: a quasi-static map, which predicts the speed from the commands, the heading and the yaw "
        f"rate, and does not use the present speed.{shared}"
    ]


def _maps(ensemble: Ensemble) -> list[str]:
    """The members that are quasi-static maps."""
    models = {name: getattr(unwrapped(member)[0], "model", None) for name, member in ensemble.members.items()}
    return [name for name, model in models.items() if isinstance(model, QuasiStatic)]


def _averages(ensemble: Ensemble) -> dict[str, list[str]]:
    """The plain averages that include quasi-static maps, each with the names of these maps."""
    found = {}
    for name, rule in ensemble.combiners.items():
        if isinstance(rule, Average):
            chosen = set(ensemble.members if rule.members is None else rule.members)
            found[name] = [each for each in _maps(ensemble) if each in chosen]
    return {name: maps for name, maps in found.items() if maps}
