"""A boat that wears: what is fitted is the boat of the last mission, and the missions choose."""

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, mission, simulated
from usvlearn.core.prepared_samples import LEARN, MODE, SURGE
from usvlearn.model.fit.choice import WEAR, choose
from usvlearn.model.fit.gauss_newton import Missions, legal
from usvlearn.model.fit.quantities import quantities
from usvlearn.model.fit.terms import AT, NAMES, TIME_CONSTANT, prior
from usvlearn.model.fit.wear import WALK, columns, worn

COUNT = 8


def season(wear: float) -> tuple[Missions, np.ndarray]:
    """Missions whose drag grows by a share of it from one to the next, and the parameters in the last one."""
    first, rows = prior("nine", TOP).mean, []
    for k in range(COUNT):
        theta = first.copy()
        theta[[AT["drag_quadratic"], AT["drag_linear"]]] *= 1 + wear * k
        one = mission(900, seed=k)
        one[1:, SURGE] = simulated(one, theta)[1:] + 0.01 * np.random.default_rng(k).standard_normal(900)
        one[1:, MODE] = LEARN
        rows.append(one)
    return Missions(rows, TOP), theta


def test_the_boat_of_the_last_mission_is_found():
    missions, last = season(0.015)
    fits = {"nine": missions.fit("nine")}
    chosen, scores = choose(missions, fits, wear=worn)
    assert chosen == f"nine{WEAR}" and scores["nine"].gain < -0.05 and fits[chosen].terms == "nine"
    assert len(Missions(missions.rows[:2], TOP).simulate(fits[chosen])) == 2  # others, by the boat of the last one
    true = quantities(last, TOP, MASS)
    plain, found = (quantities(fits[name].theta, TOP, MASS) for name in ("nine", chosen))
    for name, least in (("drag_half_speed", 0.01), ("steady_speed_full", 0.015)):
        assert abs(plain[name] / true[name] - 1) > least and found[name] == pytest.approx(true[name], rel=0.005), name


def test_a_boat_that_does_not_wear_keeps_the_plain_fit():
    missions, _ = season(0.0)
    fits = {"nine": missions.fit("nine")}
    assert choose(missions, fits, wear=worn)[0] == "nine"
    np.testing.assert_allclose(fits[f"nine{WEAR}"].theta, fits["nine"].theta, rtol=0.1, atol=0.02)
    assert np.trace(fits[f"nine{WEAR}"].covariance) > np.trace(fits["nine"].covariance)


def test_the_loss_of_a_mission_left_out_is_that_of_all_others_solved_again():
    """(1), written out with dense matrices and one mission left out."""
    missions, _ = season(0.02)
    fit = missions.fit("nine")
    m, k, B = len(fit.known.active), 3, columns(fit)
    size = m + 3 * COUNT  # here the last δ is there, and held at 0 by a large weight
    K, right = np.zeros((size, size)), np.zeros(size)
    K[:m, :m] = fit.known.information
    right[:m] = -fit.known.information @ (fit.theta - fit.known.mean)[fit.known.active]
    maps = []
    for j in range(COUNT):
        e = np.zeros((m, size))
        e[:, :m], e[:, m + 3 * j : m + 3 * j + 3] = np.eye(m), B
        maps.append(e)
        if j != k:
            K += e.T @ fit.information[j] @ e
            right -= e.T @ fit.score[j]
        if j:
            step = np.zeros((3, size))
            step[:, m + 3 * j : m + 3 * j + 3], step[:, m + 3 * j - 3 : m + 3 * j] = np.eye(3), -np.eye(3)
            K += step.T @ step / WALK**2
    K[-3:, -3:] += 1e12 * np.eye(3)
    theta = fit.theta.copy()
    theta[fit.known.active] += maps[k] @ np.linalg.solve(K, right)
    last, losses = worn(missions, fit, fit.deviation)
    theta = legal(theta, fit.known, last.covariance)
    assert losses[k] == pytest.approx(missions.loss(theta, fit.deviation, k) / missions.steps[k], rel=1e-6)


def test_each_side_and_the_drag_have_a_column():
    missions, _ = season(0.0)
    fit = missions.fit("nine")
    B, names = columns(fit), [NAMES[place] for place in fit.known.active]
    for name, row in zip(names, B, strict=True):
        column = 2 if name.startswith("drag") else 0 if name.endswith("left") else 1
        assert row[column] == fit.theta[AT[name]] * (name != TIME_CONSTANT) and not np.delete(row, column).any()
