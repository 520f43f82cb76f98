"""A plan as files: a table (CSV), and a script of uTimerScript (MOOS-IvP).

*CSV*: a row for each change of a command or of the wanted heading. Commands are shares of full scale, as the logs have
been read. `throttle` and `steering` are half the sum and half the difference of both, which is what a skid-steering
autopilot mixes to left and right.

*MOOS*: an event of uTimerScript posts `val` to `var` at `time` s after its start. It posts the commands themselves, by
the names and units of the logs that the boat was learned from. Nobody holds the heading then, so that a person must
watch; the wanted headings are in the CSV, for a boat with a heading controller.

*ArduPilot*: no mission can state the commands. To sail them, send throttle and steering as RC overrides in MANUAL.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from usvlearn.logs.channels.channel import COMMANDS, UNITS, Source
from usvlearn.logs.setup import Setup
from usvlearn.model.planning.course import Course
from usvlearn.model.planning.exchange import BestCourse

MOOS_NAMES = {"command_left": "DESIRED_THRUST_L", "command_right": "DESIRED_THRUST_R"}  # without logs of MOOS
MOOS_SPAN = 100.0  # percent
ALOG = ".Alog"


def changes(course: Course) -> np.ndarray:
    """The steps at which a command or the wanted heading changes, and the first one."""
    watched = np.stack([course.left, course.right, course.wanted])
    return np.flatnonzero(np.append(True, (np.abs(np.diff(watched)) > 1e-9).any(0)))


def csv_lines(plan: BestCourse) -> Iterator[str]:
    """The table, with the expected speed and place at each time; it starts at rest, and the last row ends the plan."""
    course = plan.course
    speed, path = np.append(0.0, plan.expected.speed), np.concatenate([np.zeros((1, 2)), plan.path])
    yield "time_s,left,right,throttle,steering,heading_deg,expected_speed_m_s,expected_north_m,expected_east_m"
    for k in changes(course).tolist():
        yield _row(course, k, k * course.dt, float(course.left[k]), float(course.right[k]), speed, path)
    yield _row(course, len(course.left), len(course.left) * course.dt, 0.0, 0.0, speed, path)


def _row(course: Course, k: int, time: float, left: float, right: float, speed: np.ndarray, path: np.ndarray) -> str:
    heading = math.degrees(course.wanted[min(k, len(course.wanted) - 1)]) % 360
    numbers = (left, right, (left + right) / 2, (left - right) / 2)
    return ",".join(
        [f"{time:.1f}", *(f"{x:.3f}" for x in numbers), f"{heading:.0f}", f"{speed[k]:.2f}"]
        + [f"{x:.1f}" for x in path[k]]
    )


def moos_lines(plan: BestCourse, setup: Setup | None) -> Iterator[str]:
    """The block of uTimerScript.

    Args:
        setup: of the boat; names and units are taken from it if its logs were those of MOOS.
    """
    sources, note = _variables(setup)
    yield f"// A plan of usvlearn: {len(plan.course.left) * plan.course.dt:.0f} s. {note}"
    yield "// It begins when UTS_PAUSE=false is posted. Stop other posts of these variables first (pHelmIvP, the PID)."
    yield "// Nobody holds the heading: watch the boat, and be ready to take over."
    yield "ProcessConfig = uTimerScript"
    yield "{"
    yield "  AppTick   = 10"
    yield "  CommsTick = 10"
    yield ""
    yield "  paused    = true"
    yield "  pause_var = UTS_PAUSE"
    yield ""
    course = plan.course
    before: dict[str, str] = {}
    rows = [(k * course.dt, course.left[k], course.right[k]) for k in changes(course).tolist()]
    for time, *values in [*rows, (len(course.left) * course.dt, 0.0, 0.0)]:
        for source, share in zip(sources, values, strict=True):
            raw = f"{source.zero + source.span * share / UNITS[source.unit][0]:.6g}"
            if before.get(source.name) != raw:
                yield f"  event = var={source.name}, val={raw}, time={time:.1f}"
            before[source.name] = raw
    yield "}"


def _variables(setup: Setup | None) -> tuple[list[Source], str]:
    """Left and right as they are posted, and where their names are from."""
    own = [setup.channels.get(name) for name in COMMANDS] if setup and (setup.reader or "").endswith(ALOG) else []
    named = [each for each in own if isinstance(each, Source) and "*" not in each.name]
    if len(named) == len(COMMANDS):
        plain = [Source(each.name.partition("@")[0], None, each.unit, each.zero, each.span) for each in named]
        return plain, "Names and units are those of the logs."
    given = [Source(MOOS_NAMES[name], span=MOOS_SPAN) for name in COMMANDS]
    return given, "Names and units (percent) are assumed: the boat was not learned from single MOOS variables."
