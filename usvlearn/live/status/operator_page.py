"""The operator's page: what a node says to the person who watches it, as lines of plain ASCII text."""

from __future__ import annotations

import math
import textwrap
from typing import Any

from usvlearn.live.health import Health, quantity, seconds
from usvlearn.live.node import Step

WIDTH = 78
QUANTITIES = ("steady_speed_full", "time_constant", "stopping_distance", "thrust_ratio")  # those that are shown
FAR = 10.0  # s: the place that is shown is that of the first horizon from there on
COUNTED = 6  # channels with rejected messages


def page(health: Health, step: Step | None = None) -> list[str]:
    """The page, lines of at most `WIDTH` characters.

    >>> from usvlearn.live.health import COMPILING
    >>> page(COMPILING)[0]
    'State       compiling: preparing compiled code, for minutes at the first start'
    """
    lines = _wrapped("State", health.sentence if health.state == "ok" else f"{health.state}: {health.sentence}")
    saved = f"{seconds(health.saved)} ago" if math.isfinite(health.saved) else "not yet"
    lines.append(_line("Running", f"{seconds(health.uptime)}, last saved {saved}"))
    if step is not None:
        lines += _speeds(step)
    lines += _wrapped("Alarm", f"{health.loss or 'none'} ({health.alarms} so far)")
    for name, network in health.contraction.items():
        lines += _wrapped(f"Network {name}"[:11], _network(network))
    if health.refit is not None:
        lines += _wrapped("Values", health.refit.sentence)
    source = health.refit.quantities if health.refit is not None and health.refit.use else health.identified
    shown = [(name, source[name]) for name in QUANTITIES if name in source]
    for name, each in shown:
        lines.append(_line(name[:20].replace("_", " "), quantity(*each), 21))
    lines += [part for each in health.notes for part in _wrapped("Note", each)]
    heard = [
        f"{part} {seconds(age)} ago" if math.isfinite(age) else f"{part} never" for part, age in health.ages.items()
    ]
    lines += _wrapped("Received", ", ".join(heard) or "nothing yet")
    counts = [f"{name} {cause} {n}" for name, causes in health.counts.items() for cause, n in causes.items()]
    lines += _wrapped("Not used", ", ".join(counts[:COUNTED]) or "none")
    lines += [part for each in health.warnings for part in _wrapped("Warning", each)]
    return [line.encode("ascii", "replace").decode() for line in lines]


def _speeds(step: Step) -> list[str]:
    measured = f"{step.measured:.2f}" if math.isfinite(step.measured) else "unknown"
    found = [_line("Speed", f"measured {measured}, predicted {_interval(step.speed, step.low, step.high)} m/s")]
    if math.isfinite(step.next):
        found.append(_line("Next", f"{_interval(step.next, step.next_low, step.next_high)} m/s under these commands"))
    if step.forecasts:
        horizon, each = list(step.forecasts.items())[-1]
        _, low, high = step.if_held[horizon]
        stays = f", ({low:.2f} ... {high:.2f}) if commands stay" if math.isfinite(low) else ""
        found.append(_line(f"In {horizon:g} s", f"{_interval(*each)} m/s{stays}"))
    if step.places:
        horizon, place = next((item for item in step.places.items() if item[0] >= FAR), [*step.places.items()][-1])
        size = f", within {place.major:.1f} x {place.minor:.1f} m" if math.isfinite(place.major) else ""
        where = f"{place.north:.1f} m north, {place.east:.1f} m east, heading {place.heading:.0f} deg"
        found.append(_line(f"Track {horizon:g} s", where + size))
    return found


def _interval(value: float, low: float, high: float) -> str:
    if not math.isfinite(value):
        return "unknown"
    return f"{value:.2f} ({low:.2f} ... {high:.2f})" if math.isfinite(low) else f"{value:.2f} (no interval yet)"


def _network(network: dict[str, Any]) -> str:
    if network["rate"] is None:
        return "its weights are not finite"
    verdict = f"contracting by {network['condition']}" if network["contracting"] else "not certified contracting"
    constant = "" if network["time_constant"] is None else f" ({network['time_constant']:.3g} s)"
    rest = "" if network["equilibrium"] is None else f", equilibrium at rest {network['equilibrium']:.2f} m/s"
    return f"{verdict}, K = {network['rate']:.4f} a step{constant}{rest}"


def _line(title: str, text: str, width: int = 11) -> str:
    return f"{title:<{width}} {text}"[:WIDTH]


def _wrapped(title: str, text: str) -> list[str]:
    return textwrap.wrap(f"{title:<11} {text}", WIDTH, subsequent_indent=" " * 12) or [title]
