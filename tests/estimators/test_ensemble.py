"""Ensemble: its rules, and what it publishes."""

import math

import pytest
import torch

from tests.support import few, random_samples
from usvlearn import (
    AID,
    BOA,
    RLS,
    Average,
    Ensemble,
    Estimator,
    ExponentialWeights,
    FixedWeights,
    Inputs,
    Online,
    Persistence,
    RecursiveWeights,
    rollout,
)
from usvlearn.core.samples import tree_map
from usvlearn.estimators.baselines.persistence.layer import PersistenceState
from usvlearn.estimators.ensemble.conformal.layer import conformal_start, conformal_step
from usvlearn.estimators.ensemble.conformal.layer import published as published_widths


def members():
    return {"aid": AID(28.0), "rls": RLS(), "persistence": Persistence()}


def published(state):
    return state.predictions


def test_publishes_what_each_member_predicts_alone():
    ensemble, samples = Ensemble(members()), random_samples(20, 3)
    _, surge, published = rollout(ensemble, ensemble.init((3,)), samples, record=lambda s: s.predictions)
    for k, (name, member) in enumerate(members().items()):
        assert ensemble.names[k] == name
        assert torch.equal(published[..., k], rollout(member, member.init((3,)), samples)[1])
    torch.testing.assert_close(published[..., :3].mean(-1), surge)


def test_recursive_weights_equal_batch_least_squares():
    lam, samples = 0.97, random_samples(120)
    ensemble = Ensemble(members(), {"weighted": RecursiveWeights(forgetting=lam, covariance=2.0)})
    end, _, published = rollout(ensemble, ensemble.init(), samples, record=lambda s: s.predictions)
    phi, y = published[:, :3], samples.surge
    weights = lam ** torch.arange(len(y) - 1, -1, -1.0, dtype=torch.float64)
    information = lam ** len(y) * torch.eye(3, dtype=torch.float64) / 2.0
    prior = information @ torch.full((3,), 1 / 3, dtype=torch.float64)
    expected = torch.linalg.solve(
        information + (phi * weights[:, None]).mT @ phi, prior + (phi * weights[:, None]).mT @ y
    )
    torch.testing.assert_close(end.combiners["weighted"].weights, expected, rtol=1e-8, atol=1e-8)


def test_ensembles_of_ensembles():
    inner = {"outer": Ensemble(members()), "persistence": Persistence()}
    ensemble, samples = Ensemble(inner), random_samples(5, 2)
    _, surge, _ = rollout(ensemble, ensemble.init((2,)), samples)
    alone = Ensemble(members())
    expected = (rollout(alone, alone.init((2,)), samples)[1] + torch.cat([torch.zeros(1, 2), samples.surge[:-1]])) / 2
    torch.testing.assert_close(surge, expected)


def test_rules_name_members_in_any_order():
    """A rule sees its members in the order in which it names them."""
    rules = {
        "all": Average(),
        "fixed": FixedWeights({"rls": 0.5, "aid": 0.3, "persistence": 0.2}),
        "mixed": BOA(["persistence", "aid"], share=0.0, prior={"aid": 2.0}),
    }
    ensemble, samples = Ensemble(members(), rules, "fixed"), random_samples(12, 2)
    assert ensemble.names == ("aid", "rls", "persistence", "all", "fixed", "mixed")
    assert ensemble.combiners["mixed"].names == ("persistence", "aid")
    end, surge, record = rollout(ensemble, ensemble.init((2,)), samples, record=published)
    aid, rls, persistence, everybody, fixed, mixed = record.unbind(-1)
    torch.testing.assert_close(everybody, (aid + rls + persistence) / 3)
    torch.testing.assert_close(fixed, 0.5 * rls + 0.3 * aid + 0.2 * persistence)
    assert torch.equal(surge, fixed)
    torch.testing.assert_close(mixed[0], (persistence / 3 + aid * 2 / 3)[0])
    shown = ensemble.monitor(end)
    assert [k for k in shown if k.startswith("mixed/")] == ["mixed/weight_persistence", "mixed/weight_aid"]
    torch.testing.assert_close(shown["mixed/weight_aid"], end.combiners["mixed"].weights[..., 1])


def test_intervals_belong_to_the_predictions_beside_them():
    """Every published half-width was there before the speed it is to cover; a missing speed changes nothing."""
    samples = random_samples(40, 2)
    measured = samples.measured.clone()
    measured[10:13] = False
    samples = samples._replace(measured=measured)
    ensemble = Ensemble(members(), coverage=0.8, conditional=False)
    record = lambda s: {"predictions": s.predictions, "halfwidths": s.halfwidths}  # noqa: E731
    _, surge, arrays = rollout(ensemble, ensemble.init((2,)), samples, record=record)
    torch.testing.assert_close(arrays["predictions"][..., -1], surge)
    conformal = conformal_start((2,), 4, samples.surge)
    for k in range(40):
        torch.testing.assert_close(arrays["halfwidths"][k], published_widths(conformal), rtol=1e-12, atol=0.0)
        if not 10 <= k < 13:
            conformal = conformal_step(conformal, samples.surge[k, :, None] - arrays["predictions"][k], 0.8)


@pytest.mark.parametrize("backend", ["torch", "kernel"])
def test_an_interval_is_infinite_before_ten_errors_and_then_what_it_was(backend):
    """A boat that has not sailed must not publish 1.70 (1.65 … 1.75)."""
    samples = random_samples(40)
    ensemble = Ensemble(members(), conditional=False)
    first = Online(ensemble, backend=backend)
    tracked = conformal_start((), 4, samples.surge)
    inputs = Inputs(0.5, 0.5, 0.0, 0.0, 0.4)
    assert all(math.isfinite(v) and width == math.inf for v, width in first.predict_members(inputs).values())
    for k in range(40):
        foreseen = [width for _, width in first.predict_members(inputs).values()]
        first.step(tree_map(lambda x, k=k: x[k].item(), samples))
        surges, widths = (
            torch.tensor(each, dtype=torch.float64) for each in zip(*first.last_predictions().values(), strict=True)
        )
        assert widths.tolist() == foreseen
        if k < 10:
            assert widths.isinf().all()
        else:
            torch.testing.assert_close(widths, tracked.halfwidth, rtol=1e-9, atol=0)
        tracked = conformal_step(tracked, samples.surge[k] - surges, 0.9)


class Wild(Estimator):
    """Persistence that says something else once in five steps."""

    def __init__(self, wrong: float | torch.Tensor):
        super().__init__()
        self.wrong = wrong

    def init(self, batch=()):
        return PersistenceState(torch.zeros(tuple(batch), dtype=torch.float64))

    def predict(self, state, inputs):
        return state, torch.where(inputs.heading > 4.8, self.wrong, state.surge)

    def update(self, state, inputs, surge):
        return PersistenceState(surge)

    def start(self, state, surge):
        return PersistenceState(surge)


def half() -> FixedWeights:
    return FixedWeights({"aid": 0.5, "wild": 0.5})


@pytest.mark.thorough
@pytest.mark.parametrize("rule", few([BOA, Average, ExponentialWeights, RecursiveWeights, half], [BOA], "thorough"))
@pytest.mark.filterwarnings("ignore:estimators.wild")
def test_a_member_that_says_nonsense_does_not_spoil_the_rest(rule):
    wrong = torch.tensor([math.nan, math.inf, -math.inf, 1e30, -11.0], dtype=torch.float64)  # a batch element each
    samples = random_samples(200, 5)
    ensemble = Ensemble({"aid": AID(28.0), "wild": Wild(wrong)}, {"rule": rule()})
    end, surge, columns = rollout(ensemble, ensemble.init((5,)), samples, record=published)
    assert surge.isfinite().all() and surge.abs().max() < 10
    away = samples.inputs.heading > 4.8
    assert (away.sum(0) > 20).all()
    if not isinstance(ensemble.combiners["rule"], RecursiveWeights):  # who alone is active is what is said
        torch.testing.assert_close(surge[away], columns[..., 0][away])
    for name in ("combiners", "conformal"):
        assert all(leaf.isfinite().all() for leaf in tree_leaves(getattr(end, name)))
    assert (end.halfwidths[:, -1] < 5).all()


def tree_leaves(tree):
    leaves = []
    tree_map(leaves.append, tree)
    return leaves


def test_an_ensemble_of_which_all_sleep_says_nothing_and_recovers():
    ensemble, samples = Ensemble({"a": Wild(math.nan), "b": Wild(1e9)}, {"boa": BOA()}), random_samples(100)
    with pytest.warns(UserWarning, match="estimators.a: step 4: it predicted no finite number"):
        end, surge, _ = rollout(ensemble, ensemble.init(), samples)
    away = samples.inputs.heading > 4.8
    assert torch.equal(surge.isnan(), away) and away.any()
    assert all(leaf.isfinite().all() for leaf in tree_leaves(end.combiners))
