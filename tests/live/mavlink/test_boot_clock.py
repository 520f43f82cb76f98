"""Time is the vehicle's: it may go on, begin anew, or be wrong once."""

import resource
from collections import Counter

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support.mavboat import MavBoat, RecordingSession, mavlink
from tests.support.mavlab import RECEIPT, SOURCES, Lab
from usvlearn.live.health import COMPILING
from usvlearn.live.mavlink.messages import WRAP
from usvlearn.live.node import Step


# ---------------------------------------------------------------- time
def test_a_reboot_and_the_wrap_of_the_clock_begin_a_new_segment():
    lab = Lab([MavBoat(booted=-(WRAP - 5000) / 1000)])  # 5 s before the wrap
    lab.sail(4)
    assert not lab.session.restarts
    lab.sail(10)
    assert len(lab.session.restarts) == 1
    assert lab.session.pushed[-1][1] < 10 < 4e6 < lab.session.pushed[0][1]
    lab.boat.reboot(lab.time)
    lab.sail(4)
    assert len(lab.session.restarts) == 2
    for begin, end in zip([0, *lab.session.restarts], [*lab.session.restarts, None], strict=True):
        stamps = [stamp for _, stamp, _ in lab.session.pushed[begin:end]]
        assert np.all(np.diff(stamps) > -0.5)


def test_one_wrong_stamp_changes_nothing():
    lab = Lab()
    lab.sail(6)
    for ms in (1, 10**9, 2**32 - 1):
        lab.give(lab.boat.packed(mavlink.MAVLink_attitude_message(ms, 0, 0, 3.0, 0, 0, 0)))
        lab.sail(1)
    assert not lab.session.restarts
    assert lab.session.dropped.count(("heading", "no_time")) == 3
    assert 3.0 not in lab.session.channel("heading")[1]


def test_a_clock_that_jumps_ahead_is_followed():
    lab = Lab()
    lab.sail(5)
    lab.boat.booted -= 3600.0
    lab.sail(5)
    assert not lab.session.restarts and lab.session.pushed[-1][1] > 3600


def test_stamps_of_32_bits_in_us_are_continued():
    lab = Lab([MavBoat(booted=-4294.0)])  # 2^32 us are 4294.97 s
    lab.sail(10)
    stamps = lab.session.channel("command_left")[0]
    assert np.all(np.abs(np.diff(stamps) - 0.1) < 1e-3) and abs(stamps[-1] - 4304.0) < 0.2
    assert not lab.session.restarts


# ---------------------------------------------------------------- a long time
class Counting(RecordingSession):
    """Counts messages, and those that are older than the one before."""

    def __init__(self):
        super().__init__(SOURCES)
        self.count, self.late, self.last = Counter(), 0, {}

    def push(self, part, stamp, raw):
        self.count[part] += 1
        self.late += stamp <= self.last.get(part, -1.0)
        self.last[part] = stamp
        return [Step(stamp, 1.5, 1.5, 1.0, 1.5, 1.3, 1.1, 1.4, {}, {}, {}, ())] if part == "heading" else []

    def drop(self, part, cause):
        self.count[part, cause] += 1

    def restart(self):
        self.count["restart"] += 1
        self.last = {}
        return []

    def tick(self):
        return COMPILING._replace(state="ok")


@pytest.mark.thorough
@pytest.mark.parametrize(("hours", "reboots"), [(0.05, 2), pytest.param(24.0, 100, marks=pytest.mark.slow)])
def test_for_hours_nothing_is_lost_and_no_memory_used(hours, reboots):
    lab, memory = Lab(session=Counting()), []
    lab.give = lambda data, delay=0.03, place="": lab.vehicle.receive(data, RECEIPT + lab.time + delay, whole=True)
    for _ in range(reboots):
        before = lab.session.count["heading"], lab.session.count["heading", "no_time"]
        lab.boat.reboot(lab.time)
        lab.sail(3600 * hours / reboots, step=0.1)
        lost = 3600 * hours / reboots * 10 - (lab.session.count["heading"] - before[0])
        assert lost <= 80, lost  # two looks of 3 s, and two ticks, until it is asked for again
        for told in (lab.boat.heard, lab.boat.values, lab.boat.texts, lab.boat.asked, lab.said):
            told.clear()
        memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)  # kB
    assert lab.session.count["restart"] == reboots - 1 and lab.session.late == 0
    assert lab.session.count["heading", "no_time"] <= reboots
    assert memory[-1] - memory[len(memory) // 2 - 1] < 2000, memory
