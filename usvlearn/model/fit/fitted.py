"""The batch fit of one boat: all sets of terms, the one to use, and its quantities with intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from usvlearn.display.json_values import finite
from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.estimators.axis.turning_intervals import HARDLY
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.regressors.terms import LAG
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.choice import WEAR, Score, choose
from usvlearn.model.fit.diagnostics import diagnostics, doubts
from usvlearn.model.fit.gauss_newton import Fit, Missions
from usvlearn.model.fit.ground import with_ground
from usvlearn.model.fit.intervals import alike
from usvlearn.model.fit.logs import DT, lacking
from usvlearn.model.fit.open_loop import FreeMode
from usvlearn.model.fit.pieces import cut, late
from usvlearn.model.fit.terms import AT, NAMES, SETS, TIME_CONSTANT, by_name
from usvlearn.model.fit.turning import first_fit, fitted, natural, prepared, with_turning
from usvlearn.model.fit.turning_kernel import LAG as LAG_OF_TURNS
from usvlearn.model.fit.wear import worn


@dataclass(frozen=True, repr=False)
class Fitted:
    """A fitted boat; it prints as the table of its quantities."""

    boat: str  # its name
    missions: Missions
    fits: dict[str, Fit]  # of all sets of terms
    scores: dict[str, Score]  # of the same, on missions that they have not learned
    chosen: str  # the set to use
    identified: FittedBoat  # its quantities
    errors: dict[str, float]  # m/s, mean |error| of the simulation of each set over the logs
    simulation: FreeMode | None = None  # None: it was not asked which one to use
    online: Identified | None = None  # what was identified online
    lag: float = 0.0  # s, of the thrust, as turns show it

    @cached_property
    def diagnostics(self) -> dict[str, Any]:
        """As of `usvlearn.model.fit.diagnostics`."""
        rivals = [self.fits[name] for name in alike(self.scores, self.chosen)]
        return diagnostics(self.missions, self.fit, self.identified.mass, rivals)

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Why its values are not to be used, but those learned online, one sentence each."""
        sentences = doubts(self.fit, self.identified, self.diagnostics["cross_correlation"], self.online, self.lag)
        return (*filter(None, [self.identified.unphysical]), *sentences)

    @property
    def fit(self) -> Fit:
        """The fit with the chosen set."""
        return self.fits[self.chosen]

    @property
    def quantities(self) -> dict[str, Quantity]:
        """Of the chosen set, with 90 % intervals."""
        return self.identified.quantities

    def __repr__(self) -> str:
        return repr(self.identified)

    def json(self) -> dict[str, Any]:
        """What `BOAT.fit.json` has: JSON values; parameters are in units of force, times the mass."""
        mass = self.identified.mass
        forces = {name: mass for name in NAMES} | {LAG: 1.0, TIME_CONSTANT: 1.0}  # neither of these is a force
        return finite({
            "boat": self.boat,
            "mass": mass,
            "top": self.fit.top,
            "terms": self.chosen,
            "missions": self.missions.number,
            "pieces": len(self.missions.rows),
            "late": self.identified.late,
            "steps": int(self.fit.count.sum()),
            "deviation": self.fit.deviation,
            "parameters": {name: forces[name] * float(self.fit.theta[AT[name]]) for name in self.identified.names},
            "quantities": {name: each._asdict() for name, each in self.identified.items()},
            "lacks": list(self.identified.lacks),
            "simulation": None if self.simulation is None else self.simulation.json(),
            "doubts": list(self.doubts),
            "diagnostics": self.diagnostics,
            "sets": {
                name: {
                    "parameters": len(self.fits[name].known.active),
                    "gain": score.gain,
                    "error": score.error,
                    "mae": self.errors[name],
                }
                for name, score in self.scores.items()
            },
        })  # fmt: skip


def check_terms(terms: str | None) -> None:
    """Raise a ConfigError if this is no set of terms; None is one that is chosen later."""
    if terms is not None and terms.removesuffix(WEAR) not in SETS:
        known = ", ".join(map(repr, SETS)) + did_you_mean(terms, SETS)
        raise ConfigError(f"--terms: found {terms!r}, expected one of {known}")


def fit_boat(
    boat: str,
    rows: Mapping[str, np.ndarray],
    mass: float,
    top: float,
    terms: str | None = None,
    advance: Callable[[str], object] = lambda name: None,
    stop: type[BaseException] = KeyboardInterrupt,
    online: Identified | None = None,
) -> Fitted:
    """Fit every set of terms to a boat's missions (`logs.missions_of`), and choose; a ConfigError if that cannot be.

    Args:
        terms: the set to use, in place of the one that does best on missions which it has not learned.
        advance: receives the name of each set before it is fitted.
        stop: what ends the fit early: the sets that are done are used. Without any, or the wanted one, it is raised.
        online: what was identified online, to begin with; by default the prior.
    """
    check_terms(terms)
    terms = None if terms is None else terms.removesuffix(WEAR)
    lacks = lacking(boat, list(rows.values()))
    rows, turning = first_fit(rows, top)
    (missions, steps), fits, deviation = late(cut(rows, top, DT)), dict[str, Fit](), None
    start = None if online is None else by_name(online.names, online.theta)

    def chosen() -> Fitted:
        name, scores = choose(missions, fits, terms, worn)
        last = sorted(fits, key=lambda each: each == name)  # whose simulation is kept
        errors = {each: float(np.mean(np.abs(missions.errors(fits[each])))) for each in last}
        fitted_boat, lag = FittedBoat.of(missions, fits, scores, name, mass, lacks, steps * DT), 0.0
        if turning is not None:
            both = zip(missions.rows, missions.simulate(fits[name], True), strict=True)
            sailed = [prepared(each, top, end) for each, (_, end) in both]
            turns = fitted(sailed, turning.theta)
            fitted_boat = with_ground(with_turning(fitted_boat, turns, sailed), rows)
            lag = 0.0 if HARDLY in fitted_boat.lacks else float(natural(turns.theta)[LAG_OF_TURNS])
        return Fitted(boat, missions, fits, scores, name, fitted_boat, errors, online=online, lag=lag)

    try:
        for name in SETS:
            advance(name)
            fits[name] = missions.fit(name, start, deviation)
            start, deviation = fits[name].theta, fits[name].deviation
        advance("wear")
        return chosen()
    except stop:  # the sets that are done are there; the choice among them takes a moment
        if not fits or terms not in (None, *fits):
            raise
        done = len(set(SETS) & set(fits))
        lacks = (f"Stopped after {done} of {len(SETS)} sets of terms.", *lacks) if done < len(SETS) else lacks
        return chosen()
