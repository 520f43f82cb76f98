"""Fault accommodation: `layer.accommodate`, in place. Numbers in parentheses are equations of `state`."""

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.family import WIDTH, Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, SURGE
from usvlearn.estimators.ensemble.accommodation.state import AT, Number
from usvlearn.estimators.ensemble.monitors.state import AT as MONITOR
from usvlearn.estimators.ensemble.monitors.state import SIGNIFICANT
from usvlearn.estimators.joint.accommodation_kernel import give_back, hand_over, keep_past, thrust_left


@jit
def accommodate(program, node, monitors, s, q, row, work):
    """What the monitor has found enters the filters, whose rows follow that of this part, after their number."""
    numbers, thrusters, surge = q[node[Row.NUMBERS] :], MONITOR.thrusters, row[SURGE]
    joints, handed = node[WIDTH + 1 : WIDTH + 1 + node[WIDTH]], s[node[AT.handed] : node[AT.handed] + 2]
    share, deviation = s[node[AT.share] : node[AT.share] + 2], s[node[AT.deviation] : node[AT.deviation] + 2]
    raised, evidence = s[monitors[thrusters.raised] :], s[monitors[thrusters.evidence] :]
    late, new = s[monitors[thrusters.since]] >= numbers[Number.AFTER], False
    for side in range(2):
        on = raised[side] > 0
        if on and not handed[side] > 0 and late:
            handed[side], new = 1.0, True
            share[side] = max(s[monitors[thrusters.share] + side], 0.0)
        elif handed[side] > 0 and not on:
            value, spread = fuse(program, joints, monitors, s, q, side, numbers, False, work)
            if value + NINETY * spread >= 1:
                handed[side], share[side] = 0.0, 1.0
                for i in joints:
                    give_back(program[i], s, q, side, numbers[Number.LOOSE], surge, work)
    if new:
        for i in joints:
            hand_over(program[i], s, q, share, numbers[Number.LOOSE], surge, work)
    quiet = not (raised[0] > 0 or raised[1] > 0 or handed[0] > 0 or handed[1] > 0)
    if quiet and evidence[0] < SIGNIFICANT and evidence[1] < SIGNIFICANT:
        s[node[AT.calm]] += row[DT]
        if s[node[AT.calm]] >= numbers[Number.WAIT]:
            s[node[AT.calm]] = 0.0
            for i in joints:
                keep_past(program[i], s)
    for side in range(2):
        on = raised[side] > 0
        if handed[side] > 0:
            share[side], deviation[side] = fuse(program, joints, monitors, s, q, side, numbers, on, work)
        else:
            told = s[monitors[thrusters.share] + side], s[monitors[thrusters.deviation] + side]
            share[side], deviation[side] = told if on else (1.0, 0.0)


@jit
def fuse(program, joints, monitors, s, q, side, numbers, alarmed, work):
    """(3): η and s of a side, with the monitor's while its alarm is on."""
    total, moment = 0.0, 0.0
    if alarmed:
        thrusters = MONITOR.thrusters
        value, spread = s[monitors[thrusters.share] + side], s[monitors[thrusters.deviation] + side]
        total, moment = weigh(value, numbers[Number.MONITOR] * spread, total, moment)
    for i in joints:
        value, spread = thrust_left(program[i], s, side, numbers[Number.SCALE], numbers[Number.FLOOR], work)
        total, moment = weigh(value, spread, total, moment)
    return (moment / total, 1 / np.sqrt(total)) if total > 0 else (1.0, 1.0)


@jit
def weigh(value, spread, total, moment):
    """The sums of (3) with one more source; what is not finite counts as unknown."""
    if np.isfinite(value) and np.isfinite(spread) and spread > 0:
        total += 1 / (spread * spread)
        moment += value / (spread * spread)
    return total, moment
