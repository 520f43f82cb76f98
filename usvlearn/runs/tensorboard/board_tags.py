"""The runs and tags of a replay in TensorBoard: which number of `Ensemble.monitor` is drawn where.

TensorBoard has seven colours, which it gives to runs in their order, again and again. The estimators of SEVEN have one
each, so every boat has them first, then those of SECOND. Another run takes the place of one that does not exist, so
that the rest keep their colours; where there is no other run, the colours after it move on by one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from usvlearn.display.figures import SEVEN
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.evaluation import measure
from usvlearn.evaluation.measure import Measure

IDENTIFIED, LOW, HIGH, TRUTH = "identified", "identified low", "identified high", "truth"
SECOND = ((TRUTH,), (LOW,), (IDENTIFIED,), ("weighted",), ("joint_quick",), ("joint_averaged",), (HIGH,))
FLEET, RESULTS = "fleet", "results"
# settings that do not say how it is learned, with all below them, and those below them that are named
BESIDE = ("data", "vehicle", "hydra", "sweep", "save_minutes", "threads", "resume", "log", "objective")
NAMED = ("data.plant", "data.seed")
# of tags; AHEAD: of the MAE over a horizon
RESULT_NUMBERS = {
    "MAE (m/s)": 1, "skill": 2, "MAE free (m/s)": 3, "contraction rate": 4, "coverage of 90 %": 6, "seconds": 7,
}  # fmt: skip
AHEAD = 5
NEAR = 10.0  # s: the horizon that is shown, or else the longest below

MAE, SKILL, INSIDE = "MAE, next step (m/s)", "skill, next step", "coverage of 90 %, next step"
ALARMS = "thruster alarms so far"
CONTRACTION = {
    "contraction_rate": "rate K (a step)", "time_constant": "time constant (s)",
    "equilibria": "equilibria at rest (number)", "equilibrium": "equilibrium at rest (m/s)",
}  # fmt: skip
WATCHED = {f"effectiveness_{side}": f"thrust left over, {side} (share)" for side in ("left", "right")} | {
    f"evidence_{side}": f"evidence of a loss of thrust, {side}" for side in ("left", "right")
}
REPORTED = {
    "scale": "scale (m/s)", "clipped": "clipped samples", "rejected": "rejected samples", "escaped": "escapes",
    "mass": "mass (kg)", "least_excitation": "least excitation (0 to 1)",
}  # fmt: skip
WORDS = {  # of a tag: what TensorBoard shows beside it
    "1 overview/": "Over the last 750 steps, or those since the point before. Skill: 1 - MAE/MAE(persistence) over the "
    "same steps. Coverage: share of the measurements in the 90 % intervals.",
    f"1 overview/{ALARMS}": "Alarms of a lost thruster so far.",
    "1 tracks/": "Over the last 750 steps: mean distance between forecast and measured position; the run persistence "
    "has that of a constant turn, in which the measured speed and yaw rate go on. Coverage: share of the positions in "
    "the ellipses of 90 %.",
    "2 identified/": "Value, 90 % interval and, of simulated boats, truth are runs beside each other. An end of the "
    "interval that is farther from the value than 4 times the value is left out.",
    "3 weights/": "The run is the member that is weighed.",
    "4 contraction/": "Of the network of the run.",
    "4 contraction/equilibrium": "Without thrust; the one that is nearest to the speed.",
    "4 contraction/margin": "The network is contracting where one of the margins is > 0.",
    f"4 contraction/{CONTRACTION['contraction_rate']}": "Contracting where K < 1.",
    "5 data/": "So far; rejected messages are those of the whole log.",
    "6 diagnostics/whiteness": "Correlation of successive errors; 0 where nothing is left to learn from them.",
    "6 diagnostics/least": "Of all parameters: 0 where one is a guess, 1 where all are informed.",
    "6 diagnostics/": "What the estimator of the run reports about itself.",
    "8 results/": "Of the whole run.",
}


def about(tag: str) -> str:
    """The description of a tag.

    >>> about("4 contraction/margin tight")
    'The network is contracting where one of the margins is > 0.'
    """
    return max(((head, text) for head, text in WORDS.items() if tag.startswith(head)), default=("", ""))[1]


def ahead(horizon: float) -> dict[str, str]:
    """The tags of a horizon, s, that correspond to MAE, SKILL and INSIDE."""
    return {tag: tag.replace("next step", f"{horizon:g} s ahead") for tag in (MAE, SKILL, INSIDE)}


def shown_horizon(horizons: Sequence[float]) -> int:
    """The index of the longest horizon up to NEAR; of the shortest, if all are longer.

    >>> shown_horizon([0.4, 5.2, 10.0, 30.0])
    2
    """
    return max((k for k, h in enumerate(horizons) if h <= NEAR), key=lambda k: horizons[k], default=0)


def quantity_tag(name: str) -> str:
    """The tag of an identified quantity; the nine single parameters are among the rest."""
    unit = (QUANTITIES | TURNING)[name]
    return f"{'9 all' if name in SURGE else '2 identified'}/{name} ({unit})"


def place(key: str, output: str, horizon: float | None) -> tuple[str, str]:
    """The run and the tag of a number of `Ensemble.monitor`; a tag in `9 all` is written only with `log: all`.

    Args:
        key: NAME/NUMBER.
        output: the ensemble's combiner, in whose run is what concerns the boat.
        horizon: the one that is shown, s.

    >>> place("ensemble/weight_aid", "ensemble", 10.0), place("rnn/margin_tight", "ensemble", 10.0)
    (('aid', '3 weights/weight of ensemble'), ('rnn', '4 contraction/margin tight (> 0)'))
    >>> place("aid/drag_linear", "ensemble", 10.0)
    ('aid', '9 all/drag_linear')
    """
    name, _, number = key.partition("/")
    head, _, rest = number.partition("_")
    if name == "monitors":
        if number == "alarms":
            return output, f"1 overview/{ALARMS}"
        if number in WATCHED:
            return output, f"6 diagnostics/{WATCHED[number]}"
        if head in ("whiteness", "scale") and number != "whiteness_band":
            title = "whiteness of the errors (lag 1)" if head == "whiteness" else "scale of the errors (m/s)"
            return rest, f"6 diagnostics/{title}"
        return output, f"9 all/{number}"
    if name == "forecasts":
        what, _, at = number.rpartition("_at_")
        own = horizon is not None and at == f"{horizon:g}"
        if what == "halfwidth":
            title = f"half-width of the 90 % interval, {at} s ahead (m/s)"
            return output, f"{'6 diagnostics' if own else '9 all'}/{title}"
        return what.removeprefix("weight_"), f"{'3 weights' if own else '9 all'}/weight {at} s ahead"
    if head == "weight":
        return rest, f"3 weights/weight of {name}"
    if head == "margin":
        return name, f"4 contraction/margin {rest} (> 0)"
    if number in CONTRACTION:
        return name, f"4 contraction/{CONTRACTION[number]}"
    return name, f"6 diagnostics/{REPORTED[number]}" if number in REPORTED else f"9 all/{number}"


def in_order(boats: Mapping[str, Sequence[str]]) -> list[str]:
    """All runs, BOAT/RUN, in the order in which TensorBoard gives them colours.

    Args:
        boats: the runs of each boat.

    >>> in_order({"a": ["ensemble", "mine", "aid"], "b": ["aid", "ensemble"]})
    ['a/mine', 'a/aid', 'a/ensemble', 'b/aid', 'b/ensemble']
    """
    rows = [_rows(runs) for runs in boats.values()]
    return [
        f"{boat}/{run}"
        for row in zip_longest(*rows, fillvalue=())
        for boat, runs in zip(boats, row, strict=True)
        for run in runs
    ]


def _rows(runs: Sequence[str]) -> list[list[str]]:
    """The runs of a boat, seven in a row."""
    places = [*SEVEN, *SECOND]
    fixed = {name for names in places for name in names}
    spare = [run for run in runs if run not in fixed]
    order = []
    for names in places:
        found = [name for name in names if name in runs]
        order.append(found[0] if found else spare.pop(0) if spare else "")
        spare = found[1:] + spare
    order += spare
    return [list(filter(None, order[k : k + 7])) for k in range(0, len(order), 7)]


def what_differs(overrides: Sequence[str]) -> dict[str, str]:
    """The settings of a command line that say how it is learned, not from what; of a path its last part.

    >>> what_differs(["data=csv", "data.path=logs/day1.csv", "vehicle.mass=20", "estimators.rnn.neurons=20"])
    {'estimators.rnn.neurons': '20'}
    >>> what_differs(["data.plant=otter", "estimators.rnn.start=runs/1", "forecasts.horizons=[1,2]"])
    {'data.plant': 'otter', 'estimators.rnn.start': '1', 'forecasts.horizons': '[1,2]'}
    """
    found = (text.lstrip("+").partition("=") for text in overrides)
    return {
        key: value if value.startswith(("{", "[", "(", '"', "'")) else value.rstrip("/").rpartition("/")[2]
        for key, _, value in found
        if _below(key, NAMED) or not _below(key, BESIDE)
    }


def _below(key: str, heads: Sequence[str]) -> bool:
    """Whether a key is one of some, or below one of them."""
    return any(re.match(rf"~?{re.escape(head)}([./@]|$)", key) for head in heads)


def label(settings: Mapping[str, str]) -> str:
    """Settings as a short text.

    >>> label({"estimators.rnn.neurons": "20", "~combiners.average": ""})
    'rnn.neurons=20 ~combiners.average'
    """
    return " ".join(f"{'.'.join(key.split('.')[-2:])}{'=' * bool(value)}{value}" for key, value in settings.items())


def results_of(results: Mapping[str, Any], name: str) -> dict[str, float]:
    """The results of a job by title, of one estimator or combiner, means over boats; those that are known.

    Args:
        results: of `results.json`.
        name: of the estimator or combiner; the combiner `output` has those that it lacks.

    >>> results_of({"boats": {"heron": {"rnn": {"mae": 0.1, "skill": 0.5}}}, "seconds": 3.0}, "rnn")
    {'MAE (m/s)': 0.1, 'skill': 0.5, 'seconds': 3.0}
    """
    output = str(results.get("output", name)).partition(".")[0]

    def value(title: str, kind: str, horizon: float = 0.0) -> tuple[str, float | None]:
        """The title, with the estimator's name if it is not the one that is asked for, and the value."""
        for one in dict.fromkeys((name, output)):
            if (x := Measure(one, kind, horizon).value(results)) is not None:
                head, space, unit = title.partition(" (")
                return title if one == name else f"{head} of {one}{space}{unit}", x
        return title, None

    networks = [
        list(row.values()) if name not in row else [row[name]] for row in (results.get("network") or {}).values()
    ]
    rates = [x for row in networks if row and (x := _inside(row[0], "rate")) is not None]
    horizons = next((list(next(iter(rows.values()), {})) for rows in (results.get("forecast") or {}).values()), [])
    near = horizons[shown_horizon([float(h) for h in horizons])] if horizons else ""
    found = [
        value("MAE (m/s)", measure.ONE_STEP),
        value("skill", measure.SKILL),
        value("MAE free (m/s)", measure.FREE),
        ("contraction rate", max(rates, default=None)),
        value(f"MAE {near} s ahead (m/s)", measure.FORECAST, float(near or 0)),
        value("coverage of 90 %", measure.COVERAGE),
        ("seconds", _inside(results, "seconds")),
    ]
    return {title: value for title, value in found if value is not None}


def result_tag(title: str) -> str:
    """The tag of a result: its number is the same in all runs, so that they have one column.

    >>> result_tag("skill"), result_tag("MAE 10 s ahead (m/s)")
    ('8 results/2 skill', '8 results/5 MAE 10 s ahead (m/s)')
    """
    return f"8 results/{RESULT_NUMBERS.get(title, AHEAD)} {title}"


def _inside(tree: Any, *path: str) -> float | None:
    """The number at a path in nested mappings; None where there is none."""
    for key in path:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return float(tree) if isinstance(tree, int | float) and math.isfinite(tree) else None


def number(text: Any) -> bool | float | str:
    """A setting as a number where it is one.

    >>> number("0.4"), number(2), number("mean"), number("nan")
    (0.4, 2.0, 'mean', 'nan')
    """
    if isinstance(text, bool):
        return text
    try:
        found = float(text)
    except (TypeError, ValueError):
        return str(text)
    return found if math.isfinite(found) else str(text)
