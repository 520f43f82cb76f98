"""The summary with which train, fit and evaluate end: at most eight lines of 80 columns."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from usvlearn.core.events import LOSS, event_of
from usvlearn.core.unconfirmed import UNSURE, Questions
from usvlearn.errors import printable
from usvlearn.estimators.joint.excitation_warnings import ONE_COMMAND, WIDE, Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified, shown, tells_sides
from usvlearn.evaluation.metrics import mean
from usvlearn.evaluation.objective import measure_of

NEAR = "10"  # s, the horizon of the summary, or else the longest that was judged
SPEED, TIME, RATE = "steady_speed_full", "time_constant", "yaw_rate_full"
Quantities = Mapping[str, Quantity]


def known(quantity: Quantity | None) -> bool:
    """Whether a quantity is determined: its 90 % interval is within ± `WIDE` of its value."""
    return quantity is not None and quantity.high - quantity.low <= 2 * WIDE * abs(quantity.value)


def displayed(identified: Identified) -> dict[str, Quantity]:
    """The quantities as people are told them."""
    return of_one_command({name: identified.displayed(name) for name in identified}, identified.lacks)


def of_one_command(found: Quantities, lacks: Sequence[str]) -> dict[str, Quantity]:
    """Quantities; where both sides had one command, without those that tell them apart."""
    return {name: each for name, each in found.items() if not (ONE_COMMAND in lacks and tells_sides(name))}


def summary(results: Mapping[str, Any], asked: Questions, boats: Mapping[str, Quantities]) -> list[str]:
    """The lines of a run, each behind its label, of `results.json` and the quantities of boats that are to be used."""
    name, check, events = results["output"], results.get("data_check"), results.get("events")
    data = "not checked" if check is None else f"{len(check)} finding{'s' * (len(check) > 1)}" if check else "ok"
    unsure = sum(each["certainty"] == UNSURE for each in asked.values())
    data += f"; {len(asked)} guesses unconfirmed, {unsure} unsure" if asked else ""
    causes = [each for boat in results.get("rejected", {}).values() for each in boat.values()]
    lost = sum(n for each in causes for cause, n in each.items() if cause != "copied")  # of a slower sensor
    data += f"; {lost} values rejected" if lost else ""
    measure = measure_of(results["measure"], "")
    errors = [f"{measure.title()} {measure.shown(results['objective'])}"] if str(measure) != f"{name}.mae" else []
    error = mean(rows[name]["mae"] for rows in results["boats"].values())
    errors += [] if error is None else [f"{error:.3f} m/s a step ahead"]
    ahead = [rows[name] for rows in (results.get("forecast") or {}).values() if name in rows]
    for horizon in [NEAR if NEAR in ahead[0] else list(ahead[0])[-1]] if ahead and ahead[0] else []:
        near = mean(row[horizon]["mae"] for row in ahead)
        tracks = [rows.get(horizon, {}) for rows in (results.get("tracks") or {}).values() if rows]
        away = mean(row.get("position") for row in tracks)
        far = "" if away is None else f" and {shown(away)} m"
        errors += [] if near is None else [f"{near:.3f} m/s{far} {horizon} s ahead"]
    near, free = (mean(rows[name]["fit"] for rows in results["boats"].values()),
                  mean(rows.get(name) for rows in results.get("free_fit", {}).values()))  # fmt: skip
    fits = [
        f"{x:.1f} % {how}"
        for x, how in ((near, "a step ahead"), (free, "in open loop over the later half"))
        if x is not None
    ]
    alarms = [f"{event_of(each).name.removeprefix('the ')} lost thrust, {boat}, "
              f"run {each['run']}, {each['time']:.0f} s"
              for boat, happened in (events or {}).items() for each in happened if each["kind"] == LOSS]  # fmt: skip
    more = f" and {len(alarms) - 1} more" if len(alarms) > 1 else ""
    rows = {
        "data": data,
        "speed": f"{_words(boats, SPEED)} at full command",
        "response": f"time constant {_words(boats, TIME)}; turns {_words(boats, RATE)}",
        "error": "; ".join(errors) or "unknown",
        "fit": ", ".join(fits) or "unknown",
        "alarms": alarms[0] + more if alarms else "nobody watched the thrusters" if events is None else "none",
    }
    return [f"{label:13}{printable(words)}" for label, words in rows.items()]


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


def undetermined(boats: Mapping[str, Quantities], names: Iterable[str]) -> list[str]:
    """The quantities of some names that are not determined of a boat."""
    return [name for name in names if any(name in each and not known(each[name]) for each in boats.values())]
