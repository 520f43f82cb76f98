"""Checks data before a run: is what was read likely to be what the configuration says that it is?

Wrong units, reversed sides and delays do not stop a run: it prints plausible numbers. Each check compares channels with
each other and with physics, on all runs of a boat together, and yields findings with the setting that corrects them. A
check that lacks its evidence is silent. The page `docs/troubleshooting.md#the-data-check` lists the thresholds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from usvlearn.core.samples import Fleet
from usvlearn.errors import LogFormatError, check_choice
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.checks import course, delivery, frozen, response, scales, thrusters, track
from usvlearn.logs.checks.evidence import Evidence
from usvlearn.logs.checks.finding import WARNING, Finding

CHECKS: tuple[Callable[[Evidence], Iterator[Finding]], ...] = (
    scales.zeros, scales.rest, scales.speed_scale, scales.sign, scales.command_scale, scales.heading_unit,
    scales.heading_sense, scales.yaw_rate, track.degrees, track.axes, track.follows, track.sway,
    thrusters.sides, response.delays, thrusters.excitation, response.clocks, course.compass,
    course.compass_of_runs, thrusters.lost,
    frozen.frozen, delivery.rejected, delivery.stale, delivery.copies, delivery.clock, delivery.horizons,
    delivery.together, delivery.jumps, scales.runs, thrusters.sides_of_runs,
)  # fmt: skip
COMPASS = "compass", "compass of runs", "compass drift"
# kind of a finding -> kinds that follow from it, and are left out beside it
CONSEQUENCES = {
    **dict.fromkeys(("speed unit", "speed scale", "yaw rate unit"), ("rejected", "stale")),
    "speeds of runs": ("speed unit", "speed scale", "rejected", "stale"),
    "sides of runs": ("sides or heading", "sides swapped", "side reversed", "thruster lost"),
    "commands of runs": ("command scale", "thrust", "delay", "excitation"),
    "heading unit": ("rejected", "stale", "position", "position axes", "jumps"),
    **dict.fromkeys(COMPASS[1:], ("compass", "heading offset", "course", "clocks", "position")),
    "position axes": COMPASS,
    "command scale": ("rejected", "stale", "excitation"),
    "constant": ("thrust", "position"),
    "side reversed": ("thrust", "speed sign"),
    "sides or heading": ("speed sign",),
    "clock drift": ("delay", "clocks", "stale", "position"),
    "delay": ("stale", "position"),
    "delay of runs": ("delay",),
    "frozen": ("delay", "position"),
    "position unit": ("speed unit", "heading sense", "heading offset", "position", "position axes", "jumps", *COMPASS),
    "velocity axes": ("speed unit", "speed scale", "sides or heading", "side reversed", "thrust"),
}
LEVELS = ("warn", "strict", "off")


def check_level(level: Any) -> str:
    """What is done with findings: "warn" (by default), "strict" or "off", which YAML reads as false."""
    return check_choice("check", "warn" if level is None else "off" if level is False else level, LEVELS)


def check_data(
    recordings: Iterable[Recording],
    fleet: Fleet | None,
    align: Mapping[str, Any],
    surge_max: float = math.inf,
    channels: Mapping[str, Any] | None = None,
    horizons: Sequence[float] = (),
) -> list[Finding]:
    """All findings about recordings of one or several boats, warnings first.

    The fleet is None if they could not be aligned by these options of `Aligner`; `surge_max` is the boats' top speed,
    m/s, infinite where it is not known; `channels` are those of the configuration, for the overrides that are proposed;
    the horizons are those of the forecasts, s.
    """
    boats: dict[str, list[Recording]] = {}
    for one in recordings:
        boats.setdefault(one.boat, []).append(one)
    evidence = [Evidence(boat, logs, fleet, align, surge_max, channels or {}, horizons) for boat, logs in boats.items()]
    findings = [finding for each in evidence for check in CHECKS for finding in check(each)]
    causes = {(each.boat, kind) for each in findings for kind in CONSEQUENCES.get(each.kind, ())}
    remaining = [each for each in dict.fromkeys(findings) if (each.boat, each.kind) not in causes]
    return sorted(remaining, key=lambda each: each.severity != WARNING)


def refuse(findings: Sequence[Finding]) -> None:
    """Raise one LogFormatError that lists all warnings, if there are any."""
    wrong = [finding.sentence() for finding in findings if finding.severity == WARNING]
    if wrong:
        listed = "; ".join(f"({k}) {each}" for k, each in enumerate(wrong, 1))
        count = f"{len(wrong)} warning{'s' * (len(wrong) > 1)}"
        raise LogFormatError(f"check=strict: found {count}, expected none: {listed}; or check=warn")
