"""What logs are good for, and how much more would make them good for the rest: at most five lines a boat.

A purpose is served where the 90 % intervals of the batch fit are within `PURPOSES` of the values. Of the variance of a
quantity, (1) of `usvlearn.model.fit.intervals`, that of the parameters shrinks with more data, whose amount is tried:

    C after t more hours of the same: C · T / (T + t), with its scatter from as many more pieces         (1)
    C after a test manoeuvre: (C⁻¹ + g H)⁻¹,   as in `usvlearn.model.fit.intervals`                      (2)

H is the information of the manoeuvre (docs/controller.md). Other weather needs more or less.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.activity import doing
from usvlearn.core.events import NINETY
from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, PREDICT, RIGHT, ROW, SIN, YAW_RATE
from usvlearn.core.samples import speed_limit
from usvlearn.core.unconfirmed import UNSURE, Questions
from usvlearn.errors import UsvlearnError, printable
from usvlearn.estimators.joint.periodic_estimates import shown
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.checks.finding import WARNING, Finding
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.fit.fitted import Fitted, fit_boat
from usvlearn.model.fit.intervals import disagreement, gradients, rehearsed, spread, unreached, variances, worth
from usvlearn.model.fit.logs import APART, fine, missions_of
from usvlearn.model.fit.logs import DT as GRID
from usvlearn.model.fit.quantities import quantities

Widths = dict[str, float]  # half-widths of intervals over the values
UNKNOWN = "unknown"
SPEED, SIDES, TURNING = "steady speed", "thrust of each side", "turning"
PURPOSES = {  # the largest half-width of each quantity over its value
    SPEED: {"steady_speed_full": 0.1},
    "forecasts": {"steady_speed_half": 0.1, "time_constant": 0.25},
    SIDES: {"thrust_full_left": 0.25, "thrust_full_right": 0.25},
    TURNING: {"yaw_rate_full": 0.25},
}
BEYOND = 0.15  # share of command that the logs lack, from which on this is the reason
HOURS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # that are tried
TIMES, MINUTES = (1, 2, 3), 10  # test manoeuvres that are tried, and the length of one
RATE = 0.4  # rad/s, of a turn with all the difference of the sides: it matters little
STAIRS = ((15, 0.25, 0.25), (15, 0.5, 0.5), (15, 0.75, 0.75), (15, 1, 1), (20, 0, 0))
STEPS = ((10, 1, 1), (10, 0, 0), (10, 1, 1), (10, 0, 0), (20, 0.6, 0.2), *((10, 0.3, 0.3), (10, 0.8, 0.8)) * 2)
SINGLE = ((20, 1, 0.5), (20, 0.5, 1), (20, 0.5, 0.25), (20, 0.25, 0.5), (20, 0.6, 0), (20, 0, 0.6), (10, 0, 0))
ENDS = ((45, 0, 0), (15, 0.5, 0), (15, 0, 0.5), (20, 1, 1), (15, 0, 0), (20, 1, 1), (20, 0, 0))
MANOEUVRE = ((20, 0, 0), *STAIRS, (20, 0.6, 0.2), *STAIRS, (20, 0.2, 0.6), *STEPS, *SINGLE, *ENDS)  # s, left, right


class Expected:
    """The intervals of a fit now, and after more data."""

    def __init__(self, fitted: Fitted):
        fit, mass = fitted.fit, fitted.identified.mass
        rows = np.concatenate([each[each[:, MODE] >= PREDICT] for each in fitted.missions.rows])
        self.fitted, self.hours, self.beyond = fitted, float(rows[:, DT].sum()) / 3600, unreached(fitted.missions)
        self.one_command = float((rows[:, LEFT] - rows[:, RIGHT]).std()) < APART
        self._values, self._slopes = quantities(fit.theta, fit.top, mass), gradients(fit, mass)
        self._differ = disagreement(fitted.fits, fitted.scores, fitted.chosen, mass)

    def after(self, hours: float) -> Widths:
        """(1)."""
        share = self.hours / (self.hours + hours)
        return self._widths(spread(self.fitted.fit, share) * share, self.beyond, share)

    def after_manoeuvres(self, times: int) -> Widths:
        """(2); all commands are reached then."""
        fit, share = self.fitted.fit, self.hours / (self.hours + times * MINUTES / 60)
        C = spread(fit, share)
        rows = np.zeros((sum(s for s, *_ in MANOEUVRE) * round(1 / GRID), ROW))
        both = np.repeat([each[1:] for each in MANOEUVRE], [s * round(1 / GRID) for s, *_ in MANOEUVRE], axis=0)
        rows[:, [LEFT, RIGHT]] = both.mean(1, keepdims=True) if self.one_command else both
        rows[:, YAW_RATE], rows[:, DT], rows[:, MODE] = RATE * (both[:, 0] - both[:, 1]), GRID, LEARN
        heading = np.cumsum(rows[:, YAW_RATE]) * GRID
        rows[:, SIN], rows[:, COS] = np.sin(heading), np.cos(heading)
        H = worth(self.fitted.missions, fit, C) * rehearsed(rows, fit).information.sum(0)
        return self._widths(np.linalg.inv(np.linalg.inv(C) + times * H), 0.0, share)

    def _widths(self, C: np.ndarray, beyond: float, share: float) -> Widths:
        sigma2 = variances(self._values, self._slopes, self._differ, beyond, C)
        widths = {name: NINETY * math.sqrt(x) / max(abs(float(self._values[name])), 1e-9) for name, x in sigma2.items()}
        for name in PURPOSES[TURNING]:  # on the log scale
            value = self.fitted.quantities.get(name)
            known = value is not None and value.low > 0
            widths[name] = math.log(value.high / value.low) / 2 * math.sqrt(share) if value and known else math.inf
        return widths


def verdicts(
    recordings: Sequence[Recording], settings: Mapping[str, Any], findings: Sequence[Finding], asked: Questions
) -> Iterator[str]:
    """The lines for each boat, as the settings of a configuration read the recordings; asked: what nobody confirmed."""
    mass, top = float(settings["vehicle"]["mass"]), float(settings["vehicle"]["surge_max"])
    unsure = [key for key, each in asked.items() if each["certainty"] == UNSURE]
    try:
        fleet = align_fleet(recordings, **fine(settings.get("align") or {"surge_max": speed_limit(top)}))
    except UsvlearnError as error:
        yield f"good for  nothing yet: {error}"
        return
    for boat in fleet.boats:
        of_boat = [each for each in findings if each.boat == boat]
        try:
            rows = missions_of(fleet, boat)
            doing(f"fitting {boat}")
            expected = Expected(fit_boat(boat, rows, mass, top))
        except (ValueError, ArithmeticError) as error:
            yield f"{printable(boat)}: good for nothing yet: {error}"
            continue
        said = f"{len(of_boat)} finding{'s' * (len(of_boat) > 1)}" if of_boat else "ok"
        said += f"; unsure: {', '.join(unsure)}" if unsure else ""
        yield f"{printable(boat)}: {expected.hours:.2f} h in {len(rows)} run{'s' * (len(rows) > 1)}; data check: {said}"
        against = [each.sentence() for each in of_boat if each.severity == WARNING] or expected.fitted.doubts
        if against:
            yield f"good for  nothing before this is settled: {printable(against[0])}"
        else:
            yield from _told(expected, settings["data"].get("channels") or {})


def _told(expected: Expected, channels: Mapping[str, Any]) -> Iterator[str]:
    now, identified = expected.after(0.0), expected.fitted.identified
    purposes = [each for each in PURPOSES if not (expected.one_command and each in (SIDES, TURNING))]
    words = {each: _width(now, each) for each in purposes}
    bad = [each for each in purposes if not _served(now, each)]
    few = f"commands up to {100 - 100 * expected.beyond:.0f} %" if expected.beyond > BEYOND else "too short"
    why: dict[str, str] = {SIDES: "turns too little", TURNING: "turns too little"}
    top = f"{SPEED} {shown(identified['steady_speed_full'].value)} m/s {words[SPEED]}"
    good = [top if each == SPEED else each for each in purposes if each not in bad]
    yield f"good for  {', '.join(good) or 'nothing yet'}"
    if bad:
        yield f"not for   {', '.join(f'{each} ({words[each]}: {why.get(each, few)})' for each in bad)}"
    spans = {side: (channels.get(f"command_{side}") or {}).get("span") for side in ("left", "right")}
    back = [side for side, span in spans.items() if isinstance(span, int | float) and span < 0]
    said = ["one command for both sides"] * expected.one_command
    said.append(f"{' and '.join(back)} reversed" if back else "positive ahead")
    dead, compass, current = (
        identified.displayed(each).value if each in identified else math.nan
        for each in ("dead_zone", "compass_offset", "current")
    )
    compass = np.nan_to_num(compass) + ((channels.get("heading") or {}).get("zero") or 0.0)
    said += [f"compass {compass:+.1f}°"] if abs(compass) >= 0.1 else []
    said += [f"dead zone {100 * dead:.0f} %"] if math.isfinite(dead) else []
    said += [f"current {current:.2f} m/s"] if math.isfinite(current) else []
    yield f"found     {', '.join(said)}"
    if bad:
        known = [each for each in bad if words[each] != UNKNOWN]  # of others a first manoeuvre tells how many
        hours = next((x for x in HOURS if known == bad and _served(expected.after(x), *bad)), None)
        times = next((x for x in TIMES if _served(expected.after_manoeuvres(x), *known)), None)
        sailing = f"about {f'{hours:g} h' if hours and hours >= 1 else f'{60 * (hours or 0):.0f} min'} of such sailing"
        manoeuvre = f"{MINUTES * (times or 1)} min of the test manoeuvre"
        if hours is None:
            yield f"more      {manoeuvre}{'; more of such sailing tells too little' if times else ', then check again'}"
        else:
            yield f"more      {sailing}{f', or {manoeuvre}' if times else ''}"


def _served(widths: Widths, *purposes: str) -> bool:
    return all(widths[name] <= most for each in purposes for name, most in PURPOSES[each].items())


def _width(widths: Widths, purpose: str) -> str:
    widest = max(widths[name] for name in PURPOSES[purpose])
    return f"± {100 * widest:.0f} %" if widest < 1 else UNKNOWN
