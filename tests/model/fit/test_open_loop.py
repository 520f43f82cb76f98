"""Open-loop simulations by a fit are those of its model, and the better simulation is used."""

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, boat, mission, simulated
from usvlearn.core.prepared_samples import COS, DT, HOLD, LEARN, LEFT, MODE, RIGHT, SIN, SURGE, YAW_RATE
from usvlearn.core.samples import Fleet, Inputs, Run, Sample
from usvlearn.model.fit import logs
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.open_loop import ENSEMBLE, FIT, NOTHING, decide, open_loop
from usvlearn.model.surge import SurgeModel


def test_it_is_the_simulation_of_the_model_carried_by_the_current():
    theta, current, rows = boat(), np.array([0.3, -0.2]), mission(300)
    fit = Missions([rows], TOP).evaluate("curves, even", theta, 0.02)
    along = rows[:, [COS, SIN]] @ current
    rows[0, SURGE] = 0.4 + along[1]
    rows[1:, MODE], rows[1:, SURGE] = LEARN, 99.0  # measured speeds are not used
    steps = rows[1:]
    expected = SurgeModel.fitted(theta, TOP, MASS).simulate(
        0.4, steps[:, LEFT], steps[:, RIGHT], steps[:, YAW_RATE], steps[:, DT]
    )
    speed = open_loop(fit, rows, current)
    np.testing.assert_allclose(speed[1:], expected + along[1:], rtol=1e-6, atol=1e-6)
    assert speed[0] == pytest.approx(0.4 + along[1])
    rows[100:120, MODE] = HOLD
    held = open_loop(fit, rows, current)
    assert np.isfinite(held).all() and np.ptp(held[100:120]) == 0


def season(noise: float, count: int = 10) -> Fleet:
    """Missions of a boat on the grid of the fit, whose speeds `noise` disturbs."""
    runs, theta = [], boat()
    for k in range(count):
        rows = mission(900, seed=k, dt=logs.DT)
        speed = simulated(rows, theta) + 0.01 * np.random.default_rng(k).standard_normal(len(rows))
        speed[0] = rows[0, SURGE]
        heading, dt = np.arctan2(rows[:, SIN], rows[:, COS]), np.append(0.0, rows[1:, DT])
        speed += noise * np.sin(np.arange(len(rows)) / 40)
        inputs = Inputs(rows[:, LEFT], rows[:, RIGHT], heading, rows[:, YAW_RATE], dt)
        good = np.ones(len(rows), bool)
        sample = Sample(inputs, speed, good, good)
        wide = Sample(Inputs(*(x[:, None] for x in sample.inputs)), *(x[:, None] for x in sample[1:]))
        runs.append(Run(np.cumsum(dt)[:, None], wide, (f"{k}.csv",), (len(rows),)))
    return Fleet(("heron",), tuple(runs), {})


def test_the_fit_is_used_where_it_errs_less_on_missions_that_it_has_not_learned():
    fleet = season(0.0)
    theirs = {f"{k}.csv": 0.2 for k in range(5, 10)}
    mode = decide("heron", "cubic", TOP, fleet, fleet, 5, theirs)
    assert mode.used == FIT and mode.missions == 5 and mode.fit < 0.1 and mode.ensemble == pytest.approx(0.2)
    assert (
        "use the fit's: the fit errs by" in mode.sentence and "on 5 missions that neither had learned" in mode.sentence
    )
    better = decide("heron", "cubic", TOP, fleet, fleet, 5, {name: mode.fit / 2 for name in theirs})
    assert better.used == ENSEMBLE and better.gain < 0
    assert decide("heron", "cubic", TOP, fleet, fleet, 8, theirs).used == ENSEMBLE  # two missions decide nothing
    assert decide("heron", "cubic", TOP, fleet, fleet, 0, theirs) == NOTHING  # nothing to learn from
    assert decide("heron", "cubic", TOP, fleet, fleet, 5, {}) == NOTHING and "no mission was left" in NOTHING.sentence
