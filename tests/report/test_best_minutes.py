"""The picture at the top of a report: its minutes are good ones, honest ones, and drawn."""

import numpy as np
import pytest

from usvlearn.core.samples import Inputs, Sample
from usvlearn.evaluation.free_simulation import FreeRun
from usvlearn.evaluation.season import SeasonRun
from usvlearn.report.best_minutes import LENGTH, best_figure, best_minutes

DT = 0.5


def pair(name, speeds, error, learned=False):
    """A run and its simulation, which errs by `error` m/s."""
    n, always = len(speeds), np.ones(len(speeds), bool)
    inputs = Inputs(speeds / 3, speeds / 4, 0 * speeds, 0 * speeds, np.where(np.arange(n) > 0, DT, 0.0))
    run = SeasonRun(name, name, Sample(inputs, speeds, always, np.isfinite(speeds)), {}, DT * np.arange(n))
    return run, FreeRun((np.nan_to_num(speeds, nan=1.0) + error)[:, None], learned)


TIME = DT * np.arange(2000)
WAVES = 1.5 + np.sin(TIME / 20)


def found(*pairs):
    return best_minutes([run for run, _ in pairs], [free for _, free in pairs], 0)


def test_it_is_the_part_with_the_least_error_whose_speed_changes():
    error = np.where((TIME > 500) & (TIME < 750), 0.01, np.where(TIME < 200, 0.0, 0.3))
    still = np.where(TIME < 200, 1.5, WAVES)  # nothing is easier to simulate
    best = found(pair("a", still, error))
    assert 500 <= best.time[0] * 60 and best.time[-1] * 60 <= 750 and best.fit > 90
    assert np.ptp(best.time) * 60 == pytest.approx(LENGTH, abs=2 * DT)


def test_runs_that_were_not_learned_go_first_and_it_says_so():
    best = found(pair("easy", WAVES, 0.0, learned=True), pair("new", WAVES, 0.2))
    assert best.run == "new" and "has not learned" in best.caption
    assert "has learned before" in found(pair("easy", WAVES, 0.0, learned=True)).caption


def test_a_run_without_enough_speeds_has_no_picture():
    assert found(pair("a", np.full(2000, np.nan), 0.0)) is None and found(pair("a", WAVES[:0], 0.0)) is None
    half = np.where(TIME < 800, np.nan, WAVES)
    assert found(pair("a", half, 0.0)).time[0] * 60 > 750
    assert len(found(pair("short", WAVES[:100], 0.1)).time) == 100


def test_the_picture_shows_speeds_and_commands():
    speeds, commands = best_figure(found(pair("a", WAVES, 0.1))).axes
    assert [line.get_label() for line in speeds.lines] == ["measured", "from the commands alone"]
    assert [line.get_label() for line in commands.lines] == ["left", "right"]
