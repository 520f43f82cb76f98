"""Members of other code aboard: made of the settings in a checkpoint, from modules that are trusted, else left out."""

import pytest

from tests.support.live import boat, messages, ready, sail
from usvlearn import BOA, Ensemble, Inputs, Online, Persistence, external
from usvlearn.core.samples import Sample
from usvlearn.errors import CheckpointError
from usvlearn.live.trusted_members import trusted_members, without

MINE = """
class Double:
    def __init__(self, most=1e9):
        self.left = most
    def predict(self, x):
        if self.left < 0:
            raise RuntimeError("no licence")
        return 2 * x.speed
    def learn(self, x, y):
        self.left -= 1
"""


def test_they_are_made_of_trusted_modules_alone(tmp_path, monkeypatch):
    (tmp_path / "doubles.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    import doubles

    ensemble = Ensemble({"mine": external(doubles.Double()), "still": Persistence()}, {"boa": BOA()})
    settings = {"mine": {"_target_": "usvlearn.external", "model": {"_target_": "doubles.Double"}}}
    online = Online(ensemble)
    leaves, facts = online._live.leaves, {"estimator": "Ensemble", "kernel": online.description}
    assert trusted_members(facts, ()) == {} and "mine predicts nothing here: trust its module" in without(facts, {})
    with pytest.raises(CheckpointError, match="does not say how mine is made"):
        trusted_members(facts, ["doubles"])
    facts["configuration"] = {"estimators": settings}
    with pytest.raises(CheckpointError, match=r"found 'doubles\.Double', expected a class below"):
        trusted_members(facts, ["others"])
    aboard = Online.of(leaves, facts, trusted_members(facts, ["doubles"]))
    begin, one = Inputs(0.0, 0.0, 0.0, 0.0, 0.0), Inputs(0.5, 0.5, 0.0, 0.0, 0.4)
    for node in (aboard, online):
        node.step(Sample(begin, 0.7, False, False))
        node.step(Sample(one, 0.8, True, True))
        assert node.last_predictions()["mine"][0] == 1.4
    assert without(facts, trusted_members(facts, ["doubles"])) == ""


def test_a_node_continues_with_them_and_says_which_has_failed(tmp_path, monkeypatch):
    """One that fails stays away: neither a save nor a new session begins it again."""
    (tmp_path / "few_doubles.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    import few_doubles

    ensemble = Ensemble({"mine": external(few_doubles.Double(20)), "still": Persistence()}, {"boa": BOA()})
    made = {"_target_": "usvlearn.external", "model": {"_target_": "few_doubles.Double", "most": 20}}
    start = Online(ensemble).save(tmp_path / "start.safetensors", configuration={"estimators": {"mine": made}})
    failed = "estimators.mine: it failed before: the run goes on without it"
    given = {"mass": 28.0, "surge_max": 2.7, "trust": ("few_doubles",)}
    with ready(tmp_path / "node", start, **given) as node, pytest.warns(UserWarning, match="no licence"):
        sail(node, messages(boat(0.02)))
        first = next(each for each in node.tick().warnings if "no licence" in each)
        node.save()
        sail(node, messages(boat(0.02), 2e9))
        assert first in node.tick().warnings and "RuntimeError: no licence: the run goes on without it" in first
    with ready(tmp_path / "node", None, **given) as node:
        sail(node, messages(boat(0.02), 3e9))
        assert failed in node.tick().warnings
