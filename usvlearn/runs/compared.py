"""How runs are compared in TensorBoard: their data, the settings in which they differ, their results by title."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.core.samples import Fleet, Run
from usvlearn.display.terminal import ResultTable
from usvlearn.evaluation import objective
from usvlearn.evaluation.objective import Measure

# settings that do not say how it is learned, with all below them, and those below them that are named
BESIDE = ("data", "vehicle", "hydra", "sweep", "save_minutes", "threads", "resume", "log", "objective")
NAMED = ("data.plant", "data.seed")
RESULT_NUMBERS = {  # of tags; AHEAD: of the MAE over a horizon
    "MAE (m/s)": 1, "skill": 2, "MAE free (m/s)": 3, "contraction rate": 4, "coverage of 90 %": 6, "seconds": 7,
}  # fmt: skip
MAE, WINDOW = "MAE, next step (m/s)", 750  # a tag; steps over which its errors are averaged
AHEAD, NEAR = 5, 10.0  # s: the horizon of the results, or else the longest below


def what_differs(overrides: Sequence[str]) -> dict[str, str]:
    """The settings of a command line that say how it is learned, not from what; of a path its last part."""
    parts = (text.lstrip("+").partition("=") for text in overrides)
    return {
        key: value if value.startswith(("{", "[", "(", '"', "'")) else value.rstrip("/").rpartition("/")[2]
        for key, _, value in parts
        if _below(key, NAMED) or not _below(key, BESIDE)
    }


def _below(key: str, heads: Sequence[str]) -> bool:
    """Whether a key is one of some, or below one of them."""
    return any(re.match(rf"~?{re.escape(head)}([./@]|$)", key) for head in heads)


def label(settings: Mapping[str, str]) -> str:
    """Settings as a short text."""
    return " ".join(f"{'.'.join(key.split('.')[-2:])}{'=' * bool(value)}{value}" for key, value in settings.items())


def results_of(results: Mapping[str, Any], name: str) -> dict[str, float]:
    """The results of a job (`results.json`) by title, of one estimator or combiner, means over boats; those known.

    The combiner `output` has those that it lacks.
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
    near = max((h for h in horizons if float(h) <= NEAR), key=float, default="")
    titled = [
        value("MAE (m/s)", objective.ONE_STEP),
        value("skill", objective.SKILL),
        value("MAE free (m/s)", objective.FREE),
        ("contraction rate", max(rates, default=None)),
        value(f"MAE {near} s ahead (m/s)", objective.FORECAST, float(near or 0)),
        value("coverage of 90 %", objective.COVERAGE),
        ("seconds", _inside(results, "seconds")),
    ]
    return {title: value for title, value in titled if value is not None}


def result_tag(title: str) -> str:
    """The tag of a result: its number is the same in all runs, so that they have one column."""
    return f"8 results/{RESULT_NUMBERS.get(title, AHEAD)} {title}"


def _inside(tree: Any, *path: str) -> float | None:
    """The number at a path in nested mappings; None where there is none."""
    for key in path:
        tree = tree.get(key) if isinstance(tree, Mapping) else None
    return float(tree) if isinstance(tree, int | float) and math.isfinite(tree) else None


def number(text: Any) -> bool | float | str:
    """A setting as a number where it is one."""
    if isinstance(text, bool):
        return text
    try:
        value = float(text)
    except (TypeError, ValueError):
        return str(text)
    return value if math.isfinite(value) else str(text)


def data_text(fleet: Fleet, clocks: np.ndarray) -> str:
    """What the logs contain, and what was rejected, as Markdown; `clocks` are the run times of the boats, s."""
    counts, rows = np.sum([_count(run) for run in fleet.runs], axis=0), []
    for element, boat in enumerate(fleet.boats):
        steps, *shares = counts[element].tolist()
        runs = sum(run.lengths[element] > 0 for run in fleet.runs)
        rows.append((boat, runs, f"{clocks[element] / 3600:.2f}", steps, *(f"{x / steps:.1%}" for x in shares)))
    rejected = [
        (boat, channel, ", ".join(f"{cause} {n}" for cause, n in causes.items()))
        for boat, channels in fleet.rejected.items()
        for channel, causes in channels.items()
    ]
    columns = "boat", "runs", "hours", "steps", "measured speed", "stale inputs"
    tables = ResultTable("data", columns, rows), ResultTable("", ("boat", "channel", "rejected, by cause"), rejected)
    return "\n\n".join(each.markdown() for each in tables)


def _count(run: Run) -> np.ndarray:
    """Steps, those with a measured speed and those with stale inputs, `(boats, 3)`."""
    inside = np.arange(len(run.time))[:, None] < np.array(run.lengths)
    return np.stack([inside.sum(0), (inside & run.samples.measured).sum(0), (inside & ~run.samples.fresh).sum(0)], -1)
