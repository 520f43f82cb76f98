"""What logs are good for, and how much more would make them good for the rest: at most five lines.

A purpose is served where the 90 % intervals of its quantities are within `PURPOSES` of the values, as the batch fit has
them ((1) of `usvlearn.model.fit.intervals`). Of the variance of a quantity, that of the parameters, sᵀ C s, shrinks
with more data. As much again of the same sailing halves it:

    C after t more hours = C · T / (T + t)                                                               (1)

The test manoeuvre (docs/controller.md) is simulated with the fitted boat, and gives the information H. The scatter of
the logs shows that their own information is worth the share g of what the simulation says, and so is H:

    C after it = (C⁻¹ + g H)⁻¹,   g = (det A / det C)^(1/m)                                              (2)

with A of `intervals`. What other sets of terms say, and a quantity's own error, stay, but for that of commands which
the logs do not have and the manoeuvre has. The amounts are estimates: other weather needs more or less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.activity import doing
from usvlearn.core.events import NINETY
from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, PREDICT, RIGHT, ROW, SIN, SURGE, YAW_RATE
from usvlearn.core.samples import speed_limit
from usvlearn.core.unconfirmed import UNSURE, Questions
from usvlearn.errors import UsvlearnError, printable
from usvlearn.estimators.axis.turning_intervals import HARDLY
from usvlearn.estimators.joint.periodic_estimates import shown
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.checks.finding import WARNING, Finding
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.fit.fitted import Fitted, fit_boat
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.intervals import disagreement, gradients, spread, unreached, variances
from usvlearn.model.fit.logs import APART, fine, missions_of
from usvlearn.model.fit.logs import DT as GRID
from usvlearn.model.fit.quantities import quantities

SPEED, FORECASTS, SIDES, TURNING = "steady speed", "forecasts", "thrust of each side", "turning"
PURPOSES = {  # the half-width of each quantity's interval over its value, at most
    SPEED: {"steady_speed_full": 0.1},
    FORECASTS: {"steady_speed_half": 0.1, "time_constant": 0.25},
    SIDES: {"thrust_full_left": 0.25, "thrust_full_right": 0.25},
    TURNING: {"yaw_rate_full": 0.25},
}
HOURS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # more of the same that is tried, h
TIMES, MINUTES = (1, 2, 3), 10  # likewise of the test manoeuvre; its length
RATE = 0.4  # rad/s, of a turn with all the difference of the sides: it matters little
STEPS = (0.25, 0.5, 0.75, 1.0)
STAIRS = tuple((15, x, x) for x in STEPS)
MANOEUVRE = (  # s, left, right
    (20, 0, 0), *STAIRS, (20, 0, 0), (20, 0.6, 0.2), *STAIRS, (20, 0, 0), (20, 0.2, 0.6),
    (10, 1, 1), (10, 0, 0), (10, 1, 1), (10, 0, 0), (20, 0.6, 0.2), (10, 0.3, 0.3), (10, 0.8, 0.8), (10, 0.3, 0.3),
    (10, 0.8, 0.8), (20, 1, 0.5), (20, 0.5, 1), (20, 0.5, 0.25), (20, 0.25, 0.5), (20, 0.6, 0), (20, 0, 0.6),
    (10, 0, 0), (15, -0.3, -0.3), (15, -0.6, -0.6), (15, 0, 0), (15, 0.5, -0.5), (15, -0.5, 0.5), (20, 1, 1),
    (15, 0, 0), (20, 1, 1), (20, 0, 0),
)  # fmt: skip
BEYOND = 0.15  # share of command that the logs lack, from which on it is a reason


class Expected:
    """The relative half-widths of a fit's intervals, now and after more data."""

    def __init__(self, fitted: Fitted, mass: float):
        self._fitted, fit = fitted, fitted.fit
        self._values, self._slopes = quantities(fit.theta, fit.top, mass), gradients(fit, mass)
        self._differ = disagreement(fitted.fits, fitted.scores, fitted.chosen, mass)
        rows = np.concatenate([each[each[:, MODE] >= PREDICT] for each in fitted.missions.rows])
        self.hours = float(rows[:, DT].sum()) / 3600
        self.beyond, self.apart = unreached(fitted.missions), float((rows[:, LEFT] - rows[:, RIGHT]).std())
        self._astern = bool((rows[:, [LEFT, RIGHT]].mean(1) < -0.1).any())

    def now(self) -> dict[str, float]:
        return self._widths(spread(self._fitted.fit), self.beyond)

    def after(self, hours: float) -> dict[str, float]:
        """(1)."""
        share = self.hours / (self.hours + hours)
        return self._widths(spread(self._fitted.fit) * share, self.beyond, share)

    def after_manoeuvres(self, times: int) -> dict[str, float]:
        """(2)."""
        fit, C = self._fitted.fit, spread(self._fitted.fit)
        share = math.exp((np.linalg.slogdet(fit.covariance)[1] - np.linalg.slogdet(C)[1]) / len(C))
        made = Missions([self._manoeuvre()], fit.top).evaluate(fit.terms, fit.theta, fit.deviation)
        turned = self.hours / (self.hours + times * MINUTES / 60)
        return self._widths(np.linalg.inv(np.linalg.inv(C) + times * share * made.information.sum(0)), 0.0, turned)

    def _manoeuvre(self) -> np.ndarray:
        """As prepared samples whose speeds are those of the simulation, `(time, ROW)`."""
        rows = np.zeros((sum(round(s / GRID) for s, *_ in MANOEUVRE), ROW))
        both = np.repeat([each[1:] for each in MANOEUVRE], [round(s / GRID) for s, *_ in MANOEUVRE], axis=0)
        both = both if self._astern else np.maximum(both, 0.0)
        rows[:, [LEFT, RIGHT]] = both if self.apart > APART else both.mean(1, keepdims=True)
        rows[:, YAW_RATE], rows[:, DT], rows[:, MODE] = RATE * (both[:, 0] - both[:, 1]), GRID, LEARN
        heading = np.cumsum(rows[:, YAW_RATE]) * GRID
        rows[:, SIN], rows[:, COS] = np.sin(heading), np.cos(heading)
        fit, alone = self._fitted.fit, Missions([rows], self._fitted.fit.top)
        ((speed, _),) = alone.simulate(alone.evaluate(fit.terms, fit.theta, fit.deviation))
        rows[:, SURGE] = np.nan_to_num(speed)
        return rows

    def _widths(self, covariance: np.ndarray, beyond: float, share: float = 1.0) -> dict[str, float]:
        found = variances(self._values, self._slopes, self._differ, beyond, covariance)
        widths = {
            name: NINETY * math.sqrt(each) / max(abs(float(self._values[name])), 1e-9) for name, each in found.items()
        }
        for name in PURPOSES[TURNING]:  # on the log scale; of a boat that hardly turned it is not known
            each = self._fitted.quantities.get(name)
            log = math.log(each.high / each.low) / 2 if each is not None and each.low > 0 else math.inf
            widths[name] = log * math.sqrt(share)
        return widths


def verdicts(
    recordings: Sequence[Recording], settings: Mapping[str, Any], findings: Sequence[Finding], asked: Questions
) -> Iterator[str]:
    """The verdict on the logs of each boat.

    Args:
        recordings: of all boats, as the settings read them.
        settings: `data` and `vehicle`, perhaps `align`, of a configuration.
        findings: of the data check.
        asked: what nobody has confirmed.
    """
    mass, top = float(settings["vehicle"]["mass"]), float(settings["vehicle"]["surge_max"])
    unsure = [key for key, each in asked.items() if each["certainty"] == UNSURE]
    channels = settings["data"].get("channels") or {}
    try:
        fleet = align_fleet(recordings, **fine(settings.get("align") or {"surge_max": speed_limit(top)}))
    except UsvlearnError as error:
        yield f"good for  nothing yet: {error}"
        return
    for boat in fleet.boats:
        own = [each for each in findings if each.boat == boat]
        try:
            rows = missions_of(fleet, boat)
            doing(f"fitting {boat}")
            yield from verdict(fit_boat(boat, rows, mass, top), channels, own, unsure, len(rows), mass)
        except (ValueError, ArithmeticError) as error:
            yield f"{printable(boat)}: good for nothing yet: {error}"


def served(widths: Mapping[str, float], purposes: Sequence[str]) -> dict[str, bool]:
    """Whether each purpose is."""
    return {each: all(widths[name] <= most for name, most in PURPOSES[each].items()) for each in purposes}


def verdict(
    fitted: Fitted,
    channels: Mapping[str, Any],
    findings: Sequence[Finding],
    unsure: Sequence[str],
    runs: int,
    mass: float,
) -> list[str]:
    """The lines of one boat.

    Args:
        fitted: to its logs.
        channels: of the configuration, for zeros and signs.
        findings: of the data check.
        unsure: what is guessed, and unsure.
        runs: how many logs.
        mass: kg, as configured.
    """
    expected, boat = Expected(fitted, mass), printable(fitted.boat)
    purposes = [each for each in PURPOSES if expected.apart > APART or each in (SPEED, FORECASTS)]
    now = expected.now()
    good = served(now, purposes)
    warnings = [each for each in findings if each.severity == WARNING]
    checked = f"{len(findings)} finding{'s' * (len(findings) > 1)}" if findings else "ok"
    guessed = f"; unsure: {', '.join(unsure)}" if unsure else ""
    lines = [f"{boat}: {expected.hours:.2f} h in {runs} run{'s' * (runs > 1)}; data check: {checked}{guessed}"]
    if against := [each.sentence() for each in warnings] or list(fitted.doubts):
        return [*lines, f"good for  nothing before this is settled: {printable(against[0])}"]
    lines.append(f"good for  {', '.join(_good(fitted, now, each) for each in purposes if good[each]) or 'nothing yet'}")
    if bad := [each for each in purposes if not good[each]]:
        lines.append(f"not for   {', '.join(_bad(fitted, now, each, expected) for each in bad)}")
    lines.append(f"found     {_found(fitted, channels, SIDES not in purposes)}")
    if bad:
        lines.append(f"more      {_more(expected, purposes, bad)}")
    return lines


def _width(widths: Mapping[str, float], purpose: str) -> str:
    widest = max(widths[name] for name in PURPOSES[purpose])
    return f"± {widest:.0%}".replace("%", " %") if widest < 1 else "unknown"


def _good(fitted: Fitted, widths: Mapping[str, float], purpose: str) -> str:
    if purpose != SPEED:
        return purpose
    return f"{purpose} {shown(fitted.quantities['steady_speed_full'].value)} m/s {_width(widths, purpose)}"


def _bad(fitted: Fitted, widths: Mapping[str, float], purpose: str, expected: Expected) -> str:
    """A purpose that is not served, and why."""
    if purpose == TURNING and HARDLY in fitted.found.lacks:
        why = "turns too little"
    elif expected.beyond > BEYOND and purpose != TURNING:
        why = f"no more than {1 - expected.beyond:.0%} of full command".replace("%", " %")
    else:
        why = "turns too little" if purpose in (SIDES, TURNING) else "too short"
    return f"{purpose} ({_width(widths, purpose)}: {why})"


def _found(fitted: Fitted, channels: Mapping[str, Any], one: bool) -> str:
    """Signs, offsets, dead zone and current."""
    back = []
    for side in ("left", "right"):
        span = (channels.get(f"command_{side}") or {}).get("span", 1.0)
        back += [side] if isinstance(span, int | float) and span < 0 else []
    who = "one command" if one else "both sides"
    said = [f"{' and '.join(back)} reversed" if back else f"{who} positive ahead"]
    offset = (channels.get("heading") or {}).get("zero", 0.0) or 0.0
    values = {name: fitted.found.displayed(name).value for name in ("dead_zone", "compass_offset", "current")}
    known = {name: value for name, value in values.items() if math.isfinite(value)}
    total = offset + known.get("compass_offset", 0.0)
    said += [f"compass {total:+.1f}°"] if abs(total) >= 0.1 else []
    said += [f"dead zone {known['dead_zone']:.0%}".replace("%", " %")] if "dead_zone" in known else []
    said += [f"current {known['current']:.2f} m/s"] if "current" in known else []
    return ", ".join(said)


def _more(expected: Expected, purposes: Sequence[str], bad: Sequence[str]) -> str:
    """How much more makes the logs good for the rest."""

    def first(amounts: Sequence[Any], after: Callable[[Any], Mapping[str, float]]) -> Any:
        return next((each for each in amounts if all(served(after(each), bad).values())), None)

    hours, times = first(HOURS, expected.after), first(TIMES, expected.after_manoeuvres)
    sailing = f"about {f'{hours:g} h' if hours and hours >= 1 else f'{60 * (hours or 0):.0f} min'} of such sailing"
    manoeuvre = f"{MINUTES * (times or 1)} min of the test manoeuvre"
    if hours and times:
        return f"{sailing}, or {manoeuvre}"
    if hours or times:
        return sailing if hours else f"{manoeuvre}; more of such sailing tells too little"
    return f"{manoeuvre} first; then check again"
