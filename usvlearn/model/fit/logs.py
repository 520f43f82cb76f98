"""A run's logs as missions to fit, on a grid of their own.

The run predicts a step of some tenths of a second ahead; its samples hold the mean command over that step, and the yaw
rate of two headings. Both bend what is fitted: thrust is not linear in the command, and noise in the yaw rate makes
|r| larger on a straight course and smaller beside its true size in a turn. Here the grid is finer, and the yaw rate is
that of a parabola through the headings around each step (Savitzky & Golay 1964), which may look ahead, because the
whole log is there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.events import BOTH, LOSS, RECOVERY, SIDES, event_of
from usvlearn.core.prepared_samples import COS, HOLD, LEFT, MODE, PREDICT, RIGHT, ROW, SIN, SURGE, YAW_RATE
from usvlearn.core.samples import Fleet, Sample, tree_map
from usvlearn.errors import ConfigError, complain
from usvlearn.estimators.joint.excitation_warnings import ONE_COMMAND
from usvlearn.logs.channels.correlations import without_sign
from usvlearn.logs.channels.poses import reckoned, slope
from usvlearn.model.fit.gauss_newton import rows_of, scored

DT = 0.1  # s, of the grid
ALONG, ACROSS = ROW + 2, ROW + 3  # places of `over_ground` in a row of a mission
WINDOW = 3.0  # s, of the parabola
FEWEST = 600  # measured steps, below which nothing is fitted
CHANGE = 0.02  # standard deviation of the mean command, below which nothing tells thrust from drag
APART = 0.02  # likewise of the difference of the sides
MOVES, TURNS = 0.15, 0.02  # m/s; mean square of the sine to the main heading
BEFORE = 60.0  # s before an alarm, in which the thruster may have been weak already
ASTERN, SMALL, LARGE, SOME = -0.1, 0.15, 0.85, 0.01  # commands; share of the steps


def fine(align: Mapping[str, Any]) -> dict[str, Any]:
    """The options of an alignment on the grid of the fit, from those of a run."""
    return {**align, "dt": DT, "steps": "grid"}


def missions_of(fleet: Fleet, boat: str, dt: float = DT) -> dict[str, np.ndarray]:
    """The missions of a boat, by name, of logs on a grid of `dt`, s; those without measured steps are left out.

    They are prepared samples with `turns` and `over_ground` behind, `(time, ROW + 4)`. A ConfigError if there are too
    few measured steps in which the boat moves, or the speed has no sign.
    """
    element, missions = fleet.boats.index(boat), dict[str, np.ndarray]()
    for k, run in enumerate(fleet.runs):
        if length := run.lengths[element]:
            samples, time = tree_map(lambda x, n=length: x[:n, element], run.samples), run.time[:length, element]
            rows = rows_of(samples)
            if scored(rows).any():
                name = run.names[element] if run.names[element] not in missions else f"{run.names[element]} ({k + 1})"
                poses = np.full((length, 5), np.nan) if run.poses is None else run.poses[:length, element]
                parts = smoothed(rows, dt), turns(poses, time), over_ground(samples, poses, time, dt)
                missions[name] = np.column_stack(parts)
    back = sum(float(without_sign(rows[:, LEFT], rows[:, RIGHT], rows[:, SURGE]).sum()) for rows in missions.values())
    if back:
        raise ConfigError(
            f"{boat}: found {back * dt / 60:.1f} min in which both commands push astern and the speed, which is never "
            "below 0, rises, expected a speed with a sign: set velocities to the north and east, ground speed and "
            "course, or the position alone in data.channels, and train again, or leave these logs out"
        )
    measured = sum(int(scored(rows).sum()) for rows in missions.values())
    if measured < FEWEST:
        raise ConfigError(
            f"{boat}: found {measured} measured speeds of a boat that moves, expected at least {FEWEST}: a fit needs "
            "some minutes of logs in which the boat sails"
        )
    return missions


def without_losses(
    boat: str, missions: Mapping[str, np.ndarray], events: Sequence[Mapping[str, Any]], tell: bool = True
) -> dict[str, np.ndarray]:
    """The missions without the times in which a thruster lacked thrust, by the `events` of `results.json`.

    `tell` warns of each; a ConfigError if too little is left.
    """
    cut, lost, said = dict[str, np.ndarray](), set[str](), ""
    for name, rows in missions.items():
        cut[name], place = rows.copy(), np.arange(len(rows)) * DT
        cut[name][:, MODE] = HOLD if lost else rows[:, MODE]
        for each in (each for each in events if each["run"] == name and each["kind"] in (LOSS, RECOVERY)):
            begins, side = each["kind"] == LOSS, set(SIDES) if each["side"] == BOTH else {each["side"]}
            lost = lost | side if begins else lost - side
            later = place >= each["time"] - BEFORE * begins
            cut[name][later, MODE] = HOLD if lost else rows[later, MODE]
            if begins:
                said = f"{boat}: {event_of(each).name} lost thrust at {each['time']:.0f} s of {name} (run's events)"
                if tell:
                    complain(f"warning: {said}: the fit leaves out what follows until its recovery")
    if said and (left := sum(int(scored(rows).sum()) for rows in cut.values())) < FEWEST:
        raise ConfigError(
            f"{said}: found {left} measured steps with both thrusters whole, expected at least {FEWEST}: fit logs from "
            "before that, or from after its repair (data.path)"
        )
    return {name: rows for name, rows in cut.items() if scored(rows).any()}


def turns(poses: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Measured headings and yaw rates, `(time, 2)`, NaN where a heading repeats the last one, and for slopes of it."""
    measured = poses[:, :2].copy()
    turned, step = np.diff(measured[:, 0], prepend=np.nan), np.diff(time, prepend=np.nan)
    measured[np.abs(measured[:, 1] - slope(turned, step)) < 1e-9, 1] = np.nan
    measured[turned == 0, 0] = np.nan
    return measured


def over_ground(samples: Sample, poses: np.ndarray, time: np.ndarray, dt: float) -> np.ndarray:
    """The velocity over ground along and across the heading, m/s, `(time, 2)`, by course or sway, fixes, or NaN."""
    heading, aside, place = poses[:, 0], poses[:, 2], poses[:, 3:]
    surge, known = np.where(samples.measured, samples.surge, np.nan), np.isfinite(place[:, 0])
    added, count = reckoned(time, heading, surge, aside)[0], 2 * round(WINDOW / dt / 2) + 1
    if np.isfinite(aside).any() or not known.sum() > count > 2 or np.abs(place - added)[known].max() < 1e-3:
        return np.column_stack([surge, aside])
    arms = count // 2 - np.arange(count)  # of the slope of a parabola at its middle
    whole = [np.convolve(np.interp(time, time[known], each), arms, "valid") for each in place[known].T]
    north, east = (np.pad(each / (arms @ arms * dt), count // 2, constant_values=np.nan) for each in whole)
    c, s = np.cos(heading), np.sin(heading)
    return np.where(known[:, None], np.column_stack([c * north + s * east, c * east - s * north]), np.nan)


def smoothed(rows: np.ndarray, dt: float) -> np.ndarray:
    """Prepared samples with the yaw rate of a parabola over `WINDOW`, as far as there are enough steps."""
    count, steps = 2 * round(WINDOW / dt / 2) + 1, rows[:, MODE] >= PREDICT
    if count < 4 or steps.sum() <= count:
        return rows
    rows, places = rows.copy(), np.arange(len(rows))
    rate = np.interp(places, places[steps], rows[steps, YAW_RATE])
    basis, half = np.vander(np.arange(count) - count // 2, 3), count // 2
    fitted = basis @ np.linalg.pinv(basis)  # (count, count), of a parabola through so many steps
    ends = fitted[:half] @ rate[:count], fitted[half + 1 :] @ rate[-count:]
    rows[steps, YAW_RATE] = np.concatenate([ends[0], np.convolve(rate, fitted[half], "valid"), ends[1]])[steps]
    return rows


def lacking(boat: str, missions: Sequence[np.ndarray]) -> tuple[str, ...]:
    """What commands and headings do not show, a sentence each; a ConfigError if speed or commands hardly change."""
    rows = np.concatenate([each[scored(each)] for each in missions])
    commands, speed = rows[:, [LEFT, RIGHT]], rows[:, SURGE]
    mean = commands.mean(1)
    if mean.std() < CHANGE:
        raise ConfigError(
            f"{boat}: found commands that hardly ever changed while the boat moved ({100 * np.median(mean):.0f} %), "
            "expected steps between low and high ones: thrust and drag show where they change"
        )
    slow, fast = np.quantile(speed, [SOME, 1 - SOME])
    if fast - slow < MOVES:
        raise ConfigError(
            f"{boat}: found speeds of {slow:.2f} to {fast:.2f} m/s that hardly ever changed, expected a boat that "
            "speeds up and slows down: check the speed channel"
        )
    size, axes = np.abs(commands), rows[:, [COS, SIN]]
    most = 100 * float(np.quantile(size.max(1), 1 - SOME))
    bins = np.histogram(size, np.arange(0.0, 1.1, 0.05))[0] > SOME * size.size
    levels = int((np.diff(np.append(0, bins.astype(int))) > 0).sum())
    checks = {
        ONE_COMMAND: np.std(commands[:, 0] - commands[:, 1]) < APART,
        "The thrusters hardly ever pushed astern: their thrust astern is an assumption.":
            not ((commands < ASTERN).mean(0) > SOME).all(),
        f"Commands were hardly ever above {most:.0f} %: what is beyond is an extrapolation.":
            (size > LARGE).any(1).mean() < SOME,
        f"Commands were hardly ever below {100 * SMALL:.0f} %: a dead band would not show.":
            ((size > SOME) & (size < SMALL)).any(1).mean() < SOME,
        f"Only {levels} levels of the command were used: the thrust between them is an assumption.":
            levels <= 2 and bins.sum() <= 3,
        "The boat kept one heading, or its opposite: the current cannot be separated from the boat's own speed.":
            np.linalg.eigvalsh(axes.T @ axes / len(axes))[0] < TURNS,
    }  # fmt: skip
    return tuple(sentence for sentence, lacks in checks.items() if lacks)
