"""The studies in `benchmarks/` compose: every ablation is an ensemble that can be built."""

import pytest
from ablation import pieces, settings

from usvlearn import Ensemble

MEMBERS = (
    "aid",
    "sift_map",
    "rnn",
    "dynamic_rls",
    "steady_rls",
    "memory_aid",
    "memory_rls",
    "ambient_rls",
    "persistence",
    "reader",
)
PIECES = pieces(MEMBERS)


def test_every_member_is_switched_off_in_turn():
    assert set(settings((), ())["estimators"]) == set(MEMBERS)
    assert {f"without {name}" for name in MEMBERS} < set(PIECES)


@pytest.mark.parametrize("piece", PIECES)
def test_ablations_build_another_ensemble(piece):
    from hydra.utils import instantiate

    default, cfg = settings((), ()), settings((), tuple(PIECES[piece]))
    changed = {group: cfg[group] for group in ("estimators", "combiners")}
    assert changed != {group: default[group] for group in changed}
    rules = {"ensemble": instantiate(cfg["combiners"]["ensemble"], _convert_="all")}
    ensemble = Ensemble(instantiate(cfg["estimators"]), rules)
    assert ensemble.init((2,)).predictions.shape == (2, len(ensemble.names))
