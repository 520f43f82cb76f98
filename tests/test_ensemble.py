"""Ensemble: its rules, what it publishes, and what it refuses."""

import pytest
import torch

from tests.conftest import random_samples
from usvlearn import AID, RLS, Average, Ensemble, FixedWeights, Persistence, RecursiveWeights, rollout
from usvlearn.errors import ConfigError


def members():
    return {"aid": AID(28.0), "rls": RLS(), "persistence": Persistence()}


def test_publishes_what_each_member_predicts_alone():
    ensemble, samples = Ensemble(members()), random_samples(20, 3)
    _, surge, published = rollout(ensemble, ensemble.init((3,)), samples, record=lambda s: s.predictions)
    for k, (name, member) in enumerate(members().items()):
        assert ensemble.names[k] == name
        assert torch.equal(published[..., k], rollout(member, member.init((3,)), samples)[1])
    torch.testing.assert_close(published[..., :3].mean(-1), surge)


def test_rules_see_the_members_that_they_name():
    rules = {"two": Average(["aid", "persistence"]), "fixed": FixedWeights({"rls": 0.25, "aid": 0.75})}
    ensemble, samples = Ensemble(members(), rules, output="two"), random_samples(10)
    _, surge, published = rollout(ensemble, ensemble.init(), samples, record=lambda s: s.predictions)
    aid, rls, persistence, two, fixed = published.unbind(-1)
    torch.testing.assert_close(two, (aid + persistence) / 2)
    torch.testing.assert_close(fixed, 0.25 * rls + 0.75 * aid)
    assert torch.equal(surge, two)


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


def test_recursive_weights_find_the_one_good_member():
    samples = random_samples(2000)
    steady = samples._replace(surge=samples.surge.repeat_interleave(2)[:2000])  # persistence is right every other step
    ensemble = Ensemble(members(), {"weighted": RecursiveWeights()})
    end, _, _ = rollout(ensemble, ensemble.init(), steady)
    aid, rls, persistence = end.combiners["weighted"].weights
    assert persistence > max(aid, rls)


def test_ensembles_of_ensembles():
    inner = {"outer": Ensemble(members()), "persistence": Persistence()}
    ensemble, samples = Ensemble(inner), random_samples(5, 2)
    _, surge, _ = rollout(ensemble, ensemble.init((2,)), samples)
    alone = Ensemble(members())
    expected = (rollout(alone, alone.init((2,)), samples)[1] + torch.cat([torch.zeros(1, 2), samples.surge[:-1]])) / 2
    torch.testing.assert_close(surge, expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"members": {}}, "at least one"),
        ({"combiners": {"aid": Average()}}, "both a member and a combiner"),
        ({"combiners": {"average": Average(["aid", "rnn"])}}, "rnn"),
        ({"output": "boa"}, "boa"),
        ({"members": {"aid": None}}, "expected an estimator"),
        ({"members": {"a.b": AID()}}, "plain name"),
        ({"members": {"keys": AID()}}, "plain name"),
    ],
)
def test_illegal_ensembles_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        Ensemble(**{"members": members(), **arguments})
