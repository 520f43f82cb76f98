"""What a node publishes, whatever the middleware: one table of names, units and meanings."""

from __future__ import annotations

import math
from typing import NamedTuple

from usvlearn.live.health import Health
from usvlearn.live.node import Step

NUMBER, TEXT = "D", "S"


class Post(NamedTuple):
    """One published value."""

    name: str
    value: float | str


class Published(NamedTuple):
    """A line of the table."""

    name: str
    kind: str  # NUMBER or TEXT
    unit: str
    when: str
    meaning: str
    short: str = ""  # name of at most 10 characters, for MAVLink; "": not sent there


STEP, SECOND, SELDOM, RAISED, ASKED = "each step", "each second", "every 5 s", "when raised", "on a plan"
PLANNED, TRACK = "PLAN_FORECAST", "TRACK"  # the answer to a plan; where the boat will be
TABLE = (
    Published("SPEED_PRED", NUMBER, "m/s", STEP, "predicted speed of the sample that was just measured", "USV_PRED"),
    Published("SPEED_LOW", NUMBER, "m/s", STEP, "lower end of its 90 % interval", "USV_LOW"),
    Published("SPEED_HIGH", NUMBER, "m/s", STEP, "upper end of its 90 % interval", "USV_HIGH"),
    Published("SPEED_ERROR", NUMBER, "m/s", STEP, "measured minus predicted speed", "USV_ERR"),
    Published("SPEED_NEXT", NUMBER, "m/s", STEP, "predicted speed of the next step under the commands in force",
              "USV_NEXT"),
    Published("SPEED_NEXT_LOW", NUMBER, "m/s", STEP, "lower end of its 90 % interval", "USV_NLOW"),
    Published("SPEED_NEXT_HIGH", NUMBER, "m/s", STEP, "upper end of its 90 % interval", "USV_NHIGH"),
    Published("FORECAST", TEXT, "s: m/s", STEP,
              "speeds under the commands in force, intervals whatever is commanded: 10=1.23:1.10:1.36,…"),
    Published("FORECAST_IF_HELD", TEXT, "s: m/s", STEP, "the same, intervals where the commands stay"),
    Published(TRACK, TEXT, "s: m, deg", STEP,
              "places if the commands stay: north, east, heading and ellipse, 10=9.80:1.20:8.5:1.10:0.60:95.0,…"),
    Published(PLANNED, TEXT, "s: m/s", ASKED,
              "speeds, or places as above, under a plan that was posted, or why there are none"),
    Published("MEMBERS", TEXT, "m/s", STEP, "prediction of each member and combiner, where members are asked for"),
    Published("ALARM", TEXT, "", RAISED, "a thruster has lost thrust, and how much of it is left"),
    Published("EVENT", TEXT, "", RAISED, "the same, what the filters got, a recovery, or another change of the boat"),
    Published("PARAMS", TEXT, "", SELDOM, "identified quantities, as drag_linear=-20.7,thrust_full_left=18.2,…"),
    Published("REFIT", TEXT, "", SELDOM,
              "batch fit of the missions, and which values to use: use=fit,missions=2,time_constant=1.63:1.46:1.83,…"),
    Published("CONTRACTING", TEXT, "", SELDOM, "verdict on each network, by which condition"),
    Published("CONTRACTION_RATE", NUMBER, "a step", SELDOM, "rate K of the first network; below 1: contracting",
              "USV_K"),
    Published("EQUILIBRIUM", NUMBER, "m/s", SELDOM, "speed at which the first network stays, without thrust", "USV_EQ"),
    Published("HEALTH", TEXT, "", SECOND, "state, what is missing, counts, time since the last save"),
)  # fmt: skip
KINDS = {each.name: each.kind for each in TABLE}


def of_step(step: Step, members: bool = False) -> list[Post]:
    """What is published of one step; numbers that are not known are left out.

    Args:
        step: of the node.
        members: whether the predictions of all members are wanted.
    """
    numbers = {
        "SPEED_PRED": step.speed, "SPEED_LOW": step.low, "SPEED_HIGH": step.high,
        "SPEED_ERROR": step.measured - step.speed, "SPEED_NEXT": step.next, "SPEED_NEXT_LOW": step.next_low,
        "SPEED_NEXT_HIGH": step.next_high,
    }  # fmt: skip
    found = [Post(name, value) for name, value in numbers.items() if math.isfinite(value)]
    for name, forecasts in (("FORECAST", step.forecasts), ("FORECAST_IF_HELD", step.if_held)):
        if forecasts:
            found.append(Post(name, ",".join(f"{horizon:g}={_ends(each)}" for horizon, each in forecasts.items())))
    places = {horizon: point for horizon, point in step.places.items() if all(map(math.isfinite, point[:3]))}
    if places:
        found.append(Post(TRACK, ",".join(f"{horizon:g}={point.text}" for horizon, point in places.items())))
    if members and step.members:
        found.append(Post("MEMBERS", ",".join(f"{name}={value:.3f}" for name, value in step.members.items())))
    found += [Post("ALARM", event.sentence) for event in step.events if event.is_alarm]
    return found + [Post("EVENT", event.sentence) for event in step.events]


def _ends(forecast: tuple[float, float, float]) -> str:
    """A speed with the ends of its interval, where these are known."""
    return ":".join(f"{x:.3f}" for x in (forecast if math.isfinite(forecast[1]) else forecast[:1]))


def of_health(health: Health) -> list[Post]:
    """What is published each second; the shell may send what changes seldom less often."""
    found = [Post("HEALTH", told(health))]
    known = {name: each[0] for name, each in health.identified.items() if math.isfinite(each[0])}
    if known:
        found.append(Post("PARAMS", ",".join(f"{name}={value:.4g}" for name, value in known.items())))
    if health.refit is not None:
        use, fitted = "fit" if health.refit.use else "online", health.refit.quantities
        rows = [f"{name}={value:.4g}:{low:.4g}:{high:.4g}" for name, (value, low, high, _) in fitted.items()]
        found.append(Post("REFIT", ",".join([f"use={use},missions={health.refit.missions}", *rows])))
    for name, network in list(health.contraction.items())[:1]:
        verdict = f"yes by {network['condition']}" if network["contracting"] else "not certified"
        found.append(Post("CONTRACTING", f"{name}: {verdict}"))
        for post, value in (("CONTRACTION_RATE", network["rate"]), ("EQUILIBRIUM", network["equilibrium"])):
            if value is not None:
                found.append(Post(post, float(value)))
    return found


def told(health: Health) -> str:
    """The health in one line.

    >>> from usvlearn.live.health import COMPILING
    >>> told(COMPILING)
    'state=compiling,steps=0,learned=0,alarms=0,alarm=none,saved=never,rejected=0,warnings=0'
    """
    rejected = sum(count for causes in health.counts.values() for count in causes.values())
    saved = f"{health.saved:.0f}" if math.isfinite(health.saved) else "never"
    missing = [part for part, age in health.ages.items() if not math.isfinite(age)]
    facts = {
        "state": health.state, "steps": health.steps, "learned": health.learned, "alarms": health.alarms,
        "alarm": health.alarm or "none", "saved": saved, "rejected": rejected, "warnings": len(health.warnings),
    }  # fmt: skip
    line = ",".join(f"{key}={value}" for key, value in facts.items())
    return line + (f",missing={'+'.join(missing)}" if missing and health.state != "compiling" else "")
