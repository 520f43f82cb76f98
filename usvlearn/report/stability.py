"""Whether the learned networks are contracting: one line each, for the console."""

from __future__ import annotations

import math
from collections.abc import Sequence

from certify import exact
from certify.rounding import above, below
from certify.weights import ShallowWeights
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.rnn.layer import RNN, lane_weights

SHOWN = 8  # most boats with a line each


def stability(ensemble: Ensemble, state: EnsembleState, boats: Sequence[str]) -> list[str]:
    """A line for each RNN and boat, decided in rational arithmetic; for large fleets only the first boats.

    Args:
        ensemble: to which the state belongs.
        state: leaves `(boats, …)`.
        boats: their names.

    >>> ensemble = Ensemble({"rnn": RNN(surge_max=2.7)})
    >>> stability(ensemble, ensemble.init((1,)), ["heron"])[0].split(", K")[0]
    'rnn of heron: certified contracting by tight'
    """
    lines = []
    for name, member in ensemble.members.items():
        if not isinstance(member, RNN):
            continue
        learned = state.members[name]
        monitored = {key: value.tolist() for key, value in member.monitor(learned).items()}
        for lane, boat in enumerate(boats[:SHOWN]):
            numbers = {key: value[lane] for key, value in monitored.items()}
            lines.append(f"{name} of {boat}: {_verdict(lane_weights(learned, lane), numbers)}")
        if len(boats) > SHOWN:
            lines.append(f"{name}: {len(boats) - SHOWN} more boats: python -m certify on the run's folder")
    return lines


def _verdict(weights: ShallowWeights, numbers: dict[str, float]) -> str:
    if not math.isfinite(numbers["contraction_rate"]):
        return "its weights are not finite"
    conditions, constant = exact.conditions(weights.a, weights.w1), numbers["time_constant"]
    K = max(exact.extreme_slopes(weights.a, weights.w1))
    held = [name for name, condition in conditions.items() if condition.margin > 0]
    if not held:
        return (
            f"not certified contracting, K = {below(K, 4)} (≥ 1) a step; python -m certify --box may still certify it"
        )
    rest = f"; at rest {numbers['equilibrium']:.3f} m/s" if math.isfinite(numbers["equilibrium"]) else ""
    slow = f" ({constant:.3g} s)" if constant > 0 else ""
    return f"certified contracting by {', '.join(held)}, K = {above(K, 4)} a step{slow}{rest}"
