"""The list of estimators that every property in test_contracts.py runs over, without exclusions.

A new estimator is one line here.
"""

from usvlearn import (
    AID,
    RLS,
    RNN,
    Average,
    Ensemble,
    FixedWeights,
    Persistence,
    QuasiStatic,
    RecursiveWeights,
    SurgeDynamics,
)


def _members() -> dict:
    return {"aid": AID(28.0), "rls": RLS(), "rnn": RNN(6)}


ESTIMATORS = {
    "aid": lambda: AID(28.0),
    "aid_estimate": lambda: AID(28.0, feedback="estimate", dead_zone=0.01),
    "rls": lambda: RLS(QuasiStatic(), forgetting=0.98),
    "dynamic_rls": lambda: RLS(SurgeDynamics(28.0), forgetting=0.98),
    "dynamic_rls_estimate": lambda: RLS(SurgeDynamics(28.0), forgetting=0.98, feedback="estimate"),
    "rnn": lambda: RNN(6),
    "rnn_penalty": lambda: RNN(6, stability="penalty", penalty=1e-3, unroll=2, decay=None),
    "rnn_estimate": lambda: RNN(6, condition="interval", unroll=2, feedback="estimate"),
    "persistence": Persistence,
    "average": lambda: Ensemble(_members()),
    "fixed": lambda: Ensemble(_members(), {"fixed": FixedWeights({"aid": 0.5, "rls": 0.2, "rnn": 0.3})}),
    "weighted": lambda: Ensemble(
        _members(), {"average": Average(["aid", "rls"]), "weighted": RecursiveWeights(forgetting=0.98)}
    ),
}
