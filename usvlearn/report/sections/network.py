"""The networks: whether they are contracting, over the season and for the terminal; equilibria (paper, figure 2)."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from certify.display.figures import equilibria_figure
from certify.proofs import exact
from certify.proofs.equilibria import surge_inputs, sweep
from certify.proofs.rounding import above, below, float_above, float_below
from usvlearn.display.figures import figure_of, guarded, set_reach
from usvlearn.display.terminal import ResultTable
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.rnn.layer import RNN, element_weights
from usvlearn.evaluation.crossval import FreeErrors
from usvlearn.evaluation.diagnostics import Judged, verdicts
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import WORSE, Drawn, Section

PAPER_RESULT = (
    "The contraction condition was a cost in training, and the app showed whether it held. The share of time at which "
    "it held is not reported. A hypothetical network illustrates the equilibria; a contracting network has one."
)
DRAWN = (-0.1, 0.5)  # of x, the speeds at which boats run
HEADINGS = 24  # at which equilibria are looked for
SHOWN = 8  # most boats with a line each
FAR = 2.0  # times the error of the combiner that predicts: open-loop simulations that are far off


def network_section(seasons: Sequence[Season], ensemble: Ensemble, errors: Mapping[str, FreeErrors]) -> Section | None:
    """Margins of the first RNN at every checkpoint, in fractions, and the equilibria of the last networks."""
    members = {name: member for name, member in ensemble.members.items() if isinstance(member, RNN)}
    if not members:
        return None
    name, network = next(iter(members.items()))
    surge_max = 0.5 / network.scale
    networks = {s.boat: [element_weights(s.state.members[name], k) for k in range(len(s.saved_in))] for s in seasons}
    margins: dict[str, dict[str, np.ndarray]] = {}
    rates = {}
    for boat, some in networks.items():
        verdicts = [exact.verdict(weights) for weights in some]
        rates[boat] = np.array([float_above(each.rate) if each else np.nan for each in verdicts])
        for condition in exact.CORNER:
            lowest = [float_below(each.margins[condition]) if each else np.nan for each in verdicts]
            margins.setdefault(condition, {})[boat] = np.array(lowest)
    held = {condition: sum(int((m > 0).sum()) for m in boats.values()) for condition, boats in margins.items()}
    headings = np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)
    inputs = surge_inputs(headings)
    rows, single = [], True
    for season in seasons:
        at_rest = sweep(networks[season.boat][-1], inputs, -1.0, 1.0)
        single, rest = single and all(len(some) == 1 for some in at_rest), [each for some in at_rest for each in some]
        places = [2 * surge_max * each.x for each in rest]
        kinds = ", ".join(f"{kind} {n}" for kind, n in Counter(each.kind for each in rest).items())
        rows.append((season.boat, above(rates[season.boat][-1], 4), len(rest) / HEADINGS, min(places, default=None),
                     max(places, default=None), kinds or "none"))  # fmt: skip
    steps = sum(len(boats) for boats in rates.values())
    here = [f"Certified, of {steps} saved checkpoints: " + ", ".join(f"{c} {n}" for c, n in held.items()) + "."]
    beside = {s.boat: free_words(name, errors[s.boat].unseen(s), ensemble.output) for s in seasons[:SHOWN]}
    here += [f"{boat}, {name}: {words}." for boat, words in beside.items() if words]
    if any(beside.values()):
        here.append(
            "Contraction means that simulations approach each other, not that they are near the measured speed."
        )
    here.append(
        "A network that satisfies the paper's condition (K < ¼) has a time constant below 0.72 steps, and no hull is "
        "so fast. exact (K < 1) is the weakest condition that covers all activation patterns."
    )
    counts = "one equilibrium at each" if single else "none or several at some"
    here.append(f"Without thrust the last networks have {counts} of {HEADINGS} headings.")
    first = seasons[0].boat
    drawn = [
        Drawn(
            "certificates",
            rates_figure({s.boat: s.hours for s in seasons}, rates),
            "The exact rate over all activation patterns at every saved checkpoint, computed in rational arithmetic: "
            "certified below the red line.",
        ),
        Drawn(
            "equilibria",
            guarded(equilibria_figure)(networks[first][-1], inputs, f"{first}: {name} at rest", *DRAWN, headings),
            f"The map of the last network of {first} without thrust, at {HEADINGS} headings; x = v / {2 * surge_max:g} "
            "m/s.",
        ),
    ]
    columns = (
        "boat",
        "K of the last checkpoint, per step",
        "equilibria per heading",
        "least, m/s",
        "greatest, m/s",
        "classes",
    )
    conditions = [
        (boat, condition, int((m > 0).sum()), len(m), below(m.min(), 4), below(m.max(), 4))
        for condition, boats in margins.items()
        for boat, m in boats.items()
    ]
    sheets = [
        ResultTable("equilibria", columns, rows),
        ResultTable(
            "certificates",
            ("boat", "condition", "checkpoints certified", "checkpoints", "least margin", "greatest"),
            conditions,
        ),
    ]
    return Section("network", "The network: certificates and equilibria", PAPER_RESULT, here, drawn, sheets)


def stability(
    ensemble: Ensemble,
    state: EnsembleState,
    boats: Sequence[str],
    free: Mapping[str, Mapping[str, float | None]] | None = None,
) -> list[str]:
    """A line for each RNN and boat, decided in rational arithmetic; for large fleets only the first boats.

    Beside the proof stands the error of its open-loop simulations, MAE in m/s: a network that is contracting may be
    wrong.
    """
    judged = verdicts(ensemble, state, boats[:SHOWN])
    lines = []
    for name in next(iter(judged.values()), {}):
        for boat, each in judged.items():
            beside = free_words(name, (free or {}).get(boat, {}), ensemble.output)
            lines.append(f"{name} of {boat}: {_sentence(each[name])}{beside and f'; {beside}'}")
        if len(boats) > SHOWN:
            lines.append(f"{name}: {len(boats) - SHOWN} more boats: usvlearn certify on the run's folder")
    return lines


def free_words(name: str, free: Mapping[str, float | None], output: str) -> str:
    """How good a network's open-loop simulations are, in words, from MAE in m/s by estimator; "" if that is unknown.

    They are far off if they err FAR times as much as the combiner that predicts, or no less than persistence, which
    keeps the speed at which a segment starts.
    """
    if (error := free.get(name)) is None:
        return ""
    others = {each: x for each in (output, PERSISTENCE) if (x := free.get(each)) is not None}
    far = error > FAR * others.get(output, math.inf) or error >= others.get(PERSISTENCE, math.inf)
    shown = {each: x for each, x in others.items() if far or each != PERSISTENCE}
    beside = f" ({', '.join(f'{each} {x:.3f}' for each, x in shown.items())})" if shown else ""
    return f"open-loop simulations {'are far off: they ' if far else ''}err by {error:.3f} m/s{beside}"


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


@guarded
def rates_figure(hours: Mapping[str, np.ndarray], rates: Mapping[str, np.ndarray]):
    """The contraction rate K, `(checkpoints,)`, a line per boat: certified where it is below one."""
    from matplotlib import colormaps

    shades = colormaps["viridis"](np.linspace(0.25, 0.92, max(2, len(hours))))  # hues are reserved for methods
    figure = figure_of(6.4, 2.9)
    panel = figure.subplots()
    for (boat, values), shade in zip(rates.items(), shades, strict=False):
        panel.plot(hours[boat], values, color=shade, linewidth=1.3, marker=".", markersize=3, label=boat)
    every = np.concatenate(list(rates.values()))
    low, high = np.nanmin(every, initial=1.0), np.nanmax(every, initial=1.0)
    room = 0.08 * (high - low) + 1e-3
    set_reach(panel, low - room, high + room)
    panel.axhspan(1.0, high + room, color=WORSE, alpha=0.12, linewidth=0)
    panel.axhline(1.0, color=WORSE, linewidth=1)
    panel.set(xlabel="time on the water, h", ylabel="contraction rate K, per step")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper left", ncols=8)
    return figure
