"""What a joint EKF has identified: every physical quantity with a 90 % interval. Imports no torch.

Equations (1) to (3): `docs/theory/identification.md#periodic-estimates`. λ and ν were chosen on simulated boats
(`docs/benchmarks/identify.md`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.estimators.joint.excitation_warnings import (
    POSITIVE_OF_BOATS,
    SILENT,
    WRONG_SIGN,
    Quantity,
    astray,
    lacking,
    misstated,
    stated_top,
    undetermined,
    unphysical,
)
from usvlearn.estimators.joint.quantities import QUANTITIES, SIDES, Ahead, gradients, steps_of
from usvlearn.estimators.joint.quantities import quantities as quantities_of
from usvlearn.estimators.joint.state import DROPPED, THETA, names
from usvlearn.estimators.regressors.terms import SURGE as COEFFICIENTS

FEW_P, FEW_C, MODEL, FEW_SINGLE = 2.0, 1.0, 0.1, 6.0  # of (1); in place of FEW_P for single coefficients
FIRST, FADES = 600.0, 300.0  # s, of (2)
POSITIVE = ("time_constant", "stopping_distance", "thrust_ratio")
WIDEST = math.log(1000)  # exponent of an interval on the log scale
SAYS_NOTHING, RATIO = 2.0, 100.0  # half-width over what such a boat has at full command; high over low of `POSITIVE`
SIDE_THRUSTS, TWICE = ("thrust_full_left", "thrust_full_right"), 2.0  # half-widths from zero, at which one is negative
OWN_ERROR = {"drag_cross": 1.5}  # standard deviation relative to the value: noise in the yaw rate makes it too small


class IntervalTerms(NamedTuple):
    """What an interval takes in beside the covariance of the parameters."""

    common: float  # standard deviation of every quantity relative to its value: a current taken for speed, the model
    now: np.ndarray  # (m,) the filter's present estimate
    prior: np.ndarray  # (m,)
    variance: np.ndarray  # (m,) of the prior
    vague: bool  # whether the interval contains the prior's

    def interval(
        self, name: str, values: Sequence[float], slope: np.ndarray, slope_of_prior: np.ndarray, covariance: np.ndarray
    ) -> tuple[float, float]:
        """The 90 % interval of a quantity, or of a point of a curve; NaN where it is undefined.

        `values` are at θ̄, at the present estimate and at the prior, slopes, `(m,)`, at θ̄ and at the prior;
        `covariance` is λ²P + ν²C of (1), with what the log lacks, `(m, m)`.
        """
        value, present, first = values
        if not (math.isfinite(value) and np.isfinite(slope).all()):
            return math.nan, math.nan
        error = math.hypot(OWN_ERROR.get(name, 0.0), self.common) * abs(value)
        ends = [*around(name, value, math.hypot(_deviation(slope, covariance), error))]
        ends.append(present if math.isfinite(present) else value)
        if self.vague:
            ends += [
                x for x in around(name, first, _deviation(slope_of_prior, np.diag(self.variance))) if not math.isnan(x)
            ]
        return (min(ends), max(ends)) if np.isfinite(ends).all() else (math.nan, math.nan)


@dataclass(frozen=True, repr=False)
class Identified(Mapping[str, Quantity]):
    """All quantities of a boat, by name (`quantities.QUANTITIES`).

    Attributes:
        quantities: with their intervals.
        basis: of the values and intervals, one sentence.
        scale: what fixes the scale of the forces, one sentence.
        lacks: what the log lacks, one sentence each; `unphysical` is the first of them.
        mass: kg, as configured.
        inverse_mass: g of 1/m = gᵀθ where a known force fixes the mass, `(m,)`; else zeros.
        theta: θ̄, per unit mass, `(m,)`.
        covariance: λ²P + ν²C of (1), with what the log lacks, `(m, m)`.
        beside: what the intervals take in beside it; None if nothing is identified.
        unknown: the quantities whose intervals say nothing, because they are wider than what such a boat can have.
        unphysical: a sentence if no boat can have these quantities, as its signs or sides are wrong; else "".

    >>> from usvlearn import JointEKF, Online
    >>> boat = Online(JointEKF(surge_max=2.7, mass=28.0, estimate_every=600.0)).identified()
    >>> boat["steady_speed_full"].unit, boat.json()["steady_speed_full"]["unit"]
    ('m/s', 'm/s')
    >>> boat.lag(dt=0.4)[1] > 0
    True
    """

    quantities: dict[str, Quantity]
    basis: str
    scale: str
    lacks: tuple[str, ...]
    mass: float
    inverse_mass: np.ndarray
    theta: np.ndarray
    covariance: np.ndarray
    beside: IntervalTerms | None = None
    unknown: frozenset[str] = frozenset()
    unphysical: str = ""

    def ahead(self, theta: np.ndarray) -> Ahead:
        """The boat of some parameters while it moves straight ahead.

        Args:
            theta: like the attribute, `(..., m)`.

        Returns:
            Forces per mass and steady speeds, for each row of θ.

        >>> from usvlearn import JointEKF, Online
        >>> boat = Online(JointEKF(surge_max=2.7, mass=28.0, estimate_every=600.0)).identified()
        >>> round(float(boat.ahead(boat.theta).steady_speed(1.0)), 2)
        2.7
        """
        return Ahead(theta)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters, in the order of `theta`."""
        return names(len(self.theta) == len(names(even=True)))

    def lag(self, dt: float) -> tuple[float, float]:
        """By how much the thrust follows the command.

        Args:
            dt: of the samples, s.

        Returns:
            The time, and its standard deviation, s.
        """
        return float(self.theta[-1]) * dt, math.sqrt(self.covariance[-1, -1]) * dt

    def displayed(self, name: str) -> Quantity:
        """A quantity as people are told it: NaN while its interval says nothing.

        Args:
            name: of the quantity.

        Returns:
            Its value and interval, NaN where the interval is wider than what such a boat can have.

        >>> from usvlearn import JointEKF, Online
        >>> boat = Online(JointEKF(surge_max=2.7, mass=28.0, estimate_every=600.0)).identified()
        >>> boat.displayed("steady_speed_full").unit
        'm/s'
        """
        quantity = self.quantities[name]
        return Quantity(math.nan, math.nan, math.nan, quantity.unit) if name in self.unknown else quantity

    def __getitem__(self, name: str) -> Quantity:
        return self.quantities[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.quantities)

    def __len__(self) -> int:
        return len(self.quantities)

    def json(self) -> dict[str, dict[str, Any]]:
        """The quantities as `results.json` has them.

        Returns:
            Name -> value, ends of its interval and unit.
        """
        return {name: each._asdict() for name, each in self.items()}

    def __repr__(self) -> str:
        wide = max(map(len, self.quantities))
        lines = [
            f"{name:{wide}}  {shown(each.value):>9}  {shown(each.low):>9} … {shown(each.high):<9}  {each.unit}"
            for name, each in ((name, self.displayed(name)) for name in self)
        ]
        return "\n".join(
            [f"{'quantity':{wide}}  {'value':>9}  90 % interval", *lines, self.basis, self.scale, *self.lacks]
        )


def shown(value: float) -> str:
    """A number with three significant digits; a dash for NaN."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else f"{value:g}"
    if abs(value) >= 1e5:
        return f"{value:.2g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:z.{min(digits, 4)}f}"  # z: no minus before zero


def tells_sides(name: str) -> bool:
    """Whether a quantity tells left from right, which nothing does where both have one command."""
    return name.endswith(("left", "right")) or name == "thrust_ratio"


def reader_of(members: Mapping[str, Mapping[str, Any] | None]) -> str | None:
    """The name of the member whose periodic estimates are used: the first joint EKF that reads. None without one."""
    return next((name for name, member in members.items() if member is not None and reads(member)), None)


def reads(description: Mapping[str, Any]) -> bool:
    """Whether a description is that of a joint EKF with periodic estimates."""
    return description.get("kind") == "joint" and math.isfinite(description["numbers"]["estimate_every"])


def identify(description: Mapping[str, Any], leaves: Mapping[str, np.ndarray]) -> Identified:
    """All quantities of one boat, from the description and the leaves of a joint EKF, of one batch element."""
    numbers, vectors = description["numbers"], description["vectors"]
    state = {name: np.asarray(leaf, dtype=np.float64) for name, leaf in leaves.items()}
    mass, inverse = float(numbers["mass"]), np.asarray(vectors["inverse_mass"], dtype=np.float64)
    prior, variance = (np.asarray(vectors[name], dtype=np.float64) for name in ("prior", "variance"))
    now, P = state["mean"][THETA:], covariance_of(state["factor"])
    used = max(float(state["readings"]) - DROPPED, 0.0)
    every = float(numbers["estimate_every"])
    learned = float(state["learned"]) + (float(state["readings"]) * every if math.isfinite(every) else 0.0)
    if not all(np.isfinite(x).all() for x in (now, P, state["reading"], state["spread"])):
        return _nothing(mass, inverse, now, P[THETA:, THETA:])
    if used:
        theta, spread, inflation = state["reading"], (1 + FEW_C / used) * state["spread"], 1 + FEW_P / used
        many = "One estimate, after" if used == 1 else f"Means of {used:.0f} estimates, one in"
        basis = f"{many} {every / 60:g} min of learning, with 90 % intervals."
    else:
        theta, spread, inflation = now, np.zeros_like(state["spread"]), 5 * (1 + FIRST / (learned + FADES)) ** 2
        basis = (
            "Present values, with wider 90 % intervals: means of several estimates need "
            f"{(DROPPED + 1) * every / 60:g} min of learning."
        )
    silent = float(state["noise"]) <= SILENT**2
    missing = lacking(P, variance, float(numbers["current"]), float(state["updates"]), silent)
    total = inflation * P[THETA:, THETA:] + spread + np.diag(missing.astern)
    of = partial(quantities_of, mass=mass, inverse_mass=inverse)
    values, slopes = gradients(of, theta, steps_of(variance))
    top = values["steady_speed_full"]
    total *= astray(top, variance)
    single = total + (FEW_SINGLE - FEW_P) / used * P[THETA:, THETA:] if used else total
    speed = max(abs(top), 1e-9) if math.isfinite(top) else stated_top(variance)
    beside = IntervalTerms(
        math.hypot(2 * missing.blind / speed, MODEL if used else 0.0), now, prior, variance, missing.vague
    )
    present, (first, first_slopes) = of(now), gradients(of, prior, steps_of(variance))

    def interval(name: str) -> tuple[float, float]:
        estimate = values[name], float(present[name]), first[name]
        covariance = single if name in COEFFICIENTS else total
        return beside.interval(name, estimate, slopes[name], first_slopes[name], covariance)

    said = misstated(top, *interval("steady_speed_full"), variance)
    signed = {name: Quantity(values[name], *interval(name), QUANTITIES[name]) for name in POSITIVE_OF_BOATS}
    for name in SIDE_THRUSTS:  # a side trades against the other one, and against the drag of turns
        value, low, high, unit = signed[name]
        signed[name] = Quantity(value, low, value + TWICE * (high - value), unit)
    if top < 0:  # its sign is known sooner than its size: the filter's own interval tells it
        half = NINETY * _deviation(slopes["steady_speed_full"], P[THETA:, THETA:])
        signed["steady_speed_full"] = Quantity(top, top - half, top + half, QUANTITIES["steady_speed_full"])
    impossible = unphysical(signed)
    if top < 0:  # a sign is reversed
        beside = beside._replace(vague=True)
    wrong = [WRONG_SIGN] if theta @ inverse < 0 else []
    quantities = {}
    for name, unit in QUANTITIES.items():
        if name in values:
            low, high = interval(name)
            quantities[name] = Quantity(values[name] if low == low else math.nan, low, high, unit)
    lacks = [*filter(None, [impossible]), *missing.lacks, *said, *wrong]
    return Identified(
        quantities,
        basis,
        "" if wrong else scale_sentence(inverse, mass),
        tuple(lacks or undetermined(quantities)),
        mass,
        inverse,
        theta,
        total,
        beside,
        frozenset(name for name, each in quantities.items() if says_nothing(name, each, first, mass)),
        impossible,
    )


def says_nothing(name: str, quantity: Quantity, prior: Mapping[str, float], mass: float) -> bool:
    """Whether an interval is wider than what a boat like that of the prior can have.

    The scale of a unit follows from the prior's speed and thrust at full command.
    """
    value, low, high, unit = quantity
    if name in POSITIVE:
        return low > 0 and high > RATIO * low
    speed, force = abs(prior["steady_speed_full"]), sum(abs(prior[f"thrust_full_{side}"]) for side in SIDES)
    scales = {"m/s": speed, "N": force, "kg": mass, "kg/m": force / speed**2, "kg/rad": force / speed}
    half = (high - low) / 2
    return half > SAYS_NOTHING * scales.get(unit, force / speed) and half > abs(value)


def covariance_of(factor: np.ndarray) -> np.ndarray:
    """P = U D Uᵀ of the leaf `factor`, `(n, n)`."""
    U = np.tril(factor, -1).T + np.eye(len(factor))
    return (U * np.diag(factor)) @ U.T


def _deviation(slope: np.ndarray, covariance: np.ndarray) -> float:
    return math.sqrt(max(float(slope @ covariance @ slope), 0.0))


def around(name: str, value: float, deviation: float) -> tuple[float, float]:
    """The ends of a 90 % interval; on the log scale where only positive values make sense."""
    half = NINETY * deviation
    if name in POSITIVE and value > 0:
        ratio = math.exp(min(half / value, WIDEST))
        return value / ratio, value * ratio
    return value - half, value + half


def scale_sentence(inverse: np.ndarray, mass: float) -> str:
    """A sentence that says what fixes the scale of the forces."""
    if inverse.any():
        return "The mass and all forces follow from the known forces."
    return f"Forces are those of a boat of {mass:g} kg, as configured: speeds alone do not tell the mass."


def _nothing(mass: float, inverse: np.ndarray, theta: np.ndarray, covariance: np.ndarray) -> Identified:
    """The quantities of a filter whose state is not finite."""
    every = {name: Quantity(math.nan, math.nan, math.nan, unit) for name, unit in QUANTITIES.items()}
    if not inverse.any():
        del every["mass"]
    return Identified(
        every, "Nothing is identified.", "", ("The filter has diverged.",), mass, inverse, theta, covariance
    )
