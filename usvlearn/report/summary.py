"""The summary with which train, fit and evaluate end: at most eight lines of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from usvlearn.core.events import LOSS
from usvlearn.core.unconfirmed import Questions
from usvlearn.errors import printable
from usvlearn.estimators.joint.excitation_warnings import WIDE, Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified, shown
from usvlearn.evaluation.metrics import mean
from usvlearn.evaluation.objective import measure_of

NEAR = "10 s"  # the horizon of the summary, or else the longest that was judged
SPEED, TIME, RATE = "steady_speed_full", "time_constant", "yaw_rate_full"
FULL = "thrust_full_left", "thrust_full_right"
Quantities = Mapping[str, Quantity]


class Glance(NamedTuple):
    """What a summary says."""

    findings: int | None  # of the data check; None: it was not made
    asked: Questions  # what nobody has confirmed
    boats: Mapping[str, Quantities]
    errors: Sequence[str]  # in words
    fit: tuple[float | None, float | None]  # percent, one step ahead and in open loop, means over boats
    alarms: Sequence[str] | None  # where and when; None: nobody watched


def known(found: Quantity | None) -> bool:
    """Whether a quantity is determined: its 90 % interval is within ± `WIDE` of its value."""
    return found is not None and found.high - found.low <= 2 * WIDE * abs(found.value)


def displayed(found: Identified) -> dict[str, Quantity]:
    """The quantities as people are told them."""
    return {name: found.displayed(name) for name in found}


def glance(results: Mapping[str, Any], asked: Questions, boats: Mapping[str, Quantities]) -> Glance:
    """The summary of a run, from its `results.json`."""
    name, check, events = results["output"], results.get("data_check"), results.get("events")
    measure = measure_of(results["measure"], "")
    errors = [f"{measure.title()} {measure.shown(results['objective'])}"] if str(measure) != f"{name}.mae" else []
    one, near, away, horizon = mean(rows[name]["mae"] for rows in results["boats"].values()), None, None, NEAR
    ahead = [rows[name] for rows in (results.get("forecast") or {}).values() if name in rows]
    tracks = [each for each in (results.get("tracks") or {}).values() if each]
    if ahead and ahead[0]:
        horizon = NEAR if NEAR.split()[0] in ahead[0] else f"{list(ahead[0])[-1]} s"
        near = mean(row[horizon.split()[0]]["mae"] for row in ahead)
        away = mean(rows.get(horizon.split()[0], {}).get("position") for rows in tracks)
    errors += error_words(one, near, horizon, away)
    fit = (
        mean(rows[name]["fit"] for rows in results["boats"].values()),
        mean(rows.get(name) for rows in results.get("free_fit", {}).values()),
    )
    alarms = None if events is None else [
        loss_words(boat, each) for boat, found in events.items() for each in found if each["kind"] == LOSS
    ]  # fmt: skip
    return Glance(None if check is None else len(check), asked, boats, errors, fit, alarms)


def error_words(one: float | None, near: float | None, horizon: str, away: float | None = None) -> list[str]:
    """Errors one step ahead and at a horizon, m/s, and that of the position there, m, in words."""
    far = "" if away is None else f" and {shown(away)} m"
    said = [] if one is None else [f"{one:.3f} m/s a step ahead"]
    return said if near is None else [*said, f"{near:.3f} m/s{far} {horizon} ahead"]


def loss_words(boat: str, event: Mapping[str, Any]) -> str:
    """Which thruster lost thrust, and when."""
    return f"{event['side']} thruster lost thrust, {boat}, run {event['run']}, {event['time']:.0f} s"


def summary(told: Glance) -> list[str]:
    """The lines of a summary, each behind its label."""
    unsure = sum(each["certainty"] == "unsure" for each in told.asked.values())
    guesses = f"; {len(told.asked)} guesses unconfirmed, {unsure} unsure" if told.asked else ""
    checked = "not checked" if told.findings is None else f"{told.findings} findings" if told.findings else "ok"
    fits = zip(told.fit, ("a step ahead", "in open loop"), strict=True)
    rows = [
        ("data", f"{checked}{guesses}"),
        ("speed", f"{_words(told.boats, SPEED)} at full command"),
        ("response", f"time constant {_words(told.boats, TIME)}; turns {_words(told.boats, RATE)}"),
        ("error", "; ".join(told.errors) or "unknown"),
        ("fit", ", ".join(f"{x:.1f} % {how}" for x, how in fits if x is not None) or "unknown"),
        ("alarms", _alarms(told.alarms)),
    ]
    return [f"{label:13}{printable(words)}" for label, words in rows]


def _words(boats: Mapping[str, Quantities], name: str) -> str:
    """A quantity with its interval, of several boats from the least to the greatest."""
    every = [each[name] for each in boats.values() if name in each and known(each[name])]
    if not every:
        return "not known"
    turn, unit = name == RATE, "°/s" if name == RATE else every[0].unit
    numbers = [[math.degrees(x) if turn else x for x in each[:3]] for each in every]
    if len(boats) == 1:
        value, low, high = map(shown, numbers[0])
        return f"{value} {unit} ({low} to {high})"
    values = sorted(each[0] for each in numbers)
    return f"{shown(values[0])} to {shown(values[-1])} {unit} ({len(every)} of {len(boats)} boats)"


def _alarms(alarms: Sequence[str] | None) -> str:
    if alarms is None:
        return "nobody watched the thrusters"
    return f"{alarms[0]}{f' and {len(alarms) - 1} more' if len(alarms) > 1 else ''}" if alarms else "none"


def undetermined(boats: Mapping[str, Quantities], names: Iterable[str]) -> list[str]:
    """The quantities of some names that are not determined of a boat."""
    return [name for name in names if any(name in each and not known(each[name]) for each in boats.values())]
