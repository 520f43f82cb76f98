"""What speaks against the use of a fit."""

from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.fitted_boats import TOP
from tests.support.saved_fits import facts
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.model.fit import fitted
from usvlearn.model.fit.diagnostics import doubts
from usvlearn.model.fit.gauss_newton import LAGS, Missions
from usvlearn.model.fit.terms import AT, PLACE_LAG, PLACE_TIME, prior


def said(theta=(), cross=None, online=None, lag=0.0, **changed: float) -> tuple[str, ...]:
    fit = Missions([], TOP).evaluate("curves", prior("curves", TOP).mean.copy(), 0.1)
    for place, value in theta:
        fit.theta[place] = value
    values = {name: Quantity(*each.values()) for name, each in facts()["quantities"].items()}
    values |= {name: Quantity(value, value - 1, value + 1, "") for name, value in changed.items()}
    lags = [-1.0, 0.0, 0.5, 1.0]
    white = {"lags": lags, "values": [0.9, 0.1, 0.1, None], "bounds": [0.1, 0.1, 0.1, None]}
    return doubts(fit, values, {"mean": white, "difference": white} | (cross or {}), online, lag)


def test_nothing_speaks_against_a_good_fit():
    assert said(lag=0.7, time_constant=2.0, theta=[(PLACE_TIME, 0.6)]) == ()
    assert said(theta=[(PLACE_LAG, LAGS[0]), (PLACE_TIME, 0.1)]) == ()
    assert said() == () == said(online=facts() and {"drag_linear": Quantity(-900.0, -901.0, -899.0, "")})


@pytest.mark.parametrize(
    "given, words",
    [
        ({"drag_linear": 2.0}, "The drag would push the boat, or falls with speed (drag_linear)"),
        ({"theta": [(AT["drag_node_0.6"], 9.0)]}, "(its curve)"),
        ({"theta": [(PLACE_LAG, LAGS[1])]}, "The lag of the thrust is at its bound"),
        ({"theta": [(PLACE_LAG, LAGS[0]), (PLACE_TIME, 0.4)]}, "lag its command by 0.4 s, yet begin before it"),
        (
            {"cross": {"mean": {"lags": [0.0, 0.5, 1.0], "values": [0.0, 0.1, -0.3], "bounds": [0.1] * 3}}},
            "follow the mean command, most after 1 s",
        ),
        ({"lag": 0.7, "time_constant": 2.0}, "The thrust follows the commands by 0.7 s in turns, but by 0.0 s ahead"),
        ({"online": {"time_constant": Quantity(99.0, 98.0, np.inf, "s")}}, "do not meet for time_constant"),
    ],
)
def test_each_doubt_is_one_sentence_with_what_to_do(given, words):
    (sentence,) = said(**given)
    assert words in sentence and sentence.endswith(".") and len(sentence) < 300


def test_quantities_that_no_boat_can_have_are_a_doubt(monkeypatch):
    monkeypatch.setattr(fitted, "doubts", lambda *_: ("It hardly brakes.",))
    for wrong in ("", "It goes astern."):
        one = SimpleNamespace(identified=SimpleNamespace(unphysical=wrong), fit=None, online=None, lag=0.0,
                              diagnostics={"cross_correlation": {}})  # fmt: skip
        assert fitted.Fitted.doubts.func(one) == (*filter(None, [wrong]), "It hardly brakes.")
