"""A fitted boat as an identified one: for the controller, the exports and the figures, and in a checkpoint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import CheckpointError
from usvlearn.estimators.axis.turning_intervals import joined
from usvlearn.estimators.axis.turning_quantities import OF_FIT
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.joint.excitation_warnings import ONE_COMMAND, POSITIVE_OF_BOATS, Quantity, unphysical
from usvlearn.estimators.joint.periodic_estimates import (
    Identified,
    IntervalTerms,
    says_nothing,
    scale_sentence,
    tells_sides,
)  # fmt: skip
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.regressors.terms import LAG
from usvlearn.model.fit.choice import Score
from usvlearn.model.fit.gauss_newton import Fit, Missions
from usvlearn.model.fit.intervals import OWN_ERROR, disagreement, intervals, spread, unreached, worth
from usvlearn.model.fit.logs import DT
from usvlearn.model.fit.quantities import CurvedAhead, quantities
from usvlearn.model.fit.terms import NAMES, SETS, TIME_CONSTANT, by_name, prior
from usvlearn.model.fit.turning_kernel import PARAMETERS
from usvlearn.model.surge import SurgeModel

SPEEDS = ("steady_speed_full", "steady_speed_half", "steady_speed_quarter")
LARGEST = 1e9  # m/s, kg: nothing is larger
UNCLEAR = 0.5  # half-width over value
TURNS = 4.0  # s: so wide, drag_cross at 0.3 rad/s is unclear by 0.3 of the drag
FITTED = "fit"  # of a checkpoint's metadata
LAGS = LAG, TIME_CONSTANT


class Turning(NamedTuple):
    """The fit of turning (`usvlearn.model.fit.turning`)."""

    theta: np.ndarray  # (m,)
    covariance: np.ndarray  # (m, m)
    explained: float  # share of the yaw rate's mean square


@dataclass(frozen=True, repr=False)
class FittedBoat(Identified):
    """The quantities of a fitted boat; `theta` and `covariance` are of the fitted parameters, by `names`."""

    terms: str = "nine"  # a name of `terms.SETS`
    top: float = 1.0  # m/s, top speed of the prior and of the nodes of drag
    late: float = 0.0  # s by which the measured speeds followed the commands, beside the lag of the thrust
    turning: Turning | None = None  # None where the boat hardly turned, and of a fit of an earlier version
    noise: float = math.nan  # m/s, σ over √g of `intervals`; NaN of a fit of an earlier version

    @classmethod
    def of(
        cls, missions: Missions, fits: Mapping[str, Fit], scores: Mapping[str, Score], chosen: str, mass: float,
        lacks: tuple[str, ...], late: float = 0.0,
    ) -> FittedBoat:  # fmt: skip
        """The boat of the chosen set; `lacks`: what the logs lack; `late`: s by which `pieces` moved the speeds."""
        fit = fits[chosen]
        quantities, differ = (
            intervals(fits, scores, chosen, mass, unreached(missions)),
            disagreement(fits, scores, chosen, mass),
        )
        common = max(differ[name] / abs(quantities[name].value) for name in SPEEDS)
        split = [quantities[f"drag_{name}"] for name in ("linear", "quadratic")]
        if any(each.high - each.low > 2 * UNCLEAR * abs(each.value) for each in split):
            lacks += ("The logs hardly separate linear from quadratic drag: use drag_half_speed.",)
        turning = (quantities["drag_cross"].high - quantities["drag_cross"].low) * quantities["steady_speed_full"].value
        if turning > TURNS * quantities["drag_half_speed"].value:
            lacks += ("The logs do not tell drag_cross: the boat hardly turns under way. Let it turn more.",)
        many = "1 mission" if missions.number == 1 else f"{missions.number} missions"
        return cls._made(
            fit.terms, fit.top, mass, fit.theta[fit.known.active], spread(fit), quantities,
            math.hypot(OWN_ERROR, common if math.isfinite(common) else 0.0), lacks,
            f"Fitted to {many} at once, with 90 % intervals; terms: {chosen}.", late,
            fit.deviation / math.sqrt(worth(missions, fit, spread(fit))),
        )  # fmt: skip

    @classmethod
    def _made(
        cls, terms: str, top: float, mass: float, theta: np.ndarray, covariance: np.ndarray,
        values: Mapping[str, Quantity], common: float, lacks: tuple[str, ...], basis: str, late: float, noise: float,
    ) -> FittedBoat:  # fmt: skip
        known = prior(terms, top)
        start = known.mean[known.active]
        first = {name: float(each) for name, each in quantities(known.mean, top, mass).items()}
        impossible = unphysical({name: values[name] for name in POSITIVE_OF_BOATS})
        unknown = frozenset(
            name
            for name, each in values.items()
            if says_nothing(name, each, first, mass) or (ONE_COMMAND in lacks and tells_sides(name))
        )
        return cls(
            dict(values), basis, scale_sentence(np.zeros(0), mass), tuple(filter(None, [impossible, *lacks])), mass,
            np.zeros(len(theta)), theta, covariance,
            IntervalTerms(common, theta, start, np.diag(np.linalg.inv(known.information)), vague=False),
            unknown, impossible, terms, top, late, noise=noise,
        )  # fmt: skip

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fitted parameters, in the order of `theta`."""
        return tuple(name for name in NAMES if name in SETS[self.terms])

    def every(self, theta: np.ndarray) -> np.ndarray:
        """All parameters by `terms.NAMES` of the fitted ones, `(..., m)`."""
        return by_name(self.names, theta)

    def ahead(self, theta: np.ndarray) -> CurvedAhead:
        return CurvedAhead(self.every(theta), self.top)

    def lag(self, dt: float) -> tuple[float, float]:
        """By how much the thrust follows the command, s, and its standard deviation; `dt` is that of the fit."""
        units = np.array([{TIME_CONSTANT: 1.0, LAG: DT}.get(name, 0.0) for name in self.names])
        return self.late + float(units @ self.theta), math.sqrt(max(units @ self.covariance @ units, 0.0))

    @property
    def model(self) -> SurgeModel:
        """The step of this boat."""
        return SurgeModel.fitted(self.every(self.theta), self.top, self.mass)

    def facts(self) -> dict[str, Any]:
        """As JSON values, for the metadata of a checkpoint."""
        assert self.beside is not None
        return {
            "terms": self.terms,
            "top": self.top,
            "mass": self.mass,
            "theta": dict(zip(self.names, self.theta.tolist(), strict=True)),
            "covariance": self.covariance.tolist(),
            "quantities": {
                name: [x if math.isfinite(x) else None for x in each[:3]] for name, each in self.quantities.items()
            },
            "common": self.beside.common,
            "late": self.late,
            "noise": self.noise,
            "turning": self.turning and [np.asarray(each).tolist() for each in self.turning],
            "lacks": list(self.lacks),
            "basis": self.basis,
        }

    @classmethod
    def read(cls, facts: Any) -> FittedBoat:
        """The boat of what `facts` wrote; a CheckpointError if it is something else."""
        try:
            terms, top, mass, common = facts["terms"], *(float(facts[key]) for key in ("top", "mass", "common"))
            terms, given = terms.removesuffix(", thruster"), facts["theta"]  # of a version whose other sets had no lag
            wanted = [name for name in NAMES if name in SETS[terms]]
            theta = np.array([float(given.get(name, 0.0) if name in LAGS else given[name]) for name in wanted])
            saved, late = np.array(facts["covariance"], dtype=float), float(facts.get("late", 0.0))
            noise = float(facts.get("noise", math.nan))
            places = [k for k, name in enumerate(wanted) if name in given]
            if saved.shape != (len(places), len(places)):
                raise ValueError(f"its covariance has the shape {saved.shape}, expected {(len(places),) * 2}")
            covariance = np.zeros((len(wanted), len(wanted)))
            covariance[np.ix_(places, places)] = saved
            if not (all(np.isfinite(x).all() for x in (theta, covariance, late)) and 0 <= common < LARGEST):
                raise ValueError("a number is not finite")
            if not (1 / LARGEST < top < LARGEST and 1 / LARGEST < mass < LARGEST) or noise <= 0:
                raise ValueError(f"its top speed is {top:g} m/s, its mass {mass:g} kg, its noise {noise:g} m/s")
            if np.linalg.eigvalsh(covariance)[0] < -1e-9 * np.abs(covariance).max():
                raise ValueError("its covariance has a negative variance")
            known = {}
            for name, each in facts["quantities"].items():
                value, low, high = (math.nan if x is None else float(x) for x in each)
                known[name] = Quantity(value, low, high, (QUANTITIES | TURNING | OF_FIT)[name])
            if missing := [name for name in QUANTITIES if name not in known and name != "mass"]:
                raise KeyError(missing[0])
            lacks, basis = tuple(map(str, facts["lacks"])), str(facts["basis"])
            turning = None
            if facts.get("turning") is not None:
                own, spread_of, explained = facts["turning"]
                turning = Turning(np.array(own, float), np.array(spread_of, float), float(explained))
                if not (np.shape(own), np.shape(spread_of)) == ((PARAMETERS,), (PARAMETERS,) * 2):
                    raise ValueError("its turning has other parameters")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise CheckpointError(f"its fit is damaged ({error!r}): run usvlearn fit again") from error
        impossible = unphysical({name: known[name] for name in POSITIVE_OF_BOATS})
        turns, own = ({name: known.pop(name) for name in names if name in known} for names in (TURNING, OF_FIT))
        lacks = tuple(x for x in lacks if x != impossible)
        boat = cls._made(terms, top, mass, theta, covariance, known, common, lacks, basis, late, noise)
        return replace(joined(boat, turns, ()), quantities=boat.quantities | turns | own, turning=turning)
