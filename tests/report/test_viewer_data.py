"""The numbers of the viewer: how many there are, that peaks stay, and where tracks come from."""

import base64

import numpy as np
import pytest

from tests.support.seasons import boats, decoded
from usvlearn.evaluation.free_simulation import free_runs
from usvlearn.report import viewer
from usvlearn.report.viewer import LOGGED, RECKONED, coded, reckoned, residuals


def data_of(ensemble, seasons) -> list[dict]:
    free = {season.boat: list(free_runs(ensemble, season)) for season in seasons}
    return viewer.viewer_data(ensemble, seasons, free)["runs"]


def count(run: dict) -> int:
    return sum(len(decoded(series)) for series in run["series"].values())


@pytest.mark.parametrize("budget", [400, 1500, 2500])
def test_many_steps_become_few_numbers_and_no_peak_is_lost(monkeypatch, budget):
    ensemble, seasons = boats(np.ones((1, 9)))
    surge = seasons[0].runs[1].samples.surge.copy()
    surge[[57, 123]] = 9.0, -9.0  # one step each
    spiked = seasons[0].runs[1]._replace(samples=seasons[0].runs[1].samples._replace(surge=surge))
    seasons = [seasons[0]._replace(runs=(seasons[0].runs[0], spiked))]
    whole = data_of(ensemble, seasons)
    assert all(len(decoded(run["series"]["measured"])) == 200 for run in whole)
    monkeypatch.setattr(viewer, "BUDGET", budget)
    fewer = data_of(ensemble, seasons)
    assert sum(map(count, fewer)) <= budget + 20 * len(fewer) < sum(map(count, whole))
    measured, error = (decoded(fewer[1]["series"][name]) for name in ("measured", "free error"))
    assert measured.max() == pytest.approx(9.0, abs=1e-3) and measured.min() == pytest.approx(-9.0, abs=1e-3)
    assert np.abs(error).max() == pytest.approx(np.nanmax(np.abs(decoded(whole[1]["series"]["free error"]))), abs=1e-3)
    buckets = len(base64.b64decode(fewer[1]["time"])) // 4
    assert len(measured) == 2 * buckets and len(error) == buckets == len(decoded(fewer[1]["series"]["north"]))
    assert fewer[1]["width"] == pytest.approx(0.4 * -(-200 // buckets), rel=0.2)
    assert fewer[1]["bins"] == whole[1]["bins"]  # of all steps


def test_a_track_is_that_of_the_log_or_else_reckoned():
    ensemble, seasons = boats(np.ones((1, 9)))
    run = seasons[0].runs[0]
    east = run.samples._replace(
        surge=np.full(200, 2.0), inputs=run.samples.inputs._replace(heading=np.full(200, np.pi / 2))
    )
    assert reckoned(run._replace(samples=east))[-1] == pytest.approx([0.0, 2.0 * 0.4 * 199])
    silent = east._replace(measured=np.arange(200) < 100, fresh=np.arange(200) < 150)  # keeps its speed, then a gap
    assert reckoned(run._replace(samples=silent))[-1] == pytest.approx([0.0, 2.0 * 0.4 * 149])
    logged = np.stack([np.arange(200.0), np.full(200, np.nan)], -1)
    logged[3:, 1] = 7.0
    seasons = [seasons[0]._replace(runs=(run._replace(position=logged), seasons[0].runs[1]))]
    first, second = data_of(ensemble, seasons)
    assert (first["track"], second["track"]) == (LOGGED, RECKONED)
    assert np.allclose(decoded(first["series"]["north"]), logged[:, 0], atol=2e-3)
    assert np.allclose(decoded(first["series"]["east"]), logged[:, 1], equal_nan=True)


def test_series_without_numbers_and_with_one():
    assert np.isnan(decoded(coded(np.full(3, np.nan)))).all() and decoded(coded(np.full(2, 5.0))).tolist() == [5.0, 5.0]
    assert decoded(coded(np.array([]))).tolist() == []
    x = np.random.default_rng(0).standard_normal(1000) * 3
    assert np.abs(decoded(coded(x)) - x).max() <= coded(x)[2] / 2 * 1.001


def test_residuals_by_hand():
    x = np.repeat([0.0, 14.0], [10, 4])
    assert residuals(x, np.arange(14.0)) == [[0.5, 4.5, 0.45, 8.55, 10]]  # the other bin has too few
    assert residuals(np.array([np.nan]), np.ones(1)) == []
