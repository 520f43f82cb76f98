"""Whether the learned networks are contracting, decided in rational arithmetic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.proofs.rounding import float_above, float_below
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.rnn.layer import RNN, element_weights


class Verdict(NamedTuple):
    """What is proved of one network."""

    held: tuple[str, ...]  # the conditions that hold, the narrowest first; none if it is not certified
    rate: Fraction | None  # K per step; None if the weights are not finite
    time_constant: float  # s; not positive if there is none
    equilibrium: float  # m/s, at rest, the one that is nearest to the speed; NaN if there is none

    def json(self) -> dict[str, Any]:
        """For `results.json`; the rate is rounded so that the verdict stays true."""
        rate = None if self.rate is None else (float_above if self.held else float_below)(self.rate)
        return {"contracting": bool(self.held), "condition": self.held[0] if self.held else None, "rate": rate}


def verdicts(ensemble: Ensemble, state: EnsembleState, boats: Sequence[str]) -> dict[str, dict[str, Verdict]]:
    """The verdict of each RNN of each boat, boat -> member -> verdict; {} without an RNN.

    Args:
        ensemble: to which the state belongs.
        state: leaves `(boats, …)`.
        boats: their names; the first batch elements of the state.

    >>> ensemble = Ensemble({"rnn": RNN(surge_max=2.7)})
    >>> verdicts(ensemble, ensemble.init((1,)), ["heron"])["heron"]["rnn"].json()["contracting"]
    True
    """
    members = {name: member for name, member in ensemble.members.items() if isinstance(member, RNN)}
    found: dict[str, dict[str, Verdict]] = {boat: {} for boat in boats} if members else {}
    for name, member in members.items():
        learned = state.members[name]
        monitored = {key: value.tolist() for key, value in member.monitor(learned).items()}
        for element, boat in enumerate(boats):
            numbers = (monitored[key][element] for key in ("time_constant", "equilibrium"))
            found[boat][name] = verdict(element_weights(learned, element), *numbers)
    return found


def verdict(weights: ShallowWeights, time_constant: float = math.nan, equilibrium: float = math.nan) -> Verdict:
    """The verdict of one network."""
    if not all(np.isfinite(part).all() for part in weights):
        return Verdict((), None, math.nan, math.nan)
    conditions = exact.conditions(weights.a, weights.w1)
    held = tuple(name for name, condition in conditions.items() if condition.margin > 0)
    return Verdict(held, max(exact.extreme_slopes(weights.a, weights.w1)), time_constant, equilibrium)
