"""Members of other code aboard: made of the settings in a checkpoint, from modules that are trusted, else left out."""

import pytest

from usvlearn import BOA, Ensemble, Inputs, Online, Persistence, external
from usvlearn.core.samples import Sample
from usvlearn.errors import CheckpointError
from usvlearn.live.trusted_members import trusted_members, without

MINE = """
class Double:
    def predict(self, x):
        return 2 * x.speed
    def learn(self, x, y):
        pass
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
