"""What each piece of the default ensemble pays: switched off in turn, on all boats.

python benchmarks/ablation.py LOGS        writes docs/benchmarks/ablation.md

LOGS is a folder with blueboat, vtec, dalian and pearl.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from accuracy import REAL, Log, configuration, measured, recorded, replayed, simulated
from omegaconf import OmegaConf
from pages import publish

E, RULE = "estimators", "combiners.ensemble"
JOINT = ("joint", "joint_quick", "joint_averaged")
OTHERS = (
    "dynamic_rls",
    "steady_rls",
    "memory_aid",
    "memory_rls",
    "ambient_rls",
    "acceleration",
)  # of configs/estimator


def weighing(names: Sequence[str]) -> str:
    return f"{RULE}.members=[{','.join(names)}]"


def pieces() -> Mapping[str, list[str]]:
    """Overrides of the configuration, by what they switch off or add."""
    default = configuration(())
    weighed = list(default.combiners.ensemble.members)
    joint = {
        "no fore-aft asymmetry terms": "even=null",
        "no cubic thrust": "cubic=1e-3",
        "no lag of the commands": "lag=1e-3",
        "no current": "current=1e-3",
        "no limit for outliers": "outlier=null",
    }
    return {
        **{f"without {name}": [weighing([each for each in weighed if each != name])] for name in weighed},
        **{f"and {name}": [weighing([*weighed, name])] for name in default.estimators if name not in weighed},
        **{f"and {name}": [f"+estimator@{E}.{name}={name}", weighing([*weighed, name])] for name in OTHERS},
        "and a slow joint EKF": [
            f"+estimator@{E}.slow=joint", f"{E}.slow.disturbance=0.05", f"{E}.slow.drift_time=3000",
            weighing([*weighed, "slow"]),
        ],
        "joint: disturbance of 5": [f"{E}.joint.disturbance=5"],
        "joint: parameters that change within an hour": [f"{E}.joint.drift_time=3000"],
        **{f"joint EKFs: {label}": [f"{E}.{name}.{setting}" for name in JOINT] for label, setting in joint.items()},
        "ARX: no even features": [f"{E}.arx.even=false"],
        "ARX: Gaussian noise": [f"{E}.arx.degrees=null"],
        "ARX: weights that change more slowly": [f"{E}.arx.walk=1e-4"],
        "BOA that never forgets": [f"{RULE}.memory=null"],
        "BOA, memory of 30 s": [f"{RULE}.memory=30"],
        "BOA, square loss": [f"{RULE}.loss=square"],
        "BOA, no shared weight": [f"{RULE}.share=0.0"],
        "exponential weights": ["combiner@combiners.ensemble=exponential"],
        "the paper's RLS weights": ["combiner@combiners.ensemble=weighted", weighing(weighed)],
        "the mean": ["combiner@combiners.ensemble=average", weighing(weighed)],
    }  # fmt: skip


def settings(given: tuple[str, ...], overrides: Sequence[str]) -> dict:
    """The configuration."""
    return OmegaConf.to_container(configuration((*given, *overrides)), resolve=True)


def error(log: Log, overrides: Sequence[str]) -> float:
    names, predictions, _ = replayed(log.overrides, tuple(overrides))
    predicted, surge = predictions[:, log.element, names.index("ensemble")], measured(log)
    scored = np.isfinite(surge) & np.isfinite(predicted)
    return float(np.abs(predicted - surge)[scored].mean())


def table(logs: Sequence[Log]) -> Iterator[str]:
    yield "| | " + " | ".join(log.name for log in logs) + " | mean |"
    yield "|---|" + "---:|" * (len(logs) + 1)
    base = np.array([error(log, ()) for log in logs])
    yield "| **default**, m/s | " + " | ".join(f"{e:.4f}" for e in base) + " | |"
    for label, overrides in pieces().items():
        ratios = np.array([error(log, overrides) for log in logs]) / base
        yield f"| {label} | " + " | ".join(f"{r:.3f}" for r in ratios) + f" | {ratios.mean():.3f} |"
        print(label, np.round(ratios, 3), flush=True)


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    logs = [*(recorded(folder, name) for name in REAL), *simulated()]
    text = [
        "# Ablation of the ensemble",
        "",
        "Measured by `python benchmarks/ablation.py LOGS`: MAE of the ensemble with one piece switched off or added,",
        "over that of the default, whole logs, one step ahead. Above 1, the piece as it is by default pays.",
        "[Accuracy of forecasts by horizon](forecast.md) has the members of forecasts.",
        "",
        *table(logs),
        "",
    ]
    publish(__file__, text)


if __name__ == "__main__":
    main()
