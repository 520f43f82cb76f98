"""The delay between commands and motion, and between heading and course: one fit for each delay, and which is best.

A correlation cannot tell a delay from inertia. The equation of motion can, since it contains the speed itself:

    v(t + h) − v(t) = h mean(a τ_L + b τ_L|τ_L| + c τ_R + d τ_R|τ_R| + e v + f v|v| + g|r|v + k|τ_L − τ_R| + l)

with means over h = 2 s, the turn r, and the commands τ at their time less the delay. The coefficients are fitted for
each delay by least squares, on the same bins. The turn r has the same equation with r in place of v.

Simulated boats without a delay give -2 to 1 s: filters delay a speed, and an autopilot that follows the speed makes
later commands tell of it. 2 s fit best at times where a thruster dies on the way. With a clear fit, 1 s before the
commands is told, too, as no boat does that, and a turn that is 3 s late. Where speed and turn are off by the same, the
stamps of the commands are.

A heading that is early is told from 5 s on, since filters of positions and receivers are late by up to 3 s, and drift
in a turn makes the course late, too. Nothing makes a heading late, so that one is told from the first bin on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import bin_directions, bin_edges, bin_means, bin_rates, clipped
from usvlearn.logs.channels.channel import COMMANDS, SURGE
from usvlearn.logs.checks.evidence import MOVING, Evidence, spread, without
from usvlearn.logs.checks.finding import Finding, override, see

STEP, OVER = 0.5, 4  # s, of the bins; bins of h
DELAYS = range(-25, 26)  # s
USUAL, AHEAD = range(-2, 2), range(2)  # s; of what is not before its commands
LATE, EARLY = 3, -3  # s
PLAUSIBLE = -5.0, 25.0  # s, lags of the speed
FOUND, BETTER = 0.6, 0.2  # correlation at another one, and by how much it exceeds that at plausible ones
FOLLOWS, LONG = 0.2, 300.0  # correlation; s of evidence
PAIR = f"commands, {SURGE}"
LONGEST, SAME = 12.0, 2.0  # s, of a delay that is proposed; by which two shifts of one clock differ
STEADY = 0.03  # standard deviation of a speed over its mean
CLOCKS = "the clocks of both differ, as GPS time and UTC do by 18 s, so correct the stamps of one of them"
BLOCK, ENOUGH, SHORT, PIECE = 40, 1080, 300, 240  # bins: 20 s, 9 min, 2.5 min, 2 min
FAR, CLEAR = 5, (0.5, 0.6)  # s; ratio of squares and share explained: of clocks that differ, in a short log
SURE = ((4.0, 0.85), (2.4, 0.7))  # standard errors, and the ratio of squares
EXPLAINED = 0.3
COURSE_STEP, FARTHEST = 2.0, 25  # s, of bins of the course; bins of lag that are tried
EARLIER, LATER = 5.0, 2.0  # s, of a heading that is early, and of one that is late
FITS, CLOSE = ((4.0, 0.5), (2.4, 0.25)), 0.3  # standard errors, and of the dispersion that is left; dispersion
COURSE_BLOCK, FEWEST = 10, 3  # bins: 20 s; blocks
NEAR, BOTH, SIDES_APART = range(-2, 4), 0.3, 0.5  # s; correlation of the turn with each side; ratio of squares
ODD = 3.0, 0.4  # standard errors and ratio of squares of a delay unlike that of other logs
DRIFTING = 0.55, 0.6  # share explained in each third of a log, and the ratio of squares in one, of a delay that changes


class Fit(NamedTuple):
    """The delay that fits the equation of motion best."""

    delay: int  # s, beyond the configured one
    certainty: float  # standard errors by which it fits better than a usual one
    ratio: float  # of the squares of residuals, to those of the best usual delay
    explained: float  # share of the squared changes of speed
    bins: int

    @property
    def clear(self) -> int:
        """The delay where the equation explains most and no usual delay half as much, else 0, s."""
        return self.delay if self.ratio <= CLEAR[0] and self.explained >= CLEAR[1] and self.certainty > 2.4 else 0


class Response(NamedTuple):
    """Changes of a speed or a turn over h, and what makes them, over the times at which an h begins, `(…, times)`."""

    change: np.ndarray
    motion: np.ndarray  # (4, times): its own terms
    forces: Mapping[int, np.ndarray]  # (5, times): the terms of commands that act so many s later
    known: np.ndarray


def responses(e: Evidence) -> list[Response]:
    """Those of the speed and of the turn; none if there is too little evidence."""
    edges = bin_edges(STEP, e.series[SURGE], e.series["heading"])
    bins = len(edges) - 1
    if bins < SHORT:
        return []
    speed = clipped(bin_means(e.series[SURGE], edges))
    turn = clipped(bin_rates(e.series["heading"], edges, wraps=True))
    left, right = (bin_means(e.series[name], edges, held=True) for name in COMMANDS)
    terms = _means(left, left * np.abs(left), right, right * np.abs(right), np.abs(left - right))
    size, before, after = terms.shape[1], round(DELAYS[-1] / STEP), round(-DELAYS[0] / STEP)
    terms = np.pad(terms, ((0, 0), (before, after)), constant_values=np.nan)
    places = {delay: slice(before - round(delay / STEP), before - round(delay / STEP) + size) for delay in DELAYS}
    forces, unknown = {delay: terms[:, place] for delay, place in places.items()}, ~np.isfinite(terms.sum(0))
    driven = ~np.any([unknown[place] for place in places.values()], axis=0)
    collected = []
    for value in (speed, turn):
        at = np.full(bins + 1, np.nan)  # at the edges
        at[1:-1] = (value[:-1] + value[1:]) / 2
        change = at[OVER:] - at[:-OVER]
        motion = _means(value, value * np.abs(value), np.abs(turn) * value, np.ones(bins))
        collected.append(Response(change, motion, forces, driven & np.isfinite(change + motion.sum(0))))
    return collected


def best_delay(response: Response, within: tuple[float, float] = (0.0, 1.0)) -> Fit | None:
    """Fit the equation of motion for each delay, within a part of a log; None if there is too little evidence."""
    known, size = response.known.copy(), len(response.known)
    known[: round(within[0] * size)] = known[round(within[1] * size) :] = False
    goal, count = response.change[known], int(known.sum())
    if count < (SHORT if within == (0.0, 1.0) else PIECE) or not np.ptp(goal) > 0:
        return None
    motion = response.motion[:, known]
    squares = {delay: _squares(goal, force[:, known], motion) for delay, force in response.forces.items()}
    best = min(squares, key=lambda delay: float(squares[delay].sum()))
    usual = min(USUAL if best > 0 else AHEAD, key=lambda delay: float(squares[delay].sum()))
    return Fit(best, *_better(goal, squares[best], squares[usual]), count)


def _squares(goal: np.ndarray, *rows: np.ndarray) -> np.ndarray:
    """The squares of residuals of a regression, `(times,)`."""
    table = np.concatenate(rows)
    table /= np.maximum(np.sqrt(np.mean(table**2, axis=1, keepdims=True)), 1e-12)
    gram = table @ table.T + 1e-9 * len(goal) * np.eye(len(table))
    return (goal - np.linalg.solve(gram, table @ goal) @ table) ** 2


def _better(goal: np.ndarray, best: np.ndarray, usual: np.ndarray) -> tuple[float, float, float]:
    """By how many standard errors the best squares are less, their ratio, and the share that they explain."""
    gain = (usual - best)[: len(goal) // BLOCK * BLOCK].reshape(-1, BLOCK).mean(1)
    error, left = float(gain.std(ddof=1)) / math.sqrt(len(gain)), float(best.sum())
    explained = 1 - left / float(((goal - goal.mean()) ** 2).sum())
    return float(gain.mean()) / max(error, 1e-12), left / max(float(usual.sum()), 1e-12), explained


def _means(*values: np.ndarray) -> np.ndarray:
    """Means over h, `(values, bins + 1 - OVER)`; NaN where one bin is not known."""
    return np.lib.stride_tricks.sliding_window_view(np.stack(values), OVER, axis=1).mean(2)


def implausible_lag(e: Evidence) -> float | None:
    """The lag of the speed if no boat can have it, s."""
    searched, near = e.searched, e.thrust_on_speed
    if not searched.seconds or PLAUSIBLE[0] <= searched.lag <= PLAUSIBLE[1] or searched.correlation < FOUND:
        return None
    return searched.lag if searched.correlation > max(near.correlation, 0) + BETTER else None


def delays(e: Evidence) -> Iterator[Finding]:
    """Delays of all logs together, of the thirds of the longest one, and of one log that has another."""
    whole, by_run = responses(e), [responses(log) for log in e.alone]
    yield from _delay(e, whole)
    if whole:
        yield from _apart(e, whole[1])
    longest = max(zip(e.alone, by_run, strict=True), key=lambda pair: len(pair[0].values[SURGE]), default=(e, whole))
    yield from _drift(e.boat, longest[1])
    yield from _of_runs(e, by_run)


def _delay(e: Evidence, whole: Sequence[Response]) -> Iterator[Finding]:
    """A speed or a turn that follows the commands too late, before them, or not at all."""
    speed, turn = [best_delay(each) for each in whole] or (None, None)
    lag = implausible_lag(e)
    given = float(max((each.delay for each in e.logs(COMMANDS[0])), default=0.0))
    turned, exact = (each.clear if each else 0 for each in (turn, speed))
    late = LATE - bool(speed and speed.delay < LATE - 1)  # s, of a turn: less where the speed is not late, too
    shift = exact or lag or (speed.delay if speed else 0)
    if lag is not None or (speed and _is_told(speed, given)):
        text = f"speeds {_side(shift)} the commands (r = {e.searched.correlation:.2f})"
        limits = f"{PLAUSIBLE[0]:g} to {PLAUSIBLE[1]:g} s behind them"
        if lag is None and speed:
            text = f"changes of speed that fit commands {_side(shift)} best (squares × {speed.ratio:.2f})"
            limits = f"0 to {LATE} s behind"
        right = float(round(max(0.0, given + shift)))
        fix = " ".join(override(name, {"delay": right}) for name in COMMANDS) if given != right <= LONGEST else ""
        hardly = f" (a longer one hardly is: {CLOCKS})" if lag is None else ""
        same = turn and turn.explained >= CLEAR[1] and turn.delay * shift > 0 and abs(turn.delay - shift) <= SAME
        which = "commands" if same else "speed"
        yield Finding(e.boat, PAIR, "delay", text, limits + (hardly if fix else _restamped(shift, which)), fix)
    elif turn and (turned >= late or turned < 0):
        text = f"changes of turn that fit commands {_side(turned)} best (squares × {turn.ratio:.2f})"
        how = _restamped(given, "speed") if 0 < -turned <= 1.5 * given else _restamped(turned, "heading")
        yield Finding(e.boat, "commands, heading", "delay", text, f"less than {late} s behind{how}")
    elif e.searched.seconds >= LONG and abs(e.searched.correlation) < FOLLOWS and _moves(e):
        text = f"a speed without relation to the commands (r = {e.searched.correlation:.2f})"
        expected = see(f"more than {FOLLOWS:g}", SURGE, *COMMANDS)
        yield Finding(e.boat, PAIR, "thrust", text, expected, without(e, SURGE))


def _drift(boat: str, longest: Sequence[Response]) -> Iterator[Finding]:
    """A delay that grows or falls from third to third of a log: the clock of one table runs faster."""
    drifting = {}
    for name, response in zip(("speed", "heading"), longest, strict=False):
        fits = [best_delay(response, (k / 3, (k + 1) / 3)) for k in range(3)]
        known = [each for each in fits if each and each.explained >= DRIFTING[0]]
        lags = [each.delay for each in known]
        sure = any(each.ratio <= DRIFTING[1] and each.certainty > 2 for each in known)
        if len(lags) == 3 and sure and abs(lags[2] - lags[0]) >= LATE and lags[1] == sorted(lags)[1]:
            drifting[name] = lags
    if drifting:
        lags = next(iter(drifting.values()))
        text = f"changes of {' and '.join(drifting)} {', then '.join(f'{each} s' for each in lags)} behind the commands"
        side = "faster" if lags[2] > lags[0] else "slower"
        expected = f"one delay in all thirds of the log: its clock runs {side} than that of the commands: correct one"
        yield Finding(boat, "commands, heading" if "speed" not in drifting else PAIR, "clock drift", text, expected)


def _apart(e: Evidence, turn: Response) -> Iterator[Finding]:
    """A command that acts later than that of the other side, by the turn."""
    known = turn.known
    if known.sum() < SHORT or not all(abs(each.correlation) > BOTH for each in e.sides()[0]):
        return
    goal, motion = turn.change[known], turn.motion[:, known]
    left, right = ({delay: turn.forces[delay][part][:, known] for delay in NEAR} for part in (slice(2), slice(2, 4)))
    squares = {(one, other): _squares(goal, left[one], right[other], motion) for one in NEAR for other in NEAR}
    best, usual = (
        min(pairs, key=lambda pair: float(squares[pair].sum())) for pairs in (squares, [(each, each) for each in NEAR])
    )
    certainty, ratio, explained = _better(goal, squares[best], squares[usual])
    if best[0] != best[1] and certainty > SURE[0][0] and ratio < SIDES_APART and explained > EXPLAINED:
        late, later = int(best[1] > best[0]), abs(best[1] - best[0])
        text = f"a turn that fits best if it acts {later} s later than the other side (squares × {ratio:.2f})"
        delay = max((each.delay for each in e.logs(COMMANDS[late])), default=0.0) + later
        fix = override(COMMANDS[late], {"delay": delay}) if min(best) >= 0 else ""
        expected = f"both at once: take {later} s from the stamps of {COMMANDS[1 - late]}"
        yield Finding(e.boat, COMMANDS[late], "delay of a side", text, expected, fix)


def _of_runs(e: Evidence, each: Sequence[Sequence[Response]]) -> Iterator[Finding]:
    """A delay in some logs that is another one than in the others: their clocks differ."""
    both = [
        (log.recordings[0].run, best_delay(response[0]))
        for log, response in zip(e.alone, each, strict=True)
        if response
    ]
    fits = {run: fit for run, fit in both if fit and fit.explained >= CLEAR[1]}
    lags = [each.delay for each in fits.values()]
    usual = min(lags, key=lambda lag: (sum(abs(lag - other) for other in lags), abs(lag)), default=0)
    odd = [
        f"{_side(fit.delay)} the commands in {run}"
        for run, fit in fits.items()
        if abs(fit.delay - usual) >= LATE and fit.certainty > ODD[0] and fit.ratio <= ODD[1]
    ]
    if odd:
        text = f"changes of speed {', '.join(odd)}, and {_side(usual)} them in other logs"
        yield Finding(e.boat, PAIR, "delay of runs", text, f"one delay in all logs: {CLOCKS} there")


def _is_told(fit: Fit, given: float) -> bool:
    """Whether a delay beyond the configured one, s, is surely one that no boat has."""
    if fit.delay in (DELAYS[0], DELAYS[-1]) or fit.clear < 0 or fit.clear >= FAR:
        return fit.delay not in (DELAYS[0], DELAYS[-1])
    sure = any(fit.certainty >= certain and fit.ratio <= ratio for certain, ratio in SURE)
    early = fit.delay <= EARLY and (given > 0 or fit.delay <= -FAR)
    return sure and fit.explained >= EXPLAINED and fit.bins >= ENOUGH and (fit.delay >= LATE or early)


def _side(shift: float) -> str:
    return f"{abs(shift):.0f} s {'behind' if shift > 0 else 'before'}"


def _restamped(shift: float, late: str) -> str:
    """What to do where a response lies so many s behind the commands because of the clock of one channel."""
    how = "take {} s from" if (shift > 0) != (late == "commands") else "add {} s to"
    return f": {CLOCKS}: {how.format(f'{round(abs(shift), 2):g}')} the stamps of the {late}"


def _moves(e: Evidence) -> bool:
    """Whether thrust and speed change enough to be compared."""
    return spread(e.thrust) > 0.03 and spread(e.speed) > STEADY * min(e.surge_max, e.fastest)


def clocks(e: Evidence) -> Iterator[Finding]:
    """A heading whose stamps are of another clock than those of the position or of the velocity over ground.

    For each lag, the dispersion of twice the angle between course and heading is compared where the boat moves: so one
    that goes astern counts like one that goes ahead, and a constant error of the compass changes nothing.
    """
    edges = e.moving_edges(COURSE_STEP, e.series["heading"])
    if len(edges) <= COURSE_BLOCK * FEWEST + 2 * FARTHEST:
        return
    heading = np.exp(2j * np.angle(bin_directions(e.series["heading"], edges)))
    north, east = e.velocity(edges)
    velocity = north + 1j * east
    velocity[np.abs(velocity) < MOVING * min(e.surge_max, e.fastest)] = np.nan
    course = np.exp(2j * np.angle(velocity))[FARTHEST:-FARTHEST]
    lags = range(-FARTHEST, FARTHEST + 1)
    angles = np.stack([course * heading[FARTHEST + lag : len(heading) - FARTHEST + lag].conj() for lag in lags])
    angles = angles[:, np.isfinite(angles).all(0)]
    blocks = angles[:, : angles.shape[1] // COURSE_BLOCK * COURSE_BLOCK].reshape(len(angles), -1, COURSE_BLOCK)
    if blocks.shape[1] < FEWEST:
        return
    means = blocks.mean((1, 2))
    dispersion = 1 - np.abs(means)
    best, none = int(dispersion.argmin()), FARTHEST
    lag = (best - none) * COURSE_STEP
    aligned = (blocks * (means.conj() / np.abs(means))[:, None, None]).real.mean(2)  # (lags, blocks)
    gain = aligned[best] - aligned[none]
    certain = float(gain.mean()) / max(float(gain.std(ddof=1)) / math.sqrt(len(gain)), 1e-12)
    less = dispersion[best] / max(dispersion[none], 1e-12)
    sure = any(certain > errors and less < left for errors, left in FITS)
    if -EARLIER < lag < LATER or abs(best - none) == FARTHEST or dispersion[best] > CLOSE or not sure:
        return
    channels = ", ".join(e.places if e.has_position else e.speeds)
    side = "later" if lag > 0 else "earlier"
    text = f"a heading that fits the course over ground {abs(lag):.0f} s {side} (dispersion × {less:.2f})"
    expected = f"less than {LATER if lag > 0 else EARLIER:g} s: {CLOCKS}"
    yield Finding(e.boat, f"heading, {channels}", "clocks", text, expected)
