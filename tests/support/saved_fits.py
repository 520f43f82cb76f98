"""Fits as `usvlearn fit` saves them, without a fit: the parameters that made the data."""

from functools import cache
from typing import Any

import numpy as np

from tests.support.fitted_boats import MASS, TOP, boat, mission, simulated
from usvlearn.core.prepared_samples import LEARN, MODE, SURGE
from usvlearn.model.fit.diagnostics import diagnostics
from usvlearn.model.fit.gauss_newton import Fit, Missions
from usvlearn.model.fit.open_loop import FreeMode
from usvlearn.model.fit.quantities import quantities
from usvlearn.model.fit.terms import NAMES, PLACE_LAG, prior


def missions(count: int = 3, noise: float = 0.05, terms: str = "cubic", steps: int = 2000) -> tuple[Missions, Fit]:
    """Missions with white noise, and their fit at the parameters that made them."""
    theta, known, rng = boat(5), prior(terms, TOP), np.random.default_rng(1)
    theta[np.setdiff1d(np.arange(len(NAMES)), known.active)] = 0.0
    theta[PLACE_LAG] = 0.2 * (PLACE_LAG in known.active)
    rows = []
    for seed in range(count):
        each = mission(steps, seed)
        each[1:, SURGE] = simulated(each, theta, terms)[1:] + noise * rng.standard_normal(steps)
        each[1:, MODE] = LEARN
        rows.append(each)
    sailed = Missions(rows, TOP)
    return sailed, sailed.evaluate(terms, theta, noise)


@cache
def facts() -> dict[str, Any]:
    """A file `BOAT.fit.json`; nobody changes it."""
    sailed, fit = missions()
    values = {name: float(value) for name, value in quantities(fit.theta, TOP, MASS).items()}
    score = {"parameters": 12, "gain": 0.0, "error": 0.0, "mae": 0.04}
    return {
        "boat": "heron1",
        "mass": MASS,
        "top": TOP,
        "terms": "cubic",
        "missions": len(sailed.rows),
        "steps": 6000,
        "deviation": fit.deviation,
        "parameters": {},
        "quantities": {
            name: {"value": x, "low": x - 0.1 * abs(x), "high": x + 0.1 * abs(x), "unit": "N"}
            for name, x in values.items()
        },
        "lacks": ["The thrusters hardly ever pushed astern."],
        "doubts": [],
        "simulation": FreeMode("fit", 3, 0.05, 0.06, 0.01, 0.002).json(),
        "sets": {"nine": score | {"gain": -0.5, "error": None}, "cubic": score},
        "diagnostics": diagnostics(sailed, fit, MASS),
    }
