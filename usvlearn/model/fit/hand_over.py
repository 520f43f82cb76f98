"""A checkpoint in which the joint EKFs go on from a batch fit.

An ensemble that has learned online keeps everything else: other members, intervals, noise, current. Its joint EKFs get
the parameters and the covariance of the fitted set whose terms are theirs, and no trial. A periodic mean becomes the
fit, too. The lag is a share of a step, and scales with the length of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.engine.identified import identified, members_of
from usvlearn.engine.validate import read_checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.augmented_ekf.state import LAG_LEAST, LAG_MOST
from usvlearn.estimators.ensemble.forecasts import state as at
from usvlearn.estimators.joint.periodic_estimates import Identified, covariance_of
from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.estimators.joint.state import DROPPED, THETA, names
from usvlearn.estimators.regressors.terms import LAG
from usvlearn.live.diagnostics import surge_alone
from usvlearn.model.fit.boat import FITTED
from usvlearn.model.fit.choice import WEAR
from usvlearn.model.fit.fitted import Fitted
from usvlearn.model.fit.intervals import spread
from usvlearn.model.fit.logs import DT
from usvlearn.model.fit.quantities import CurvedAhead
from usvlearn.model.fit.terms import AT, PLACE_TIME, TIME_CONSTANT
from usvlearn.model.fit.wear import worn
from usvlearn.runs.files import CHECKPOINTS

LARGEST, FARTHEST = 1.25, 1.5  # command, and top speeds, to which the tables of a member go
POLYNOMIAL = ("even", "cubic", "nine")  # sets whose terms a joint EKF has, from the largest


class Last(NamedTuple):
    """What a run has learned of a boat."""

    leaves: dict[str, np.ndarray]
    facts: dict[str, Any]
    online: Identified | None  # None: it identifies nothing


def last_of(folder: Path) -> Last | None:
    """The newest readable checkpoint of a boat in a folder; None without one."""
    try:
        leaves, facts = surge_alone(*checkpoint.newest(folder, read_checkpoint))
    except CheckpointError:
        return None
    try:
        (online,) = identified(facts["kernel"], {name: leaf[None] for name, leaf in leaves.items()})
    except ConfigError:
        return Last(leaves, facts, None)
    return Last(leaves, facts, online)


def handed_over(
    leaves: Mapping[str, np.ndarray], description: Mapping[str, Any], fitted: Fitted, dt: float
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The leaves of a boat's state with the fit in its joint EKFs, and what the checkpoint's metadata say of the fit.

    `leaves` are without batch axes, `description` is of the ensemble, whose samples are `dt` s apart.
    """
    found = {name: np.array(leaf) for name, leaf in leaves.items()}
    for name, member in members_of(description).items():
        if member is not None and member.get("kind") == "joint":
            prefix = f"members.{name}." if name else ""
            own = {key: prefix + key for key in ("mean", "factor", "reading", "spread", "readings", "weight")}
            m = len(found[own["mean"]]) - THETA
            theta, covariance = _parameters(fitted, m == len(names(even=True)), dt, member)
            mean, P = found[own["mean"]].copy(), covariance_of(found[own["factor"]])
            mean[THETA:] = theta
            P[THETA:], P[:, THETA:] = 0.0, 0.0
            P[THETA:, THETA:] = covariance
            new = {
                "mean": mean,
                "factor": factored(P),
                "reading": theta,
                "spread": covariance,
                "readings": max(float(found[own["readings"]]), DROPPED + 1),
                "weight": max(float(found[own["weight"]]), 1.0),
            }
            new |= _without_trial(found, prefix, new)
            for key, value in new.items():
                old = found[prefix + key]
                found[prefix + key] = np.broadcast_to(np.asarray(value, old.dtype), old.shape).copy()
    return found, {FITTED: fitted.found.facts()}


def _parameters(fitted: Fitted, even: bool, dt: float, member: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """θ and its covariance as a joint EKF has them; what no fitted set has is as the prior."""
    fit = next(fitted.fits[name] for name in POLYNOMIAL if name in fitted.fits and (even or name != "even"))
    if fitted.chosen.endswith(WEAR):  # the boat of the last mission, with these terms
        fit, _ = worn(fitted.missions, fit, fit.deviation)
    own, places = names(even), {int(place): k for k, place in enumerate(fit.known.active)}
    scale = np.array([DT / dt if name == LAG else 1.0 for name in own])
    late = (fitted.found.late + fit.theta[PLACE_TIME]) / DT
    theta = np.array([fit.theta[AT[name]] + (late if name == LAG else 0.0) for name in own]) * scale
    theta[-1] = np.clip(theta[-1], LAG_LEAST, LAG_MOST)
    covariance = np.diag(np.asarray(member["vectors"]["variance"], float))
    there = [k for k, name in enumerate(own) if AT[name] in places]
    some = [places[AT[own[k]]] for k in there]
    covariance[np.ix_(there, there)] = spread(fit)[np.ix_(some, some)] * np.outer(scale[there], scale[there])
    return theta, covariance


def _without_trial(leaves: Mapping[str, np.ndarray], prefix: str, new: Mapping[str, Any]) -> dict[str, Any]:
    """The leaves of a trial that has not begun, {} for a filter without trials."""
    if f"{prefix}trial.mean" not in leaves:
        return {}
    noise, updates = leaves[f"{prefix}noise"], leaves[f"{prefix}updates"]
    none = dict.fromkeys(
        ("statistic", "last", "usual", "evidence", "best", "run", "tried", "leads", "early"), 0.0
    )  # fmt: skip
    found = {
        "mean": new["mean"], "factor": new["factor"], "noise": noise, "updates": updates,
        "kept": new["reading"], "before": new["reading"],
        "past_mean": new["mean"], "past_factor": new["factor"], "past_noise": noise, **none,
    }  # fmt: skip
    return {f"trial.{key}": value for key, value in found.items()}


def factored(P: np.ndarray) -> np.ndarray:
    """The leaf `factor` of a covariance, `(n, n)`."""
    rest, n = np.array(P, float), len(P)
    found = np.zeros((n, n))
    for j in range(n - 1, -1, -1):
        found[j, j] = max(rest[j, j], 0.0)
        if found[j, j] > 0:
            found[j, :j] = rest[:j, j] / found[j, j]
            rest[:j, :j] -= found[j, j] * np.outer(found[j, :j], found[j, :j])
    return found


def write(folder: Path, found: Fitted, last: Last | None, dt: float) -> list[Path]:
    """Write the files of a boat, whose checkpoint has steps of `dt`, s; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{found.boat}.fit.json"
    text = json.dumps(found.json(), indent=1, ensure_ascii=False, allow_nan=False)
    checkpoint.write_atomically(path, f"{text}\n".encode())
    if last is None:
        return [path]
    leaves, own = handed_over(last.leaves, last.facts["kernel"], found, dt)
    facts = {key: value for key, value in last.facts.items() if key != "schema"} | own
    file = folder / CHECKPOINTS / found.boat / f"fit{checkpoint.SUFFIX}"
    return [path, checkpoint.save(file, leaves, **facts)]


def table_of(fitted: Fitted) -> list[float]:
    """The chosen fit as a member of forecasts has it (`ensemble.forecasts.fit_kernel`)."""
    theta, boat, found = fitted.fit.theta, CurvedAhead(fitted.fit.theta, fitted.fit.top), np.zeros(at.TABLE)
    far = FARTHEST * fitted.fit.top
    speeds, commands = np.linspace(-far, far, at.SPEEDS), np.linspace(-LARGEST, LARGEST, at.COMMANDS)
    found[at.SPEED], found[at.CROSS], found[at.COMMAND] = far, theta[AT["drag_cross"]], LARGEST
    found[at.LATE] = DT * theta[AT[LAG]] + theta[AT[TIME_CONSTANT]] + fitted.found.late
    for k, side in enumerate(SIDES):
        found[at.MORE + 2 * k : at.MORE + 2 * k + 2] = theta[[AT[f"thrust_{x}speed_{side}"] for x in ("", "even_")]]
        found[at.THRUST + k * at.COMMANDS :][: at.COMMANDS] = boat.thrust(commands, side)
    astern = 2 * theta[AT["drag_even"]] * speeds * np.minimum(speeds, 0.0)  # `drag` is that ahead
    found[at.DRAG :] = -np.sign(speeds) * boat.drag(np.abs(speeds)) + astern
    return found.tolist()
