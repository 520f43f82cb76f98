"""What alignment made of the messages: rejected, stale and copied ones, clocks that jump, horizons without a step;
and runs of the same minutes.

Simulated boats lose 1 to 2 % of the messages, real ones 0 to 1 %; outages of a few seconds make 1 to 3 % of the steps
stale, and 1 % of the changes of a real log are impossible. Parts of one log overlap by less than two boats' logs.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from usvlearn.logs.channels.bins import HUGE, cleaned
from usvlearn.logs.channels.channel import AUTO, CHANNELS, COMMANDS, EPSILON, LEAST_WINDOW, METRES, MOST_WINDOW, SURGE
from usvlearn.logs.channels.repeated_values import find_period
from usvlearn.logs.checks.evidence import MOVING, NONE, Evidence
from usvlearn.logs.checks.finding import NOTE, WARNING, Finding, override, see

EMPTY = "empty"  # a cell of a table at whose time the channel had no message
MANY, MOST = 0.05, 0.5  # of the messages of a channel
JUMPING, STEPS, OUTAGE = 0.1, 50, 5.0  # share of impossible changes, of so many at least; s between two values
STALE, UNUSED = 0.1, 0.5  # of the steps; of the speeds
UNSORTED, SORT = 0.01, "sort the rows of the log by their stamps"  # share of the stamps
DATED, HOUR, SHARED, OVERLAP = 3e8, 3600.0, 10.0, 0.05  # s since 1970, of a clock that was set; s; s; share of a run
HARMLESS = ("duplicate", "repeated", "copied", "stale", "lost", "outage", "alone", EMPTY)
LIMITS = {SURGE: "surge_max", "yaw_rate": "yaw_rate_max", **dict.fromkeys(COMMANDS, "command_max")}


def _rejected(e: Evidence) -> dict[str, Counter]:
    """Counts by channel and cause, those of the readers among them."""
    counts: dict[str, Counter] = {}
    if e.fleet is not None:
        return {name: Counter(causes) for name, causes in e.fleet.rejected.get(e.boat, {}).items()}
    for one in e.recordings:
        for name, causes in one.dropped.items():
            counts.setdefault(name, Counter()).update(causes)
    return counts


def rejected(e: Evidence) -> Iterator[Finding]:
    """Shares of messages that were rejected, by cause, with the key that changes it."""
    for name, causes in _rejected(e).items():
        dropped = sum(n for one in e.recordings for why, n in one.dropped.get(name, {}).items() if why != EMPTY)
        total = dropped + sum(len(each.time) for each in e.logs(name) or e.logs("heading"))  # of which a rate is made
        for cause, count in causes.items():
            if cause in HARMLESS or count <= MANY * total:
                continue
            severity = WARNING if cause in ("out_of_range", "backwards", "ahead") or count > MOST * total else NOTE
            text = f"{count / total:.0%} of {total} messages rejected: {cause.replace('_', ' ')}"
            yield Finding(e.boat, name, "rejected", text, _expected(e, name, cause), _remedy(e, name, cause), severity)


def _expected(e: Evidence, name: str, cause: str) -> str:
    rows = {"backwards": SORT, "ahead": "leave out rows whose stamps lie in the future"}
    if any((np.abs(each.time) > HUGE).any() for each in e.logs(name)):
        rows["not_a_number"] = f"leave out rows whose stamps are more than {HUGE:g} s after the first one"
    return "; ".join(filter(None, [f"at most {MANY:.0%}", rows.get(cause)]))


def _remedy(e: Evidence, name: str, cause: str) -> str:
    if cause == "out_of_range" and name in LIMITS and len(e.values.get(name, ())):
        most = float(np.quantile(np.abs(e.values[name]), 0.995))
        return f"align.{LIMITS[name]}={math.ceil(10 * most) / 10:g}" if name not in COMMANDS else ""
    return ""


def stale(e: Evidence) -> Iterator[Finding]:
    """Inputs that are older than their window, and speeds that serve no step."""
    if e.fleet is None:  # nothing could be aligned, perhaps for this reason
        shares = {name: float(not e.settings(name)["held"] and _interval(e, name, 0.5) > _window(e, name) + EPSILON)
                  for name in CHANNELS}  # fmt: skip
    else:
        element, counts = e.fleet.boats.index(e.boat) if e.boat in e.fleet.boats else 0, _rejected(e)
        used = [(run.samples, slice(run.lengths[element]), element) for run in e.fleet.runs]
        steps, fresh, measured = (
            sum(int(leaf(samples)[part, element].sum()) for samples, part, element in used)
            for leaf in (lambda x: x.inputs.dt > 0, lambda x: x.fresh, lambda x: x.measured)
        )
        shares = {name: counts.get(name, Counter())["stale"] / max(steps, 1) for name in CHANNELS}
        measures = [float(each.period) for each in e.logs(SURGE) if each.period != AUTO]
        period = max(_interval(e, SURGE, 0.5), _dt(e), *measures)
        possible = fresh * min(1.0, _dt(e) / period)
        shares[SURGE] = 1 - measured / possible if possible else 0.0
    for name, share in shares.items():
        if share <= (UNUSED if name == SURGE else STALE):
            continue
        name = name if e.logs(name) else "heading"  # of which a yaw rate is made
        interval = _interval(e, name)
        held = name in COMMANDS and (_window(e, name) < interval or share > MOST)
        longer, present = math.ceil(15 * interval) / 10, _window(e, name)
        if longer <= present < math.inf:
            longer = round(2 * present, 3)
        window = AUTO if present < _automatic(e, name) else longer
        fix = override(name, {"held": True} if held else {"window": window})
        back = np.concatenate([np.diff(each.time) < 0 for each in e.logs(name)] or [np.zeros(1, bool)])
        expected = f"at most {UNUSED if name == SURGE else STALE:.0%}"
        if back.mean() > UNSORTED:  # no window helps
            fix, expected = "", f"{expected}; {SORT}"
        yield Finding(e.boat, name, "stale", f"{min(share, 1):.0%} of the steps without a recent value", expected, fix)


def _window(e: Evidence, name: str) -> float:
    windows = [each.window for each in e.logs(name)]
    return max((_automatic(e, name) if each == AUTO else float(each) for each in windows), default=math.inf)


def _automatic(e: Evidence, name: str) -> float:
    """About the window that "auto" would be, s."""
    return min(max(2 * _interval(e, name, 0.75), LEAST_WINDOW), MOST_WINDOW)


def _dt(e: Evidence) -> float:
    return float(e.align.get("dt", 0.4))


def _interval(e: Evidence, name: str, share: float = 0.95) -> float:
    """The time between two messages of a channel that `share` of them keep, s."""
    passed = np.concatenate([np.diff(each.time) for each in e.logs(name)] or [np.zeros(1)])
    return float(np.quantile(passed, share)) if len(passed) else 0.0


def copies(e: Evidence) -> Iterator[Finding]:
    """A speed that is logged more often than it is measured."""
    logs = [each for each in e.logs(SURGE) if each.period == 0]
    if not logs or sum(len(each.time) for each in logs) < 3:
        return
    period, share = find_period(logs)
    if period:
        yield Finding(e.boat, SURGE, "repeats", f"{share:.0%} of the speeds repeat the one before",
                      f"a measurement every {period:g} s once", override(SURGE, {"period": period}))  # fmt: skip


def clock(e: Evidence) -> Iterator[Finding]:
    """Stamps that jump back."""
    outage = float(e.align.get("outage", 5.0))
    for name in CHANNELS:
        back = np.concatenate([-np.diff(each.time) for each in e.logs(name)] or [np.zeros(0)])
        jumps = back[back > outage]
        if len(jumps):
            yield Finding(e.boat, name, "clock", f"{len(jumps)} stamps that jump back, by up to {jumps.max():.3g} s",
                          f"none by more than {outage:g} s (align.outage)", severity=NOTE)  # fmt: skip


def jumps(e: Evidence) -> Iterator[Finding]:
    """Speeds, headings and positions that jump to and fro as those of no boat do."""
    top, (stamps, speed), shares = min(e.surge_max, e.fastest), cleaned(e.series[SURGE]), dict[str, float]()
    limits = {SURGE: (max(0.3 * top, 0.5), 2.0), "heading": (1.0, 1.0), **dict.fromkeys(METRES, (5.0, 2 * top))}
    for name, (least, rate) in limits.items():
        time, value = cleaned(e.series.get(name, NONE))
        passed, step = np.diff(time), np.abs(np.diff(value))
        known = (passed > 0) & (passed < OUTAGE)
        if name == "heading" and len(stamps):
            moving = np.interp(time[1:], stamps, np.abs(speed)) > MOVING * top
            step = np.where(moving, np.abs(np.angle(np.exp(1j * step))), 0.0)
        if known.sum() >= STEPS and (share := float((step > least + rate * passed)[known].mean())) >= JUMPING:
            shares[dict(zip(METRES, e.places, strict=True)).get(name, name)] = share
    if shares:
        text = f"{max(shares.values()):.0%} of the changes from one value to the next greater than a boat can make"
        expected = "values that do not jump to and fro: write those of two boats or sensors to a log of each"
        yield Finding(e.boat, ", ".join(shares), "jumps", text, see(expected, *shares))


def horizons(e: Evidence) -> Iterator[Finding]:
    """Horizons of forecasts that are shorter than half a step, and so never fall due."""
    short = [horizon for horizon in e.horizons if horizon < _dt(e) / 2]
    if short:
        left = [horizon for horizon in e.horizons if horizon not in short]
        text = f"horizons of {', '.join(f'{each:g}' for each in short)} s"
        key = f"forecasts.horizons=[{','.join(f'{each:g}' for each in left)}]" if left else "forecasts=null"
        expected = f"{_dt(e) / 2:g} s or more: they never fall due"
        yield Finding("all boats", "forecasts", "horizons", text, expected, key, NOTE)


def together(e: Evidence) -> Iterator[Finding]:
    """Two runs in the same minutes."""
    spans = []
    for one in e.recordings:
        time, start = one.channels[COMMANDS[0]].time, one.channels[COMMANDS[0]].start
        if start > HOUR and len(time):
            spans.append((*(start + np.quantile(time, (0.01, 0.99))).tolist(), one.run))
    for (begin, end, run), (later, last, other) in pairwise(sorted(spans)):
        if (both := min(end, last) - later) > max(SHARED, OVERLAP * min(end - begin, last - later)):
            one_day, severity = ("", WARNING) if begin > DATED else (" if of one day", NOTE)
            text = f"that {run} and {other} are of the same {both:.0f} s{one_day}: of several boats, or copies"
            expected = "runs of one boat, one after the other: of several, set data.path to the run of one, or to "
            expected += f"{{{run}: FILE, {other}: FILE}} (of one table, set data.boat_column) and data.boat to null"
            yield Finding(e.boat, "runs", "together", text, expected, severity=severity)
            return
