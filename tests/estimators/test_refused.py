"""What an estimator is given and cannot be: one sentence that names the argument."""

import math

import pytest

from tests.support import over
from tests.support.forecasts import ensemble
from usvlearn import (
    AID,
    ARX,
    BOA,
    RLS,
    RNN,
    Average,
    Ensemble,
    ExponentialWeights,
    JointEKF,
    Persistence,
    QuasiStatic,
    Robust,
    SIFtRLS,
    SurgeDynamics,
    Trial,
)
from usvlearn.errors import ConfigError

MAP = QuasiStatic()
NAN, INF = math.nan, math.inf
ONE_BY_ONE = (  # what makes an estimator, and arguments that are refused by their own name, each alone
    (AID, {"mass": [0.0], "gain": [-1.0], "spread": [[1.0], [-1.0] * 9, [NAN] * 9], "theta0": [[1.0] * 9, [1.0] * 8],
           "dead_zone": [-1.0], "sigma": [-1.0], "bound": [0.0], "feedback": [""],
           "known": [{"thrust": 1.0}, {}, {"drag_linear": 0.0}, {"drag_linear": NAN}, {"drag_linear": "heavy"},
                     {"drag_linear + ": 1.0}]}),
    (lambda **given: AID(model=MAP, **given), {"known": [{MAP.names[0]: 1.0}]}),  # a map has no mass
    (lambda **given: SurgeDynamics(**given), {"mass": [0.0, -1.0, NAN, "heavy", [28.0, 0.0]]}),
    (RLS, {"forgetting": [1.0], "covariance": [0.0], "feedback": ["both"], "surge_max": [-1.0]}),
    (SIFtRLS, {"memory": [0.0], "covariance": [-1.0], "floor": [-1e-4], "feedback": ["both"]}),
    (lambda **given: Robust(AID(28.0), **given),
     {"threshold": [0.0], "patience": [0, 1.5], "inflation": [0.5], "scale": [0.0], "memory": [0.5],
      "scale_min": [0.0]}),
    (RNN, {"unroll": [3], "neurons": [0, 1], "rate": [0.0], "surge_max": [0.0], "decay": [0], "momentum": [1.0, -0.1],
           "clip": [0.0], "initial": ["zero"], "rate_ratio": [[1.0] * 4, [-1.0] * 5], "stability": ["hope"],
           "condition": ["loose"], "contraction_rate": [1.5], "gauge": ["x"], "replay_size": [-1, 1.0, True, 10**6],
           "replay_steps": [0, 10**6]}),
    (lambda **given: JointEKF(**{"surge_max": 2.0} | given),
     {"mass": [0.0], "surge_max": [-1.0], "disturbance": [0.0], "outlier": [0.0], "estimate_every": [-1.0],
      "theta0": [[1.0], [1.0] * 9]}),
    (ARX, {"lags": [-1, 2.0, True, 51], "even": ["yes"], "turning": [1], "project": [None], "scale": [0.0],
           "walk": [-1.0], "degrees": [0.0, -INF], "surge_max": [0.0]}),
    (lambda **given: BOA(**given), {"loss": ["huber"], "memory": [0.0], "scale": [0.0], "share": [1.5]}),
    (ExponentialWeights, {"rate": [-1.0]}),
    (lambda **given: ensemble(**given),
     {"horizons": [(2.0, 1.0), (), (-1.0,)], "overlap": [0.0, 1000.0], "members": [["rnn"], ["aid", "aid"], []],
      "share": [2.0]}),
)  # fmt: skip


@over("case", [(make, name, value) for make, wrong in ONE_BY_ONE for name, values in wrong.items() for value in values])
def test_an_argument_is_refused_by_its_name(case):
    make, name, value = case
    with pytest.raises(ConfigError, match=rf"{name}\b.*: found .*expected "):
        make(**{name: value})


BETWEEN = r"trial.leads: found .* expected a number between trial.dropped"  # and trial.confirmed, strictly
SENTENCES = {  # what is made, and what is said
    "trial below": (lambda: Trial(leads=-2.0), BETWEEN),
    "trial above": (lambda: Trial(leads=150.0), BETWEEN),
    "trial at its end": (lambda: Trial(leads=5.0, confirmed=5.0), BETWEEN),
    "trial that is dropped first": (lambda: Trial(dropped=6.0), BETWEEN),
    "trial without threshold": (lambda: Trial(threshold=0.0), "trial.threshold: found 0.0, expected a positive number"),
    "trial without steps": (lambda: Trial(steps=0), "trial.steps: found 0, expected a whole number"),
    "nobody": (lambda: Ensemble({}), "at least one"),
    "no estimator": (lambda: _ensemble(members={"aid": None}), "expected an estimator"),
    "dotted": (lambda: _ensemble(members={"a.b": AID()}), "plain name"),
    "keys": (lambda: _ensemble(members={"keys": AID()}), "plain name"),
    "rule and member": (lambda: _ensemble(combiners={"aid": Average()}), "names two members, or a member and a combin"),
    "unknown member": (lambda: _ensemble(combiners={"average": Average(["aid", "rnn"])}), "rnn"),
    "output": (lambda: _ensemble(output="boa"), "boa"),
    "coverage": (lambda: _ensemble(coverage=1.0), "coverage"),
    "surge_max": (lambda: _ensemble(surge_max=0.0), "surge_max"),
    "prior": (lambda: _ensemble(combiners={"boa": BOA(prior={"rls": 2.0})}), "prior: found rls, expected so"),
    "no prior": (lambda: BOA(prior={"a": 0.0}), "prior.a"),
    "too many forecasts": (lambda: ensemble(overlap=1000.0), "overlap: found 1000.0, expected less: .* of 512 at most"),
}  # fmt: skip


def _ensemble(**given) -> Ensemble:
    return Ensemble(**{"members": {"aid": AID(28.0), "persistence": Persistence()}, **given})


@pytest.mark.parametrize("case", SENTENCES)
def test_what_does_not_fit_together_is_said(case):
    make, words = SENTENCES[case]
    with pytest.raises(ConfigError, match=words):
        make()
