"""The benchmark of the batch fit: its open-loop simulations, runs on two grids, and what its page says of the aims."""

import math

import fit as bench
import fit_simulation as simulation
import fit_study as study
import numpy as np
import output_error as oe
import pytest
import torch

from usvlearn.core.rows import SURGE
from usvlearn.core.samples import Fleet, Inputs, Run, Sample
from usvlearn.estimators.joint.lacking import Quantity
from usvlearn.model.fit.choice import WEAR
from usvlearn.model.fit.gauss_newton import Missions, rows_of
from usvlearn.model.fit.open_loop import open_loop
from usvlearn.model.fit.terms import AT, SETS, prior

STEPS, TOP, FLOW = 600, 2.0, np.array([0.2, -0.1])


@pytest.fixture(scope="module")
def run() -> Sample:
    rng = np.random.default_rng(0)
    held = np.repeat(rng.uniform(0, 1, (STEPS // 20, 4)), 20, axis=0)
    yes, dt = np.ones(STEPS, bool), np.where(np.arange(STEPS) == 0, 0.0, 0.1)
    heading = np.cumsum(0.1 * (held[:, 2] - 0.5))
    heading[0] = heading[1]  # the fit does not know the heading at the start of a segment
    inputs = Inputs(held[:, 0], held[:, 1], heading, held[:, 3] - 0.5, dt)
    return Sample(inputs, np.full(STEPS, 0.7), yes, yes)


@pytest.fixture(scope="module")
def fitted():
    """The prior's boat with a lag, as a fit."""
    theta = prior("cubic", TOP).mean
    theta[AT["command_lag"]] = 0.4
    return Missions([], TOP).evaluate("cubic", theta, 0.1)


@pytest.mark.thorough
def test_simulations_are_those_of_the_other_batch_fit(run, fitted):
    """Both have the same motion; `output_error` has a code of its own."""
    names = {name: float(fitted.theta[AT[name]]) for name in oe.NAMES}
    other = oe.Fit(names, 0.4, FLOW[None], 0.0)
    found = open_loop(fitted, rows_of(run), FLOW)
    np.testing.assert_allclose(found, oe.free_runs(other, [run])[0], atol=1e-12)


def test_simulations_are_told_the_first_speed_alone(run, fitted):
    blind = run._replace(surge=np.where(np.arange(STEPS) == 0, run.surge, 3.0), measured=run.measured & False)
    found, expected = (open_loop(fitted, rows_of(each), FLOW) for each in (blind, run))
    np.testing.assert_array_equal(found, expected)


def grid(dt, end=60.0):
    time = np.arange(0.0, end, dt)[:, None]
    ones = np.ones_like(time)
    samples = Sample(Inputs(ones, ones, ones, ones, dt * (time > 0)), time.copy(), time >= 0, time >= 0)
    return Fleet(("boat",), (Run(time, samples, ("001",), (len(time),)),), {})


def test_halves_of_an_only_run_begin_at_one_time_on_both_grids():
    runs = simulation.halves(grid(0.4), grid(0.1))
    (later,), (ahead,) = runs.later, runs.ahead
    assert later.inputs.dt[0] == 0.0 and later.surge[0] == pytest.approx(30.0)
    np.testing.assert_allclose(ahead.rows[ahead.places, SURGE], later.surge, atol=1e-9)
    assert runs.rows["1"][-1, SURGE] == pytest.approx(29.9)


@pytest.fixture(scope="module")
def one() -> study.Study:
    with torch.random.fork_rng():
        return next(study.study("heron", 7001, n=1, hours=0.5, later=0.2))


@pytest.mark.thorough
def test_every_method_finds_about_the_boat(one):
    assert one.terms.removesuffix(WEAR) in SETS and len(one.truth) == 18
    for method in (study.FIT, study.BATCH):
        assert all(abs(bench.wrong(one, method, name)) < 0.25 for name in bench.AIMS), method
    assert one.free[study.FIT] < 1.15 * one.free[study.BATCH] < one.free[study.SQUARES]
    assert np.mean([bench.holds(one, study.FIT, name) for name in one.truth]) > 0.6
    text = "\n".join(bench.accuracy_table([one]) + bench.sets_table([one], {}))
    assert f"| {study.FIT} |" in text and f"| {one.terms} |" in text


def told(one: study.Study, half: float) -> study.Study:
    """The fit finds the truth exactly, with intervals so wide; those of the online estimate are 1 wide."""
    values = {name: Quantity(true, true - half, true + half, "") for name, true in one.truth.items()}
    beside = {name: Quantity(true, true - 1.0, true + 1.0, "") for name, true in one.truth.items()}
    return one._replace(found={study.FIT: values, study.ONLINE: beside})


@pytest.mark.thorough
def test_the_page_says_which_aims_are_met(one):
    missed = told(one, 0.5)
    values = {name: each._replace(high=each.low) for name, each in missed.found[study.FIT].items()}
    missed = missed._replace(found=missed.found | {study.FIT: values})
    rows = bench.coverage_table([told(one, 0.5)] * 9 + [missed])
    assert "| all | 90% | 100% |  |  |  |  | yes |" in rows
    assert not any("**no**" in row for row in rows)
    assert all("**no**" in row for row in bench.coverage_table([told(one, 0.5)])[2:])  # 100 % are too many
    wide = bench.coverage_table([told(one, 0.8)] * 9 + [missed])
    assert {row.split(" | ")[0].strip("| ") for row in wide if "**no**" in row} == set(bench.NARROW)


def test_a_peer_that_is_absent_is_left_out_of_the_best():
    errors = {"persistence": 1.0, "SysIdentPy": math.nan, "jax-sysid": 0.4, study.BATCH: 0.2, "ensemble": 0.1}
    rows = bench.frozen_table({"boat": study.Frozen(errors | {study.FIT: 0.1}, "nine")})
    assert "| SysIdentPy | not installed |" in rows
    assert "| fit over the best batch peer | 0.50 |" in rows and "| fit over the ensemble | 1.00 |" in rows
