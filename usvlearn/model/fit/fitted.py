"""The batch fit of one boat: all sets of terms, the one to use, and its quantities with intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.estimators.joint.lacking import Quantity
from usvlearn.model.fit.choice import Score, choose
from usvlearn.model.fit.gauss_newton import Fit, Missions
from usvlearn.model.fit.intervals import intervals
from usvlearn.model.fit.terms import NAMES, SETS


@dataclass(frozen=True)
class Fitted:
    """A fitted boat.

    Attributes:
        boat: its name.
        mass: kg.
        fits: of all sets of terms, by name.
        scores: of the same, on missions that they have not learned.
        chosen: the set to use.
        quantities: of the chosen set, with 90 % intervals.
        errors: mean |error| of the simulation of each set over the logs, m/s.
    """

    boat: str
    mass: float
    fits: dict[str, Fit]
    scores: dict[str, Score]
    chosen: str
    quantities: dict[str, Quantity]
    errors: dict[str, float]

    @property
    def fit(self) -> Fit:
        """The fit with the chosen set."""
        return self.fits[self.chosen]

    def json(self) -> dict[str, Any]:
        """What is saved: JSON values; parameters are in units of force, times the mass."""
        theta = self.fit.theta
        places = {*self.fit.known.active, *np.flatnonzero(theta)}
        scaled = {name: self.mass * theta[k] for k, name in enumerate(NAMES) if k in places}
        for name in ("command_lag", "thruster_time_constant"):  # neither is a force
            if name in scaled:
                scaled[name] /= self.mass
        scores = {
            name: finite({"gain": score.gain, "error": score.error, "mae": self.errors[name]})
            for name, score in self.scores.items()
        }  # fmt: skip
        return {
            "boat": self.boat,
            "mass": self.mass,
            "top": self.fit.top,
            "terms": self.chosen,
            "missions": len(self.fit.count),
            "steps": int(self.fit.count.sum()),
            "deviation": self.fit.deviation,
            "parameters": {name: float(value) for name, value in scaled.items()},
            "quantities": {name: finite(each._asdict()) for name, each in self.quantities.items()},
            "sets": scores,
        }


def finite(facts: dict[str, Any]) -> dict[str, Any]:
    """Values with None for what is not a finite number, which JSON does not have."""
    return {key: None if isinstance(x, float) and not np.isfinite(x) else x for key, x in facts.items()}


def check_terms(terms: str | None) -> None:
    """Raise a ConfigError if this is no set of terms; None is one that is chosen later."""
    if terms is not None and terms not in SETS:
        raise ConfigError(f"--terms: found {terms!r}, expected one of {', '.join(SETS)}{did_you_mean(terms, SETS)}")


def fit_boat(
    boat: str,
    rows: Sequence[np.ndarray],
    mass: float,
    top: float,
    terms: str | None = None,
    advance: Callable[[str], object] = lambda name: None,
) -> Fitted:
    """Fit every set of terms to a boat's missions, and choose.

    Args:
        boat: its name.
        rows: its missions, see `usvlearn.model.fit.logs.missions_of`.
        mass: kg.
        top: top speed, m/s.
        terms: the set to use, in place of the one that does best on missions which it has not learned.
        advance: is told the name of each set before it is fitted.

    Raises:
        ConfigError: there is no such set.
    """
    check_terms(terms)
    missions, fits, before = Missions(rows, top), {}, None
    for name in SETS:
        advance(name)
        fits[name] = missions.fit(name, before)
        before = fits[name].theta
    chosen, scores = choose(missions, fits, terms)
    errors = {name: float(np.mean(np.abs(missions.errors(fit)))) for name, fit in fits.items()}
    return Fitted(boat, mass, fits, scores, chosen, intervals(fits, scores, chosen, mass), errors)
