"""Writes a batch fit into a checkpoint, from which the joint EKFs go on.

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
    copied = {name: np.array(leaf) for name, leaf in leaves.items()}
    for name, member in members_of(description).items():
        if member is not None and member.get("kind") == "joint":
            prefix = f"members.{name}." if name else ""
            keys = {key: prefix + key for key in ("mean", "factor", "reading", "spread", "readings", "weight")}
            m = len(copied[keys["mean"]]) - THETA
            theta, covariance = _parameters(fitted, m == len(names(even=True)), dt, member)
            mean, P = copied[keys["mean"]].copy(), covariance_of(copied[keys["factor"]])
            mean[THETA:] = theta
            P[THETA:], P[:, THETA:] = 0.0, 0.0
            P[THETA:, THETA:] = covariance
            new = {
                "mean": mean,
                "factor": factored(P),
                "reading": theta,
                "spread": covariance,
                "readings": max(float(copied[keys["readings"]]), DROPPED + 1),
                "weight": max(float(copied[keys["weight"]]), 1.0),
            }
            new |= _without_trial(copied, prefix, new)
            for key, value in new.items():
                old = copied[prefix + key]
                copied[prefix + key] = np.broadcast_to(np.asarray(value, old.dtype), old.shape).copy()
    return copied, {FITTED: fitted.identified.facts()}


def _parameters(fitted: Fitted, even: bool, dt: float, member: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """θ and its covariance as a joint EKF has them; what no fitted set has is as the prior."""
    fit = next(fitted.fits[name] for name in POLYNOMIAL if name in fitted.fits and (even or name != "even"))
    if fitted.chosen.endswith(WEAR):  # the boat of the last mission, with these terms
        fit, _ = worn(fitted.missions, fit, fit.deviation)
    wanted, places = names(even), {int(place): k for k, place in enumerate(fit.known.active)}
    scale = np.array([DT / dt if name == LAG else 1.0 for name in wanted])
    late = (fitted.identified.late + fit.theta[PLACE_TIME]) / DT
    theta = np.array([fit.theta[AT[name]] + (late if name == LAG else 0.0) for name in wanted]) * scale
    theta[-1] = np.clip(theta[-1], LAG_LEAST, LAG_MOST)
    covariance = np.diag(np.asarray(member["vectors"]["variance"], float))
    there = [k for k, name in enumerate(wanted) if AT[name] in places]
    some = [places[AT[wanted[k]]] for k in there]
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
    empty = {
        "mean": new["mean"], "factor": new["factor"], "noise": noise, "updates": updates,
        "kept": new["reading"], "before": new["reading"],
        "past_mean": new["mean"], "past_factor": new["factor"], "past_noise": noise, **none,
    }  # fmt: skip
    return {f"trial.{key}": value for key, value in empty.items()}


def factored(P: np.ndarray) -> np.ndarray:
    """The leaf `factor` of a covariance, `(n, n)`."""
    rest, n = np.array(P, float), len(P)
    factor = np.zeros((n, n))
    for j in range(n - 1, -1, -1):
        factor[j, j] = max(rest[j, j], 0.0)
        if factor[j, j] > 0:
            factor[j, :j] = rest[:j, j] / factor[j, j]
            rest[:j, :j] -= factor[j, j] * np.outer(factor[j, :j], factor[j, :j])
    return factor


def write(folder: Path, fitted: Fitted, last: Last | None, dt: float) -> list[Path]:
    """Write the files of a boat, whose checkpoint has steps of `dt`, s; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{fitted.boat}.fit.json"
    text = json.dumps(fitted.json(), indent=1, ensure_ascii=False, allow_nan=False)
    checkpoint.write_atomically(path, f"{text}\n".encode())
    if last is None:
        return [path]
    leaves, more = handed_over(last.leaves, last.facts["kernel"], fitted, dt)
    facts = {key: value for key, value in last.facts.items() if key != "schema"} | more
    file = folder / CHECKPOINTS / fitted.boat / f"fit{checkpoint.SUFFIX}"
    return [path, checkpoint.save(file, leaves, **facts)]


def table_of(fitted: Fitted) -> list[float]:
    """The chosen fit as a member of forecasts has it (`ensemble.forecasts.fit_kernel`)."""
    theta, boat, table = fitted.fit.theta, CurvedAhead(fitted.fit.theta, fitted.fit.top), np.zeros(at.TABLE)
    far = FARTHEST * fitted.fit.top
    speeds, commands = np.linspace(-far, far, at.SPEEDS), np.linspace(-LARGEST, LARGEST, at.COMMANDS)
    table[at.SPEED], table[at.CROSS], table[at.COMMAND] = far, theta[AT["drag_cross"]], LARGEST
    table[at.LATE] = DT * theta[AT[LAG]] + theta[AT[TIME_CONSTANT]] + fitted.identified.late
    for k, side in enumerate(SIDES):
        table[at.MORE + 2 * k : at.MORE + 2 * k + 2] = theta[[AT[f"thrust_{x}speed_{side}"] for x in ("", "even_")]]
        table[at.THRUST + k * at.COMMANDS :][: at.COMMANDS] = boat.thrust(commands, side)
    astern = 2 * theta[AT["drag_even"]] * speeds * np.minimum(speeds, 0.0)  # `drag` is that ahead
    table[at.DRAG :] = -np.sign(speeds) * boat.drag(np.abs(speeds)) + astern
    return table.tolist()
