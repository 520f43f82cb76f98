"""The studies in `benchmarks/` compose: every ablation is an ensemble that can be built."""

import pytest
from ablation import OTHERS, pieces, settings

from tests.support import few
from usvlearn import Ensemble

PIECES = pieces()


def test_every_member_is_switched_off_or_added_in_turn():
    default = settings((), ())
    weighed = default["combiners"]["ensemble"]["members"]
    assert {f"without {name}" for name in weighed} < set(PIECES)
    assert {f"and {name}" for name in {*default["estimators"], *OTHERS} - {*weighed}} < set(PIECES)


@pytest.mark.thorough
@pytest.mark.parametrize("piece", few(PIECES, list(PIECES)[::8]))
def test_ablations_build_another_ensemble(piece):
    from hydra.utils import instantiate

    default, cfg = settings((), ()), settings((), tuple(PIECES[piece]))
    changed = {group: cfg[group] for group in ("estimators", "combiners")}
    assert changed != {group: default[group] for group in changed}
    rules = {"ensemble": instantiate(cfg["combiners"]["ensemble"], _convert_="all")}
    ensemble = Ensemble(instantiate(cfg["estimators"]), rules)
    assert ensemble.init((2,)).predictions.shape == (2, len(ensemble.names))
