"""A short delay between commands and speed: one equation of motion for each delay, and which of them fits best.

A correlation cannot tell a delay from inertia. The equation of motion can, since it contains the speed itself:

    v(t + h) − v(t) = h mean(a τ_L + b τ_L|τ_L| + c τ_R + d τ_R|τ_R| + e v + f v|v| + g|r|v + k|τ_L − τ_R| + l)

with means over h = 2 s, the turn r, and the commands τ at their time less the delay. The coefficients are fitted for
each delay by least squares, on the same bins.

Thresholds, and why:

- Simulated boats without a delay give -2 to 1 s: filters delay a speed, and an autopilot that follows the speed makes
  later commands tell of it. The best of these is compared with the best of all.
- A delay is told from 3 s on: 2 s fit best at times where a thruster dies on the way. A speed before its commands by
  3 s or more is told only where a delay is configured, which then is the cause; by 5 s or more always.
- The squares of residuals have to be less than at a usual delay by 15 % in all and by 4 standard errors of the means
  of blocks of 20 s (neighbouring residuals depend on each other), or by 30 % and 2.4: a few changes of speed make most
  of the squares of a log of ten minutes.
- The equation has to explain 30 % of the changes of speed, over nine minutes or more: in six minutes of a boat with a
  dead thruster, a delay of 2 s fits better at times. In shorter logs, from 2.5 minutes on, 5 s or more are told where
  the squares halve and the equation explains 60 %: clocks that differ, such as GPS time and UTC.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import bin_edges, bin_means, bin_rates, clipped
from usvlearn.logs.channels.channel import COMMANDS, SURGE
from usvlearn.logs.checks.evidence import Evidence
from usvlearn.logs.checks.finding import Finding, override
from usvlearn.logs.checks.thrusters import CLOCKS, LONGEST, implausible_lag, restamped

STEP, OVER = 0.5, 4  # s, of the bins; bins of h
DELAYS = range(-12, 26)  # s
USUAL = range(-2, 2)  # s
LATE, EARLY = 3, -3  # s
BLOCK, ENOUGH, SHORT = 40, 1080, 300  # bins: 20 s, 9 min, 2.5 min
FAR, CLEAR = 5, (0.5, 0.6)  # s; ratio of squares and share explained: of clocks that differ, in a short log
SURE = ((4.0, 0.85), (2.4, 0.7))  # standard errors, and the ratio of squares
EXPLAINED = 0.3


class Fit(NamedTuple):
    """The delay that fits the equation of motion best."""

    delay: int  # s, beyond the configured one
    certainty: float  # standard errors by which it fits better than a usual one
    ratio: float  # of the squares of residuals, to those of the best usual delay
    explained: float  # share of the squared changes of speed
    bins: int


def best_delay(e: Evidence) -> Fit | None:
    """Fit the equation of motion for each delay; None if there is too little evidence."""
    edges = bin_edges(STEP, e.series[SURGE], e.series["heading"])
    bins = len(edges) - 1
    if bins < SHORT:
        return None
    speed = clipped(bin_means(e.series[SURGE], edges))
    turn = np.abs(clipped(bin_rates(e.series["heading"], edges, wraps=True)))
    left, right = (bin_means(e.series[name], edges, held=True) for name in COMMANDS)
    at = np.full(bins + 1, np.nan)  # speeds at the edges
    at[1:-1] = (speed[:-1] + speed[1:]) / 2
    forces = _means(left, left * np.abs(left), right, right * np.abs(right), np.abs(left - right))
    motion = _means(speed, speed * np.abs(speed), turn * speed, np.ones(bins))
    change, size = at[OVER:] - at[:-OVER], motion.shape[1]
    ahead = round(DELAYS[-1] / STEP)
    forces = np.pad(forces, ((0, 0), (ahead, round(-DELAYS[0] / STEP))), constant_values=np.nan)
    parts = {delay: slice(ahead - round(delay / STEP), ahead - round(delay / STEP) + size) for delay in DELAYS}
    unknown = ~np.isfinite(forces.sum(0))
    known = np.isfinite(change + motion.sum(0)) & ~np.any([unknown[part] for part in parts.values()], axis=0)
    goal, count = change[known], int(known.sum())
    if count < SHORT or not np.ptp(goal) > 0:
        return None
    squares = {}
    for delay, part in parts.items():
        rows = np.concatenate([forces[:, part][:, known], motion[:, known]])
        rows /= np.maximum(np.sqrt(np.mean(rows**2, axis=1, keepdims=True)), 1e-12)
        gram = rows @ rows.T + 1e-9 * count * np.eye(len(rows))
        squares[delay] = (goal - np.linalg.solve(gram, rows @ goal) @ rows) ** 2
    sums = {delay: float(each.sum()) for delay, each in squares.items()}
    best, usual = min(sums, key=sums.__getitem__), min(USUAL, key=sums.__getitem__)
    gain = (squares[usual] - squares[best])[: count // BLOCK * BLOCK].reshape(-1, BLOCK).mean(1)
    error = float(gain.std(ddof=1)) / math.sqrt(len(gain))
    explained = 1 - sums[best] / float(((goal - goal.mean()) ** 2).sum())
    if not (error > 0 and sums[usual] > 0):
        return None
    return Fit(best, float(gain.mean()) / error, sums[best] / sums[usual], explained, count)


def _means(*values: np.ndarray) -> np.ndarray:
    """Means over h, `(values, bins + 1 - OVER)`; NaN where one bin is not known."""
    return np.lib.stride_tricks.sliding_window_view(np.stack(values), OVER, axis=1).mean(2)


def short_delay(e: Evidence) -> Iterator[Finding]:
    """A speed that follows the commands seconds too late, or a configured delay that is too long."""
    if implausible_lag(e) is not None:
        return
    found, given = best_delay(e), float(max((each.delay for each in e.logs(COMMANDS[0])), default=0.0))
    if found is None or found.explained < EXPLAINED:
        return
    if not any(found.certainty >= certain and found.ratio <= ratio for certain, ratio in SURE):
        return
    clear = abs(found.delay) >= FAR and found.ratio <= CLEAR[0] and found.explained >= CLEAR[1]
    if found.bins < ENOUGH and not clear:
        return
    early = found.delay <= EARLY and (given > 0 or found.delay <= -FAR)
    if found.delay in (DELAYS[0], DELAYS[-1]) or not (found.delay >= LATE or early):
        return
    side = "behind" if found.delay > 0 else "before"
    text = f"changes of speed that fit commands {abs(found.delay)} s {side} best (squares × {found.ratio:.2f})"
    right = max(0.0, given + found.delay)
    fix = " ".join(override(name, {"delay": right}) for name in COMMANDS) if given != right <= LONGEST else ""
    expected = f"less than {LATE} s" + (
        f" (a longer one hardly is: {CLOCKS})" if fix else f": {restamped(found.delay)}"
    )
    yield Finding(e.boat, f"commands, {SURGE}", "delay", text, expected, fix)
