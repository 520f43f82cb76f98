"""Thrust and drag that change from mission to mission, as a boat fouls, wears, or carries another load.

Equation (1): `docs/theory/identification.md#batch-fit-wear`; g and H are ∇L and Φ there, δ is υ, and B = ∂θ/∂δ. The
parameters are those of the last stretch.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.model.fit.gauss_newton import Fit, Missions, legal
from usvlearn.model.fit.terms import NAMES

WALK = 0.005  # of thrust and drag, from a stretch to the next


def worn(missions: Missions, fit: Fit, deviation: float) -> tuple[Fit, np.ndarray]:
    """The fit of the boat in its last stretch, and the loss of each piece, its stretch left out, a measured step.

    `fit` is without wear, to missions in the order in which they were sailed.
    """
    of, m, known = missions.stretches, len(fit.known.active), fit.known
    count, pieces = len(set(of)), len(of)
    g, H = np.zeros((count, m)), np.zeros((count, m, m))
    np.add.at(g, of, fit.score)
    np.add.at(H, of, fit.information)
    B = columns(fit)
    HB = H @ B  # (stretches, m, 3)
    parts = [slice(m + 3 * k, m + 3 * (k + 1)) for k in range(count - 1)]  # of δ; that of the last stretch is 0
    K, right = np.zeros((m + 3 * (count - 1),) * 2), np.zeros(m + 3 * (count - 1))
    apart = (np.eye(count)[1:] - np.eye(count)[:-1])[:, :-1]
    K[m:, m:] = np.kron(apart.T @ apart, np.eye(3)) / WALK**2
    K[:m, :m] = known.information + fit.information.sum(0)
    right[:m] = -known.information @ (fit.theta - known.mean)[known.active] - fit.score.sum(0)
    for k, part in enumerate(parts):
        K[:m, part], K[part, :m] = HB[k], HB[k].T
        K[part, part] += B.T @ HB[k]
        right[part] -= B.T @ g[k]
    C = np.linalg.inv(K)
    z, covariance = C @ right, C[:m, :m]
    losses, score, by_mission = np.zeros(pieces), fit.score.copy(), np.tile(fit.theta, (pieces, 1))
    for k in range(count):
        away, spread = z[:m].copy(), covariance.copy()  # e_k of (1), and its covariance
        if k < count - 1:
            across = C[:m, parts[k]] @ B.T
            away += B @ z[parts[k]]
            spread += across + across.T + B @ C[parts[k], parts[k]] @ B.T
        unseen = np.eye(m) - spread @ H[k]  # what is left without stretch k, (1) solved again
        theta = fit.theta.copy()
        theta[known.active] += np.linalg.solve(unseen, away + spread @ g[k])
        theta = legal(theta, known, covariance)
        for j in np.flatnonzero(of == k).tolist():
            score[j] += fit.information[j] @ away
            by_mission[j, known.active] += away
            by_mission[j] = legal(by_mission[j], known, covariance)
            losses[j] = missions.loss(theta, deviation, j)
    theta = fit.theta.copy()
    theta[known.active] += z[:m]
    said = (np.linalg.inv(covariance) - known.information) / pieces  # by all, of the last stretch's boat
    adapted = replace(
        fit,
        theta=legal(theta, known, covariance),
        score=score,
        information=np.tile(said, (pieces, 1, 1)),
        by_mission=by_mission,
    )
    return adapted, losses / np.maximum(missions.steps, 1)


def columns(fit: Fit) -> np.ndarray:
    """B of (1), `(m, 3)`: the fitted parameters of the thrust of each side and of the drag; 0 elsewhere."""
    names = [NAMES[place] for place in fit.known.active]
    kinds = [[name.startswith("thrust_") and f"_{side}" in name for name in names] for side in SIDES]
    kinds.append([name.startswith("drag_") for name in names])
    matrix: np.ndarray = (np.array(kinds) * fit.theta[fit.known.active]).T
    return matrix
