"""Whether the learned networks are contracting, decided in rational arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from certify.proofs import exact
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.rnn.layer import RNN, element_weights


class Judged(NamedTuple):
    """What is proved of one network, and where it comes to rest."""

    proved: exact.Verdict | None  # None if the weights are not finite
    time_constant: float  # s; not positive if there is none
    equilibrium: float  # m/s, at rest, the one that is nearest to the speed; NaN if there is none

    def json(self) -> dict[str, Any]:
        """For `results.json`."""
        return exact.as_json(self.proved)


def verdicts(ensemble: Ensemble, state: EnsembleState, boats: Sequence[str]) -> dict[str, dict[str, Judged]]:
    """The verdict of each RNN of each boat, boat -> member -> verdict; {} without an RNN.

    Args:
        ensemble: to which the state belongs.
        state: leaves `(boats, …)`.
        boats: their names; the first batch elements of the state.

    >>> ensemble = Ensemble({"rnn": RNN(surge_max=2.7)})
    >>> verdicts(ensemble, ensemble.init((1,)), ["heron"])["heron"]["rnn"].proved.held
    ('exact',)
    """
    members = {name: member for name, member in ensemble.members.items() if isinstance(member, RNN)}
    found: dict[str, dict[str, Judged]] = {boat: {} for boat in boats} if members else {}
    for name, member in members.items():
        learned = state.members[name]
        monitored = {key: value.tolist() for key, value in member.monitor(learned).items()}
        for element, boat in enumerate(boats):
            numbers = (monitored[key][element] for key in ("time_constant", "equilibrium"))
            found[boat][name] = Judged(exact.verdict(element_weights(learned, element)), *numbers)
    return found
