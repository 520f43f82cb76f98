"""Reports of the node about its estimators, beside predictions: thrusters, networks, identified quantities."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.events import EventWatch
from usvlearn.engine.online import Online
from usvlearn.estimators.ensemble.forecasts.state import FIT
from usvlearn.estimators.ensemble.monitors.state import EXPLAINED

PLANAR = "planar"  # kind of the description of a `Planar`, and the folder of a run that holds its checkpoints


def surge_of(online: Online) -> tuple[Mapping[str, Any], str]:
    """The description of what predicts the surge, and what the names of its leaves begin with."""
    described = online.description or {}
    return (described["surge"], "surge.") if described.get("kind") == PLANAR else (described, "")


def fit_of(description: Any) -> tuple[float, ...]:
    """The table of the batch fit that forecasts, too, of an estimator; () without."""
    forecasts = description.get("surge", description).get("forecasts") or {}
    return tuple(forecasts.get(FIT, {}).get("table", ()))


def surge_alone(leaves: Mapping[str, Any], facts: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Leaves and metadata of a checkpoint; of one that makes tracks, those of its surge."""
    if facts["kernel"]["kind"] != PLANAR:
        return dict(leaves), dict(facts)
    surge = {name.removeprefix("surge."): each for name, each in leaves.items() if name.startswith("surge.")}
    return surge, {**facts, "estimator": "Ensemble", "kernel": facts["kernel"]["surge"]}


def event_watch(description: Mapping[str, Any]) -> EventWatch | None:
    """What finds the events, as `evaluation.diagnostics` does for a run; None if nobody watches the thrusters."""
    if description.get("monitors") is None:
        return None
    given = description.get("accommodation")  # what the monitor finds, to these filters
    return EventWatch([description["columns"][column] for column in given["members"]] if given else [])


def event_row(online: Online, filters: Sequence[str]) -> np.ndarray:
    """The numbers that `EventWatch` reads, now."""
    begin = surge_of(online)[1]
    names = "raised", "share", "deviation"
    raised, share, deviation = (online.leaf(f"{begin}monitors.thrusters.{name}") for name in names)
    share, handed = np.where(raised > 0, share, 1.0), np.zeros(2)
    if filters:
        share, deviation, handed = (
            online.leaf(f"{begin}accommodation.{name}") for name in ("share", "deviation", "handed")
        )
    changes = [np.atleast_1d(online.leaf(f"{begin}members.{name}.trial.changes")) for name in filters]
    return np.concatenate([share, deviation, raised, handed, *changes])


def unexplained(online: Online) -> str:
    """Why the yaw rate tells nothing of the thrusters; "" if it does, or if nobody watches them."""
    own, begin = surge_of(online)
    if own.get("monitors") is None:
        return ""
    error, made = online.leaf(f"{begin}monitors.thrusters.explained")
    if made == 0 or 1 - error / made >= EXPLAINED:
        return ""
    return (
        f"commands explain {max(100 * (1 - error / made), 0):.0f} % of the turns in the last minutes: a loss of thrust "
        "is sought by the speed alone"
    )


def identified(online: Online, one_command: bool = False) -> tuple[dict[str, tuple[float, float, float, str]], str]:
    """Value, ends of the 90 % interval and unit of each identified quantity; {} without a reader. And a sentence if no
    boat can have them, else "".

    NaN while an interval says nothing. With one command for both sides, what tells them apart is left out.
    """
    from usvlearn.engine.identified import members_of
    from usvlearn.estimators.joint.periodic_estimates import reader_of, tells_sides

    if online.description is None or reader_of(members_of(surge_of(online)[0])) is None:
        return {}, ""
    quantities: Any = online.identified()
    names = [name for name in quantities if not (one_command and tells_sides(name))]
    return {name: tuple(quantities.displayed(name)) for name in names}, quantities.unphysical


def networks(online: Online) -> dict[str, dict[str, Any]]:
    """Whether each network is certified contracting, by which condition, its rate, and its equilibrium at rest.

    The rate K is that of a step, rounded so that the verdict stays true; the time constant is −dt/ln K, s. The
    equilibrium is that without thrust at the last heading which is nearest to the speed, m/s. None where there is none.
    """
    from usvlearn.engine.identified import members_of

    if online.description is None:
        return {}
    surge, begin = surge_of(online)
    by_name = {}
    for name, description in members_of(surge).items():
        if description is not None and description["kind"] == "rnn":
            prefix = f"{begin}members.{name}." if name else begin
            by_name[name] = _network(online, prefix, description["numbers"]["scale"])
    return by_name


def _network(online: Online, prefix: str, scale: float) -> dict[str, Any]:
    from certify.networks.shallow import ShallowWeights
    from certify.proofs import exact
    from certify.proofs.equilibria import equilibria

    weights = ShallowWeights(*(np.asarray(online.leaf(f"{prefix}weights.{w}"), float) for w in ("a", "w1", "W2", "b")))
    verdict = exact.verdict(weights)
    if verdict is None:
        return {**exact.as_json(None), "time_constant": None, "equilibrium": None}
    rate, dt = verdict.bound, float(online.leaf(f"{prefix}dt"))
    constant = -dt / math.log(rate) if 0 < rate < 1 and dt > 0 else None
    u, speed = online.leaf(f"{prefix}inputs_before"), float(online.leaf(f"{prefix}surge"))
    places = equilibria(weights, [float(u[0]), float(u[1]), 0.0, 0.0], -1.0, 1.0)
    nearest = min((each.x / scale for each in places), key=lambda v: abs(v - speed), default=None)
    return {**exact.as_json(verdict), "time_constant": constant, "equilibrium": nearest}


def horizons(description: Mapping[str, Any]) -> tuple[float, ...]:
    """Of the forecasts of a described ensemble, s."""
    return tuple((description.get("forecasts") or {}).get("vectors", {}).get("horizons", ()))


def track_horizons(description: Mapping[str, Any]) -> tuple[float, ...]:
    """Of the tracks of a described `Planar`, s; () of another estimator."""
    return tuple(description["vectors"]["horizons"]) if description.get("kind") == PLANAR else ()
