"""The files that tuning writes into its folder.

tuning.json       everything: method, command, ranges, default and best, every evaluation with its MAE per boat
experiment.yaml   the best setting, ready for configs/experiment
results.json      the objective, and the default, the tuned setting and persistence, in the form of a replay
tensorboard       the best settings side by side; for `learn` the curves
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from usvlearn.core.checkpoint import write_atomically
from usvlearn.display.tensorboard import TensorBoardWriter, folder_name
from usvlearn.display.terminal import Blocks
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.report.tables import tuning_table
from usvlearn.runs.files import TENSORBOARD, TUNING, save_results
from usvlearn.sweeps.tuning.batches import Evaluation

EXPERIMENT = "experiment.yaml"
SHOWN, MOST_RECORDS = 10, 20  # settings in the terminal, and on the HPARAMS page


def gain(mae: float, base: float) -> float | None:
    """The reduction of an error, in percent; None if it is unknown."""
    return 100 * (1 - mae / base) if base > 0 and math.isfinite(base) and math.isfinite(mae) else None


def record(
    facts: Mapping[str, Any], boats: Sequence[str], found: Sequence[Evaluation], persistence: Evaluation
) -> dict[str, Any]:
    """The content of `tuning.json`; an error that is not finite is None.

    Args:
        facts: the request.
        boats: their names.
        found: evaluations, the default first; the best setting may be the default.
        persistence: its evaluation on the same steps.
    """
    default = found[0]

    def row(each: Evaluation) -> dict[str, Any]:
        maes = dict(zip(boats, map(_finite, each.maes), strict=True))
        return {"setting": dict(each.setting), "mae": _finite(each.mae), "boats": maes,
                "gain": gain(each.mae, default.mae)}  # fmt: skip

    best = min(found, key=lambda each: each.mae)
    return {
        **facts,
        "default": row(default),
        "best": row(best),
        PERSISTENCE: {key: value for key, value in row(persistence).items() if key in ("mae", "boats")},
        "diverged": sum(not math.isfinite(each.mae) for each in found),
        "evaluated": [row(each) for each in found],
    }


def write(folder: str | Path, record: Mapping[str, Any], curve: Sequence[Mapping[str, float]] = ()) -> None:
    """Write all files, `results.json` last."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / TUNING, json.dumps(record, indent=2, allow_nan=False).encode())
    write_atomically(folder / EXPERIMENT, experiment(record).encode())
    with TensorBoardWriter(folder / TENSORBOARD) as board:
        for k, numbers in enumerate(curve):
            board.scalars({f"learn/{name}": x for name, x in numbers.items()}, k)
        best = [each for each in ranked(record)[:MOST_RECORDS] if each["mae"] is not None]
        tag = f"MAE of {record['member']} (m/s)"
        if best:
            paths = dict.fromkeys(path for each in best for path in each["setting"])
            values = {path: [each["setting"][path] for each in best if path in each["setting"]] for path in paths}
            board.columns(values, {tag: tag})
        for each in best:
            board.session(each["setting"], run := folder_name(label(each["setting"])))
            board.scalars({tag: each["mae"]}, 0, run)
    boats = {}
    for boat, base in record[PERSISTENCE]["boats"].items():
        maes = {"default": record["default"]["boats"][boat], "tuned": record["best"]["boats"][boat], PERSISTENCE: base}
        boats[boat] = {
            name: {"mae": mae, "skill": None if mae is None or not base else 1 - mae / base}
            for name, mae in maes.items()
        }
    best = record["best"]
    found = {"boats": boats, "seconds": record["seconds"], "objective": best["mae"], "best": label(best["setting"])}
    save_results(folder, found | {"measure": record.get("measure", record["member"])})


def ranked(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All evaluations, the best first."""
    return sorted(record["evaluated"], key=lambda each: math.inf if each["mae"] is None else each["mae"])


def label(setting: Mapping[str, Any]) -> str:
    """A setting as a short text that can name a run."""
    return " ".join(f"{path.rpartition('.')[2]}={_short(value)}" for path, value in setting.items())


def report(record: Mapping[str, Any]) -> Blocks:
    """For the terminal: the best ten, the default, persistence."""
    rows = [(f"{k}", label(each["setting"]), each) for k, each in enumerate(ranked(record)[:SHOWN], 1)]
    rows.append(("default", label(record["default"]["setting"]), record["default"]))
    rows.append((PERSISTENCE, "", record[PERSISTENCE]))
    diverged = f", {record['diverged']} diverged" if record["diverged"] else ""
    title = f"{record['way']}={record['member']}: {record['evaluations']} evaluations{diverged}"
    return tuning_table(title, rows)


def experiment(record: Mapping[str, Any]) -> str:
    """The best setting as a file of configs/experiment."""
    default, best, base = record["default"]["mae"], record["best"], record[PERSISTENCE]["mae"]
    change = "" if best["gain"] is None else f", {best['gain']:.1f} % less"
    head = [
        "# @package _global_",
        f"# Found by: {record['command']}",
        f"# MAE {_error(best['mae'])} m/s, mean over {len(best['boats'])} boats, in {record['evaluations']} evaluations"
        f"; the default has {_error(default)}{change}; persistence {_error(base)}.",
    ]
    tree: dict[str, Any] = {}
    for path, value in best["setting"].items():
        *parents, last = path.split(".")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = value
    return "\n".join([*head, yaml.safe_dump({"estimators": {record["member"]: tree}}, sort_keys=False)])


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else Path(str(value)).stem


def _error(mae: float | None) -> str:
    return "none (diverged)" if mae is None else f"{mae:.5f}"
