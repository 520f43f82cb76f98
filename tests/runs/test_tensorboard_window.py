"""The curves of a long replay: errors of the last steps alone, a bounded memory, and a bounded number of points."""

from itertools import islice

import numpy as np
import pytest

from tests.support.boards import boards, steps, values
from usvlearn import AID, Average, Ensemble, Persistence
from usvlearn.core.samples import Fleet, Inputs, Run, Sample
from usvlearn.runs.replay import replay
from usvlearn.runs.tensorboard import BATCH, MAE, MOST_POINTS, STEPS_PER_POINT, TensorBoardLogger

DT, EVERY, LAST = 0.5, 50, 750  # s; steps of a chunk, and of the errors that a curve shows
NAMES = ("heron", "otter")


def fleet(length: int, boats: int = 2) -> Fleet:
    """One run, of boats whose speed jumps more and more, so that errors of early and late steps differ."""
    rng, shape = np.random.default_rng(0), (length, boats)
    left, right = rng.uniform(0, 1, (2, *shape))
    surge = 1 + np.linspace(0.01, 0.5, length)[:, None] * rng.standard_normal(shape)
    yes, time = np.ones(shape, bool), DT * (1 + np.arange(length))
    inputs = Inputs(left, right, 0 * left, 0 * left, np.full(shape, DT))
    measured = yes & (rng.random(shape) < 0.8)
    samples = Sample(inputs, surge, yes, measured)
    run = Run(np.tile(time[:, None], boats), samples, ("a.csv",) * boats, (length,) * boats)
    return Fleet(NAMES[:boats], (run,), {})


def model() -> Ensemble:
    return Ensemble({"aid": AID(28.0), "persistence": Persistence()}, {"average": Average()})


def chunks(ensemble, some: Fleet, count: int | None = None):
    state = ensemble.init((len(some.boats),))
    return islice(replay(ensemble, some, state, every=EVERY, save_every=10**6), count)


def test_a_curve_shows_the_errors_of_the_last_steps_and_keeps_no_others(tmp_path):
    some, ensemble, predicted = fleet(2400), model(), []
    with TensorBoardLogger(tmp_path, some, ensemble) as logger:
        for chunk in chunks(ensemble, some):
            logger.show(chunk)
            predicted.append(chunk.published["predictions"])
            count = sum(number for number, _ in logger._window)
            assert min(LAST, EVERY * len(predicted)) <= count < LAST + EVERY and len(logger._points) < BATCH
    samples = some.runs[0].samples
    errors = np.abs(np.concatenate(predicted) - samples.surge[..., None])
    errors[~samples.measured] = np.nan
    read = boards(tmp_path)
    for element, boat in enumerate(some.boats):
        for column, name in enumerate(ensemble.names):
            events = read[f"{boat}/{name}"]
            at, points = (each(events, f"1 overview/{MAE}") for each in (steps, values))
            assert len(at) >= 2400 / (STEPS_PER_POINT * len(some.boats))
            for second, value in zip(at, points, strict=True):
                end = round(second / DT)
                part = errors[max(end - LAST, 0) : end, element, column]
                assert value == pytest.approx(np.nanmean(part), rel=1e-5), (name, second)


@pytest.mark.parametrize("boats", [1, 2])
def test_a_long_log_has_no_more_points_than_a_chart_needs(tmp_path, boats):
    """A point comes after half of the steps between two at the least, so that chunks of any length fit."""
    length = 60_000
    some, ensemble = fleet(length, boats), model()
    apart = max(length / MOST_POINTS, STEPS_PER_POINT * boats)
    with TensorBoardLogger(tmp_path, some, ensemble) as logger:
        for chunk in chunks(ensemble, some, 30):
            logger.show(chunk)
    events = boards(tmp_path)["heron/aid"]
    gaps = np.diff([0, *steps(events, f"1 overview/{MAE}")]) / DT
    assert len(gaps) >= 30 * EVERY / apart - 1
    assert (gaps >= apart / 2 - 2).all() and (gaps <= apart + 2).all()


def test_a_short_log_has_a_point_for_each_hundred_steps_of_a_boat(tmp_path):
    some, ensemble = fleet(1000, 1), model()
    with TensorBoardLogger(tmp_path, some, ensemble) as logger:
        for chunk in chunks(ensemble, some):
            logger.show(chunk)
    points = steps(boards(tmp_path)["heron/aid"], f"1 overview/{MAE}")
    assert len(points) == 2 * 1000 // STEPS_PER_POINT and points[-1] == 1000 * DT
