"""Gains that were designed from identified boats hold on the true ones."""

import numpy as np
import pytest
from speed_controller import cases

MOST = {"ArduRover": 0.4, "MOOS-IvP": 0.15}  # overshoot, share of a step


@pytest.mark.slow
def test_the_gains_hold_on_the_true_boats():
    found = list(cases("otter", seed=3, hours=1.0))
    assert len(found) == 6
    for case in found:
        for true, drawn in zip(case.true, case.drawn, strict=True):
            assert not true.sways.any() and np.isfinite(true.settled).all(), (case.autopilot, true)
            assert true.overshoot[0] < MOST[case.autopilot] and not drawn.sways.any()
