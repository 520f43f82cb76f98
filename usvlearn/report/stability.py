"""Whether the learned networks are contracting: one line each, for the console."""

from __future__ import annotations

import math
from collections.abc import Sequence

from certify.rounding import above, below
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.evaluation.networks import Verdict, verdicts

SHOWN = 8  # most boats with a line each


def stability(ensemble: Ensemble, state: EnsembleState, boats: Sequence[str]) -> list[str]:
    """A line for each RNN and boat, decided in rational arithmetic; for large fleets only the first boats.

    Args:
        ensemble: to which the state belongs.
        state: leaves `(boats, …)`.
        boats: their names.

    >>> from usvlearn import RNN
    >>> ensemble = Ensemble({"rnn": RNN(surge_max=2.7)})
    >>> stability(ensemble, ensemble.init((1,)), ["heron"])[0].split(", K")[0]
    'rnn of heron: certified contracting by tight'
    """
    found = verdicts(ensemble, state, boats[:SHOWN])
    lines = []
    for name in next(iter(found.values()), {}):
        lines += [f"{name} of {boat}: {_sentence(each[name])}" for boat, each in found.items()]
        if len(boats) > SHOWN:
            lines.append(f"{name}: {len(boats) - SHOWN} more boats: usvlearn certify on the run's folder")
    return lines


def _sentence(verdict: Verdict) -> str:
    if verdict.rate is None:
        return "its weights are not finite"
    if not verdict.held:
        return (
            f"not certified contracting, K = {below(verdict.rate, 4)} (≥ 1) a step; usvlearn certify --box may still "
            "certify it"
        )
    rest = f"; at rest {verdict.equilibrium:.3f} m/s" if math.isfinite(verdict.equilibrium) else ""
    slow = f" ({verdict.time_constant:.3g} s)" if verdict.time_constant > 0 else ""
    return f"certified contracting by {', '.join(verdict.held)}, K = {above(verdict.rate, 4)} a step{slow}{rest}"
