"""Messages to steps of the grid, compiled by numba: the work of `usvlearn.logs.alignment.align.Aligner` for each
message.

Channels are numbered in the order of `CHANNELS`, and causes of a rejection in the order of `CAUSES`.
"""

from __future__ import annotations

import math

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.logs.alignment.held_kernel import at, before, mean
from usvlearn.logs.alignment.window_kernel import RECENT, follow, window_of
from usvlearn.logs.channels.channel import CHANNELS, EPSILON, LEAST_WINDOW

SLACK = 1.0  # s, by which a channel may lag behind the newest message of any other
LATEST = 1e12  # s; at later stamps, adding a step would not change the time
RESETS = 3  # so many messages in a row, of several channels, far behind: the clock was set back
TURN = 2 * math.pi
TURNS = STRAIGHTENS = 1.2  # s for which a boat keeps its yaw rate, and time constant with which that fades then
LEFT, RIGHT, HEADING, YAW_RATE, SURGE = range(5)
CAUSES = ("not_a_number", "out_of_range", "backwards", "ahead", "duplicate", "repeated", "stale", "copied")
NOT_A_NUMBER, OUT_OF_RANGE, BACKWARDS, AHEAD, DUPLICATE, REPEATED, STALE, COPIED = range(8)
INPUTS = ("mean", "last", "next")
MEAN, LAST, NEXT = range(3)
STEPS = ("grid", "speed")
GRID, SPEED = range(2)
DROP, TAKE, ANEW = range(3)  # what is done with a message
COLUMNS = 10  # of a row: time, command left and right, heading, yaw rate, dt, surge, fresh, measured, and COMPLETED
COMPLETED = 9  # by which of the messages that were fed with it a step was completed; their count: by the end of a log


# Records, not tuples of arrays: compiled code counts references to an array whenever it passes one on.
SETTINGS = np.dtype(
    [
        ("dt", "f8"),  # s
        ("inputs", "i8"),  # MEAN, LAST or NEXT
        ("steps", "i8"),  # GRID or SPEED
        ("patience", "f8"),  # s
        ("outage", "f8"),  # s
        ("limit", "f8", len(CHANNELS)),  # largest magnitude of a value
        ("logged", "i8", len(CHANNELS)),  # whether there is such a channel
        ("held", "i8", len(CHANNELS)),
        ("window", "f8", len(CHANNELS)),  # s; 0: auto
        ("delay", "f8", len(CHANNELS)),  # s
        ("period", "f8"),  # s, between two measurements of the speed; 0: every message is one
    ]
)
MEMORY = np.dtype(
    [
        ("newest", "f8"),  # s, newest stamp of any channel
        ("ahead", "f8"),  # s, stamp of the last message that lay beyond an outage
        ("surge_time", "f8"),  # s, grid time of the last measured speed
        ("tick", "f8"),  # s, the grid time that was emitted last; NaN before the first
        ("known", "i8"),  # whether the speed at that time is known
        ("behind", "i8"),  # how many messages in a row lie far behind the newest
        ("behind_channels", "i8"),  # a bit for each channel of these messages
        ("count", "i8", len(CHANNELS)),  # recent messages of each channel
        ("window", "f8", len(CHANNELS)),  # s, in force
        ("counted", "f8", len(CHANNELS)),  # these three: see `usvlearn.logs.alignment.window_kernel.follow`
        ("seen", "i8", len(CHANNELS)),
        ("intervals", "f8", (len(CHANNELS), RECENT)),
        ("rejected", "i8", (len(CHANNELS), len(CAUSES))),  # counts
    ]
)


def new_settings(**values) -> np.ndarray:
    """A record of `SETTINGS`, `(1,)`.

    >>> new_settings(dt=0.4, held=[1, 1, 0, 0, 0])["held"].tolist()
    [[1, 1, 0, 0, 0]]
    """
    settings = np.zeros(1, dtype=(np.record, SETTINGS))  # its fields are attributes in plain Python, too
    for name, value in values.items():
        settings[name] = value
    return settings


def new_memory(settings: np.ndarray) -> np.ndarray:
    """A record of `MEMORY` before the first message, `(1,)`.

    >>> new_memory(new_settings(window=0.5))["newest"].tolist()
    [-inf]
    """
    memory = np.zeros(1, dtype=(np.record, MEMORY))  # likewise
    for name in ("newest", "ahead", "surge_time", "counted"):
        memory[name] = -math.inf
    memory["tick"] = math.nan
    memory["window"] = np.where(settings["window"] > 0, settings["window"], LEAST_WINDOW)
    return memory


@jit(entry=True, memory=True)
def feed(settings, memory, times, values, channels, stamps, numbers, flush):
    """Take messages in the order in which they came; returns a row for each step that they complete.

    Args:
        settings, memory: records, `(1,)`: see `SETTINGS`, `MEMORY`.
        times, values: `(channels, room)`, the recent messages, oldest first; a time is when the value takes effect, s.
        channels, stamps, numbers: `(messages,)`, the new ones, in s and SI units; there must be room for them.
        flush: whether to continue to the newest message, without waiting for late ones.
    """
    settings, memory = settings[0], memory[0]
    rows, count, finished = np.empty((len(stamps) // 4 + 16, COLUMNS)), 0, 0
    for k in range(len(stamps)):
        channel, time, value = channels[k], stamps[k], numbers[k]
        if finished < count:
            rows[finished:count, COMPLETED], finished = k - 1, count
        action = _action(settings, memory, channel, time, value)
        if action == DROP:
            continue
        if action == ANEW:
            rows, count = _advance(settings, memory, times, values, memory.newest, rows, count)
            _restart(settings, memory, times, values)
        if not _keep(settings, memory, times, values, channel, time, value):
            continue
        if channel == SURGE and math.isnan(memory.tick):
            memory.tick, memory.surge_time, memory.known = time, time, True
            rows = _room(rows, count)
            _write(rows[count], time, 0.0, value)
            count += 1
        elif memory.newest > memory.tick + settings.dt + settings.patience:  # false before the first tick, which is NaN
            rows, count = _advance(settings, memory, times, values, memory.newest - settings.patience, rows, count)
    rows[finished:count, COMPLETED], finished = len(stamps) - 1, count
    if flush:
        rows, count = _advance(settings, memory, times, values, memory.newest, rows, count)
        rows[finished:count, COMPLETED] = len(stamps)
    return rows[:count]


@jit(entry=True, memory=True)
def forget(settings, memory, times, values):
    """Drop messages that matter only before the step that precedes the last emitted one."""
    settings, memory = settings[0], memory[0]
    if math.isnan(memory.tick):
        return
    for c in range(len(memory.count)):
        last = at(times[c, : memory.count[c]], memory.tick - settings.dt)
        keep = at(times[c, : memory.count[c]], times[c, last] - settings.dt) if last > 0 else 0
        if keep > 0:
            memory.count[c] -= keep
            for k in range(memory.count[c]):
                times[c, k], values[c, k] = times[c, k + keep], values[c, k + keep]


@jit(entry=True, memory=True)
def ahead(settings, memory, times, values, steps):
    """Inputs of the steps after the last one, `(4, steps)`; see `Aligner.ahead`."""
    settings, memory = settings[0], memory[0]
    inputs = np.full((4, steps), np.nan)
    begin, dt = memory.tick, settings.dt
    _open_windows(settings, memory)
    if math.isnan(begin):
        return inputs
    for c in (LEFT, RIGHT):
        if _in_force(settings, memory, times, c):
            known = memory.count[c]
            for k in range(steps):
                start = begin + k * dt
                inputs[c, k] = mean(times[c, :known], values[c, :known], start, start + dt)
    last = memory.count[HEADING] - 1
    if not _in_force(settings, memory, times, HEADING):
        return inputs
    rate = math.nan
    if not settings.logged[YAW_RATE]:
        held = settings.held[HEADING] and memory.newest - times[HEADING, last] > _longest(settings, memory)
        rate = 0.0 if held else _slope(settings, memory, times, values, last)
    elif _in_force(settings, memory, times, YAW_RATE):
        rate = values[YAW_RATE, memory.count[YAW_RATE] - 1]
    heading = values[HEADING, last] + rate * (begin - times[HEADING, last])
    for k in range(steps):
        now = rate * math.exp(-max(k * dt - TURNS, 0.0) / STRAIGHTENS)
        inputs[HEADING, k], inputs[YAW_RATE, k] = heading % TURN, now
        heading += now * dt
    return inputs


@jit(memory=True)
def _in_force(settings, memory, times, channel):
    """Whether the last value of a channel is held, or within its window at the newest message."""
    n = memory.count[channel]
    if n == 0:
        return False
    age = memory.newest - (times[channel, n - 1] - settings.delay[channel])
    return bool(settings.held[channel]) or age <= memory.window[channel] + EPSILON


@jit(memory=True)
def _action(settings, memory, channel, time, value):
    """What to do with a message: drop it, take it, or take it as the first of a new segment."""
    limit = settings.limit[channel]
    if not (math.isfinite(value) and abs(time) < LATEST):
        memory.rejected[channel, NOT_A_NUMBER] += 1
        return DROP
    if not -limit <= value <= limit:
        memory.rejected[channel, OUT_OF_RANGE] += 1
        return DROP
    action = TAKE
    if time < memory.newest - SLACK:
        memory.behind += 1
        memory.behind_channels |= 1 << channel
        if memory.behind < RESETS or memory.behind_channels == 1 << channel:
            memory.rejected[channel, BACKWARDS] += 1
            return DROP
        action = ANEW  # the clock was set back
    elif time > memory.newest + settings.outage and memory.newest > -math.inf:
        stray = abs(time - memory.ahead) > settings.outage
        memory.ahead = time
        if stray:  # unless the next message confirms it
            memory.rejected[channel, AHEAD] += 1
            return DROP
        action = ANEW
    memory.behind, memory.behind_channels = 0, 0
    return action


@jit(memory=True)
def _keep(settings, memory, times, values, channel, time, value):
    """Remember a message; returns whether it is newer than all of its channel."""
    n = memory.count[channel]
    if channel == HEADING and n > 0:
        value += TURN * np.rint((values[channel, n - 1] - value) / TURN)
    effect = time + settings.delay[channel]
    if n > 0 and effect <= times[channel, n - 1]:
        if effect < times[channel, n - 1]:
            memory.rejected[channel, BACKWARDS] += 1
        elif value == values[channel, n - 1]:
            memory.rejected[channel, DUPLICATE] += 1
        else:
            memory.rejected[channel, REPEATED] += 1
            values[channel, n - 1] = value
        return False
    memory.newest = max(memory.newest, time)
    if channel == SURGE and n > 0 and _is_copy(settings, value, values[SURGE, n - 1], time - times[SURGE, n - 1]):
        memory.rejected[SURGE, COPIED] += 1
        return True
    times[channel, n], values[channel, n] = effect, value
    memory.count[channel] = n + 1
    follow(memory.counted, memory.seen, memory.intervals, channel, effect)
    return True


@jit(memory=True)
def _is_copy(settings, value, last, age):
    """Whether a speed is the last measurement once more; a sensor may miss one. A boat at rest is measured again."""
    return value == last and value != 0 and age < 2 * settings.period - EPSILON


@jit(memory=True)
def _restart(settings, memory, times, values):
    for c in range(len(memory.count)):
        n = memory.count[c]
        memory.count[c] = 0
        if settings.held[c] and n > 0:  # a held value stays in force, however old
            times[c, 0], values[c, 0], memory.count[c] = -math.inf, values[c, n - 1], 1
    memory.newest, memory.tick, memory.known = -math.inf, math.nan, False


@jit(memory=True)
def _room(rows, count):
    return rows if count < len(rows) else np.concatenate((rows, np.empty_like(rows)))


@jit(memory=True)
def _write(row, time, dt, surge):
    """A step that cannot be made; its `dt` is 0 if its speed is where the next step departs."""
    row[:] = 0.0
    row[0], row[5], row[6] = time, dt, surge


@jit(memory=True)
def _open_windows(settings, memory):
    """Bring the automatic windows up to date."""
    for c in range(len(memory.count)):
        if settings.window[c] == 0:
            memory.window[c] = window_of(memory.seen, memory.intervals, c)


@jit(memory=True)
def _advance(settings, memory, times, values, until, rows, count):
    _open_windows(settings, memory)
    end = _end(settings, memory, times, until)
    while end <= until + EPSILON:
        rows = _room(rows, count)
        _step(settings, memory, times, values, memory.tick, end, rows[count])
        memory.tick, count = end, count + 1
        end = _end(settings, memory, times, until)
    return rows, count


@jit(memory=True)
def _end(settings, memory, times, until):
    """The end of the next step; infinite while the speed that may end it has not come.

    With SPEED it is the first speed at or after dt. If none comes within its window, it is that of the grid.
    """
    end = memory.tick + settings.dt
    if settings.steps == GRID:
        return end
    speeds, latest = times[SURGE, : memory.count[SURGE]], end + _surge_window(settings, memory)
    i = before(speeds, end) + 1
    if i < len(speeds) and speeds[i] <= latest + EPSILON:
        return speeds[i]
    return end if latest <= until + EPSILON else math.inf


@jit(memory=True)
def _surge_window(settings, memory):
    """Staleness of a speed, s. Where its copies are dropped, it counts from when the next measurement was due.

    An automatic window knows the interval of the measurements already.
    """
    return memory.window[SURGE] + (settings.period if settings.window[SURGE] > 0 else 0.0)


@jit(memory=True)
def _step(settings, memory, times, values, start, end, row):
    """The row of the step from `start` to `end`."""
    speeds, dt = times[SURGE, : memory.count[SURGE]], settings.dt if settings.steps == GRID else end - start
    i = at(speeds, end)
    measured = i >= 0 and speeds[i] > start + EPSILON and end - speeds[i] <= _surge_window(settings, memory) + EPSILON
    surge = values[SURGE, i] if measured else math.nan
    if not measured:
        memory.rejected[SURGE, STALE] += 1
    else:
        if end - memory.surge_time > settings.outage:
            memory.known = False  # too long ago: the change since then is not one step
        memory.surge_time = end
    cut = speeds[i] if measured else end  # with MEAN a prediction may see [start, cut)
    fresh = True
    for c in (LEFT, RIGHT, HEADING, YAW_RATE):
        if settings.logged[c]:
            row[1 + c] = _input(settings, memory, times, values, c, start, cut, end)
        else:
            row[1 + c] = _heading_slope(settings, memory, times, values, start, cut, end)
        fresh = fresh and not math.isnan(row[1 + c])
    if not (fresh and memory.known):
        memory.known = measured
        _write(row, end, 0.0 if measured else dt, surge)
        return
    row[0], row[3], row[5], row[6], row[7], row[8] = end, row[3] % TURN, dt, surge, 1.0, measured


@jit(memory=True)
def _input(settings, memory, times, values, channel, start, cut, end):
    """The value of one input, NaN where it is stale."""
    n = memory.count[channel]
    times, values = times[channel, :n], values[channel, :n]
    if settings.inputs == MEAN:
        when, i = cut, before(times, cut)
    else:
        when = start if settings.inputs == LAST else end
        i = at(times, when)
    if i < 0 or not (settings.held[channel] or when - times[i] <= memory.window[channel] + EPSILON):
        memory.rejected[channel, STALE] += 1
        return math.nan
    return mean(times, values, start, cut) if settings.inputs == MEAN else values[i]


@jit(memory=True)
def _heading_slope(settings, memory, times, values, start, cut, end):
    """Yaw rate, rad/s, from the unwrapped heading over about one step; NaN where unknown or impossible."""
    n = memory.count[HEADING]
    if settings.inputs == MEAN:
        j = before(times[HEADING, :n], cut)
    else:
        j = at(times[HEADING, :n], start if settings.inputs == LAST else end)
    if j < 0:
        return math.nan  # counted as a stale heading
    if settings.held[HEADING] and cut - times[HEADING, j] > _longest(settings, memory):
        return 0.0  # it is held: the boat keeps its heading
    slope = _slope(settings, memory, times, values, j)
    if math.isnan(slope):
        memory.rejected[YAW_RATE, STALE] += 1
        return math.nan
    if abs(slope) > settings.limit[YAW_RATE]:
        memory.rejected[YAW_RATE, OUT_OF_RANGE] += 1
        return math.nan
    return slope


@jit(memory=True)
def _longest(settings, memory):
    """Time over which a slope of the heading is one, s."""
    return 2 * settings.dt + memory.window[HEADING]


@jit(memory=True)
def _slope(settings, memory, times, values, j):
    """Slope of the heading up to its message j, rad/s; NaN where the one before it is too old."""
    n = memory.count[HEADING]
    times, values = times[HEADING, :n], values[HEADING, :n]
    i = at(times, times[j] - settings.dt / 2)
    if i < 0 or times[j] - times[i] > _longest(settings, memory):
        return math.nan
    return (values[j] - values[i]) / (times[j] - times[i])
