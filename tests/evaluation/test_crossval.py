"""Open-loop simulations of saved checkpoints, as batch elements, against plain loops; the matrix between boats on
planted differences.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from tests.support import few, random_samples
from tests.support.seasons import boats, numpied
from usvlearn import AID, BOA, RLS, RNN, Average, Ensemble, Inputs, Persistence, RecursiveWeights, Sample
from usvlearn.core.samples import tree_map
from usvlearn.engine.rollouts import rollout, simulate
from usvlearn.errors import ShapeError
from usvlearn.estimators.regressors.layer import SurgeDynamics
from usvlearn.evaluation.crossval import FreeErrors, cross_validate, methods
from usvlearn.evaluation.season import Season
from usvlearn.report.build import assemble, best_start
from usvlearn.report.sections.cross import best_checkpoints, fleet_matrices


def spoilt(steps: int, seed: int) -> Sample:
    """A run with a segment, stale inputs, and speeds that are missing or not finite."""
    samples = random_samples(steps, seed=seed)
    dt, surge, fresh, measured = samples.inputs.dt, samples.surge, samples.fresh.clone(), samples.measured.clone()
    dt[[0, 12]] = 0.0
    fresh[5:7], measured[[3, 5, 6, 9, 12]], surge[[3, 15]] = False, False, torch.nan
    return Sample(samples.inputs, surge, fresh, measured)


@pytest.fixture(scope="module")
def ensemble() -> Ensemble:
    members = {
        "aid": AID(gain=5.0),
        "rls": RLS(SurgeDynamics(28.0)),
        "rnn": RNN(neurons=5),
        "persistence": Persistence(),
    }
    rules = {"average": Average(["aid", "rls"]), "weighted": RecursiveWeights(["rls", "rnn"]), "boa": BOA()}
    return Ensemble(members, rules, surge_max=4.0)


@pytest.fixture(scope="module")
def sets(ensemble):
    """Three checkpoints, learned, so that weights and parameters differ."""
    with torch.no_grad():
        return rollout(ensemble, ensemble.init((3,)), random_samples(40, 3, seed=9))[0]


@torch.no_grad()
def plain(ensemble: Ensemble, state, samples: Sample) -> dict[str, tuple[float, float, bool]]:
    """One set on one run, step by step, by `forward` on samples without speeds: MAE, MSE, diverged, by method."""
    weights = state.combiners
    errors = {name: [] for name in methods(ensemble)}
    diverged = dict.fromkeys(errors, False)
    for k in range(len(samples.surge)):
        sample = tree_map(lambda x, k=k: x[k], samples)
        blind = sample._replace(measured=torch.tensor(False))
        state, _ = ensemble(state, blind)
        if not (sample.fresh and sample.inputs.dt > 0):
            continue
        columns = state.predictions[: len(ensemble.columns)]
        seen = ensemble._seen(columns)
        learning = {f"{name}+": ensemble.combiners[name].combine(weights[name], seen[name]) for name in weights}
        said = {**dict(zip(ensemble.names, state.predictions, strict=True)), **learning}
        measured = bool(sample.measured & sample.surge.isfinite())
        for name in errors:
            value = float(said[name])
            diverged[name] |= not abs(value) < ensemble.surge_max
            if measured:
                value = ensemble.surge_max if np.isnan(value) else np.clip(value, -4.0, 4.0)
                errors[name].append(abs(value - float(sample.surge)))
        if measured:
            given = sample.surge, sample.inputs.dt
            weights = {name: ensemble.combiners[name].learn(weights[name], seen[name], *given) for name in weights}
    return {name: (float(np.mean(e)), float(np.mean(np.square(e))), diverged[name]) for name, e in errors.items()}


@pytest.mark.thorough
@pytest.mark.parametrize("elements", few([1, 7, 2048], [7]))
def test_elements_equal_single_simulations(ensemble, sets, elements):
    runs = [spoilt(steps, seed) for seed, steps in enumerate((30, 17, 120, 30))]
    advanced = []
    errors = cross_validate(ensemble, sets, [numpied(run) for run in runs], elements, advanced.append)
    assert errors.methods == methods(ensemble) and errors.methods[-2:] == ("weighted+", "boa+")
    assert sum(advanced) == 3 * errors.steps.sum()
    for k in range(3):
        for j, run in enumerate(runs):
            expected = plain(ensemble, tree_map(lambda x, k=k: x[k], sets), run)
            for m, name in enumerate(errors.methods):
                mae, mse, diverged = expected[name]
                assert errors.mae[k, j, m] == pytest.approx(mae, rel=1e-10), (k, j, name)
                assert errors.mse[k, j, m] == pytest.approx(mse, rel=1e-10), (k, j, name)
                assert errors.diverged[k, j, m] == diverged, (k, j, name)


@pytest.mark.thorough
@pytest.mark.parametrize("thrust", few([-1e4, torch.nan], [-1e4], "thorough"))
def test_a_simulation_that_leaves_the_limit_backwards_or_is_no_number_counts_as_the_limit(ensemble, sets, thrust):
    rls = sets.members["rls"]
    theta = torch.zeros_like(rls.theta)
    theta[:, 3] = thrust  # and no drag
    sets = sets._replace(members=sets.members | {"rls": rls._replace(theta=theta)})
    run = spoilt(30, 0)
    errors, m = cross_validate(ensemble, sets, [numpied(run)]), methods(ensemble).index("rls")
    for k in range(3):
        expected = plain(ensemble, tree_map(lambda x, k=k: x[k], sets), run)["rls"]
        assert expected[2] and (expected[0] > ensemble.surge_max) == (thrust < 0)
        assert (errors.mae[k, 0, m], errors.mse[k, 0, m]) == pytest.approx(expected[:2], rel=1e-10)
        assert errors.diverged[k, 0, m]


def test_simulate_equals_rollout_without_measurements(ensemble, sets):
    run = tree_map(lambda x: x[:, None].expand(-1, 3), spoilt(60, 2))
    with torch.no_grad():
        state, surge, _ = simulate(ensemble, sets, run)
        blind = run._replace(measured=torch.zeros_like(run.measured))
        expected, other, _ = rollout(ensemble, sets, blind)
    assert torch.equal(surge.nan_to_num(-9), other.nan_to_num(-9))
    assert torch.equal(state.members["rls"].surge, expected.members["rls"].surge)
    with pytest.raises(ShapeError, match="batch"):
        simulate(ensemble, sets, tree_map(lambda x: x[:, :2], run))


def test_a_simulation_that_leaves_the_limit_is_counted_and_kept():
    aid = AID(mass=1.0, surge_max=10.0)
    ensemble = Ensemble({"aid": aid, "persistence": Persistence()}, surge_max=4.0)
    state = ensemble.init((2,))
    theta = state.members["aid"].theta.clone()
    theta[1, 1] = 5.0  # a drag that drives
    state = state._replace(members={**state.members, "aid": state.members["aid"]._replace(theta=theta)})
    t = torch.ones(20, dtype=torch.float64)
    dt = torch.cat([torch.zeros(1), torch.full((19,), 0.4)]).double()
    errors = cross_validate(ensemble, state, [Sample(Inputs(0 * t, 0 * t, 0 * t, 0 * t, dt), t, t > 0, t > 0)])
    assert errors.diverged[:, 0, 0].tolist() == [False, True] and not errors.diverged[:, 0, 1].any()
    assert errors.mae[0, 0, 0] == 0 and 2.5 < errors.mae[1, 0, 0] <= 3.0  # 3: at the limit of 4 m/s all the time


def test_pooled_weighs_steps_and_leaves_out():
    mse = np.array([[[1.0], [4.0]], [[2.0], [np.nan]]])
    errors = FreeErrors(("aid",), mse, mse, mse > 9, np.array([30.0, 10.0]))
    assert errors.pooled(mse)[0, 0] == pytest.approx((30 * 1 + 10 * 4) / 40)
    others = np.array([[False, True], [True, False]])
    assert errors.pooled(mse, others)[:, 0].tolist() == [4.0, 2.0]


def matrix_of(ensemble: Ensemble, seasons: list[Season]) -> np.ndarray:
    last = tree_map(lambda *x: torch.stack([each[-1] for each in x]), *(season.state for season in seasons))
    between = {s.boat: cross_validate(ensemble, last, [run.samples for run in s.runs]) for s in seasons}
    return fleet_matrices(seasons, between, ["average"])["average"]


def test_a_fleet_of_equal_boats_gives_a_flat_matrix():
    matrix = matrix_of(*boats(np.ones((8, 9))))
    assert matrix.shape == (8, 8) and matrix.max() < 1e-6  # the model is exact, and so is each boat's checkpoint


def test_planted_differences_have_their_minimum_on_the_diagonal():
    factors = np.random.default_rng(1).uniform(0.7, 1.4, (8, 9))
    ensemble, seasons = boats(factors)
    matrix = matrix_of(ensemble, seasons)
    assert matrix.argmin(0).tolist() == list(range(8)) and matrix.argmin(1).tolist() == list(range(8))
    assert matrix[~np.eye(8, dtype=bool)].min() > 10 * np.diag(matrix).max()
    mean = matrix.mean(1)
    assert best_start(ensemble, seasons) == Path(f"{mean.argmin()}")


def test_the_best_set_is_chosen_on_runs_that_it_was_not_saved_in():
    _, seasons = boats(np.ones((1, 9)))
    shape = (2, 2, 2)
    mse = np.zeros(shape)
    mse[0, 0], mse[0, 1] = 0.0, 3.0  # the first checkpoint: perfect on its own run, bad on the other
    mse[1, 0], mse[1, 1] = 1.0, 9.0
    errors = {"boat0": FreeErrors(("rls", "average"), mse, mse, mse > 99, np.array([10.0, 1000.0]))}
    assert best_checkpoints(seasons, errors, "average") == [1]


@pytest.mark.thorough
def test_judge_writes_every_section_of_a_simulated_fleet():
    ensemble, seasons = boats(np.random.default_rng(2).uniform(0.8, 1.2, (2, 9)))
    sections, errors = assemble(ensemble, seasons)
    assert [section.key for section in sections] == ["online", "crossval", "fleet", "cost"]
    assert "no online predictions" in sections[0].here[0]
    result_table = sections[1].sheets[1]
    rows = {row[0]: dict(zip(result_table.columns, row, strict=True)) for row in result_table.rows if row[1] == "rls"}
    others = errors["boat1"].mae[..., 0][~np.eye(2, dtype=bool)]
    assert rows["boat1"]["median MAE, m/s"] == pytest.approx(np.median(others)) and rows["boat1"]["simulations"] == 2
    later = rows["boat1"]["median over later runs, m/s"]
    assert later == errors["boat1"].mae[0, 1, 0]  # the only run that is later than the only set before it
