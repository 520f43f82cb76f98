"""Open-loop simulations with the parameters that were saved before them."""

import numpy as np

from tests.support.seasons import boats
from usvlearn.evaluation.free_simulation import free_runs


def test_the_newest_set_that_has_not_learned_from_a_run_is_taken():
    _, (season,) = boats(np.ones((1, 9)))
    assert [season.set_before(k) for k in range(2)] == [(0, True), (0, False)]
    several = season._replace(own=np.array([0, 0, 1, 1]))
    assert [several.set_before(k) for k in range(2)] == [(0, True), (1, False)]
    other = season._replace(own=np.array([-1, -1]))  # sets of other logs
    assert [other.set_before(k) for k in range(2)] == [(1, False), (1, False)]


def test_a_boat_without_noise_is_simulated_as_it_moved():
    ensemble, (season,) = boats(np.ones((1, 9)))
    first, second = free_runs(ensemble, season)
    assert (first.learned, second.learned) == (True, False)
    run, column = season.runs[1], ensemble.names.index("rls")
    assert np.isnan(second.predictions[0]).all()  # no step is made there
    error = np.abs(second.predictions[1:, column] - run.samples.surge[1:])
    assert error.max() < 0.02 < run.samples.surge.std()  # of an exact model, learned from the first run
    spoiled = season.runs[1]._replace(
        samples=run.samples._replace(surge=np.append(run.samples.surge[:1], np.ones(199)))
    )
    again = list(free_runs(ensemble, season._replace(runs=(season.runs[0], spoiled))))[1]
    assert np.array_equal(again.predictions, second.predictions, equal_nan=True)  # it sees the first speed alone
