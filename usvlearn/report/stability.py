"""Whether the learned networks are contracting: one line each, for the console."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from certify.proofs.rounding import above, below
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.evaluation.networks import Judged, verdicts

SHOWN = 8  # most boats with a line each
FAR = 2.0  # times the error of the combiner that predicts: open-loop simulations that are far off


def stability(
    ensemble: Ensemble,
    state: EnsembleState,
    boats: Sequence[str],
    free: Mapping[str, Mapping[str, float | None]] | None = None,
) -> list[str]:
    """A line for each RNN and boat, decided in rational arithmetic; for large fleets only the first boats.

    Beside the proof stands the error of its open-loop simulations: a network that is contracting may still be wrong.

    Args:
        ensemble: to which the state belongs.
        state: leaves `(boats, …)`.
        boats: their names.
        free: MAE of open-loop simulations, m/s, by boat and estimator; None if they are unknown.

    >>> from usvlearn import RNN
    >>> ensemble = Ensemble({"rnn": RNN(surge_max=2.7)})
    >>> stability(ensemble, ensemble.init((1,)), ["heron"])[0].split(", K")[0]
    'rnn of heron: certified contracting by tight'
    """
    found = verdicts(ensemble, state, boats[:SHOWN])
    lines = []
    for name in next(iter(found.values()), {}):
        for boat, each in found.items():
            beside = free_words(name, (free or {}).get(boat, {}), ensemble.output)
            lines.append(f"{name} of {boat}: {_sentence(each[name])}{beside and f'; {beside}'}")
        if len(boats) > SHOWN:
            lines.append(f"{name}: {len(boats) - SHOWN} more boats: usvlearn certify on the run's folder")
    return lines


def free_words(name: str, free: Mapping[str, float | None], output: str) -> str:
    """How good a network's open-loop simulations are, in words; "" if that is unknown.

    They are far off if they err FAR times as much as the combiner that predicts, or no less than persistence, which
    keeps the speed at which a segment starts.

    Args:
        name: of the network.
        free: MAE of open-loop simulations, m/s, by estimator.
        output: the combiner that predicts.

    >>> free_words("rnn", {"rnn": 0.17, "ensemble": 0.16}, "ensemble")
    'open-loop simulations err by 0.170 m/s (ensemble 0.160)'
    >>> free_words("rnn", {"rnn": 0.6, "ensemble": 0.1, "persistence": 0.5}, "ensemble")
    'open-loop simulations are far off: they err by 0.600 m/s (ensemble 0.100, persistence 0.500)'
    """
    if (own := free.get(name)) is None:
        return ""
    others = {each: x for each in (output, PERSISTENCE) if (x := free.get(each)) is not None}
    far = own > FAR * others.get(output, math.inf) or own >= others.get(PERSISTENCE, math.inf)
    shown = {each: x for each, x in others.items() if far or each != PERSISTENCE}
    beside = f" ({', '.join(f'{each} {x:.3f}' for each, x in shown.items())})" if shown else ""
    return f"open-loop simulations {'are far off: they ' if far else ''}err by {own:.3f} m/s{beside}"


def _sentence(judged: Judged) -> str:
    verdict = judged.proved
    if verdict is None:
        return "its weights are not finite"
    if not verdict.held:
        return (
            f"not certified contracting, K = {below(verdict.rate, 4)} (≥ 1) a step; usvlearn certify --box may still "
            "certify it"
        )
    rest = f"; at rest {judged.equilibrium:.3f} m/s" if math.isfinite(judged.equilibrium) else ""
    slow = f" ({judged.time_constant:.3g} s)" if judged.time_constant > 0 else ""
    return f"certified contracting by {', '.join(verdict.held)}, K = {above(verdict.rate, 4)} a step{slow}{rest}"
