"""What each piece of the default ensemble pays: switched off in turn, on all boats.

python benchmarks/ablation.py LOGS        a folder with blueboat, vtec, dalian, pearl; writes ablation.md
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from accuracy import REAL, Log, configuration, fleet_of, measured, publish, recorded, simulated
from hydra.utils import instantiate
from omegaconf import OmegaConf

from usvlearn import Ensemble
from usvlearn.runs.replay import replay
from usvlearn.signals import masks, tree_map, where

E, RULE = "estimators", "combiners.ensemble"
JOINT = ("joint", "joint_quick", "reader")
OTHERS = (
    "dynamic_rls",
    "steady_rls",
    "memory_aid",
    "memory_rls",
    "ambient_rls",
    "acceleration",
)  # of configs/estimator
KEYS = ("memory", "loss", "scale", "share", "prior")  # of BOA


def weighing(names: Sequence[str]) -> str:
    return f"{RULE}.members=[{','.join(names)}]"


def rule(name: str, *more: str) -> list[str]:
    """Another rule in place of BOA."""
    return [f"{RULE}._target_=usvlearn.{name}", *(f"~{RULE}.{key}" for key in KEYS), *more]


def pieces() -> Mapping[str, list[str]]:
    """Overrides of the configuration, by what they switch off or add."""
    default = configuration(())
    weighed = list(default.combiners.ensemble.members)
    joint = {
        "no even terms": "even=null",
        "no cubic thrust": "cubic=1e-3",
        "no lag of the commands": "lag=1e-3",
        "no current": "current=1e-3",
        "no limit for outliers": "outlier=null",
    }
    return {
        **{f"without {name}": [weighing([each for each in weighed if each != name])] for name in weighed},
        **{f"and {name}": [weighing([*weighed, name])] for name in default.estimators if name not in weighed},
        **{f"and {name}": [f"+estimator@{E}.{name}={name}", weighing([*weighed, name])] for name in OTHERS},
        "and a slow joint filter": [
            f"+estimator@{E}.slow=joint", f"{E}.slow.disturbance=0.05", f"{E}.slow.drift_time=3000",
            weighing([*weighed, "slow"]),
        ],
        "joint: disturbance of 5": [f"{E}.joint.disturbance=5"],
        "joint: parameters that change within an hour": [f"{E}.joint.drift_time=3000"],
        **{f"joint filters: {label}": [f"{E}.{name}.{setting}" for name in JOINT] for label, setting in joint.items()},
        "ARX: no even features": [f"{E}.arx.estimator.even=false"],
        "ARX: Gaussian noise": [f"{E}.arx.estimator.degrees=null"],
        "ARX: no robustness": [f"{E}.arx.threshold=1e9"],
        "BOA that never forgets": [f"{RULE}.memory=null"],
        "BOA, memory of 30 s": [f"{RULE}.memory=30"],
        "BOA, square loss": [f"{RULE}.loss=square"],
        "BOA, no shared weight": [f"{RULE}.share=0.0"],
        "exponential weights": rule("ExponentialWeights"),
        "the paper's RLS weights": rule("RecursiveWeights"),
        "the mean": rule("Average"),
    }  # fmt: skip


def settings(given: tuple[str, ...], overrides: Sequence[str]) -> dict:
    """The configuration."""
    return OmegaConf.to_container(configuration((*given, *overrides)), resolve=True)


@cache
def columns(given: tuple[str, ...], name: str, settings: str) -> tuple[tuple[str, ...], np.ndarray]:
    """What one member predicts, m/s, `(time, boats, its columns)`: members do not know of each other."""
    member = instantiate(json.loads(settings))
    alone, fleet = Ensemble({name: member}), fleet_of(given)
    chunks = replay(alone, fleet, alone.init((len(fleet.boats),)))
    return alone.columns, np.concatenate([c.predictions for c in chunks])[..., : len(alone.columns)]


@torch.no_grad()
def combined(given: tuple[str, ...], overrides: Sequence[str]) -> np.ndarray:
    """The ensemble's predictions, m/s, `(time, boats)`."""
    cfg = settings(given, overrides)
    rule = instantiate(cfg["combiners"]["ensemble"], _convert_="all")
    found = [columns(given, name, json.dumps(cfg["estimators"][name])) for name in rule.members]
    rule.bind([name for names, _ in found for name in names])
    predictions = torch.from_numpy(np.concatenate([array for _, array in found], -1))
    awake = torch.where(predictions.abs() <= 10.0, predictions, torch.nan)
    samples = [tree_map(torch.as_tensor, run.samples) for run in fleet_of(given).runs]
    surge, dt = (torch.cat(x) for x in zip(*((s.surge, s.inputs.dt) for s in samples), strict=True))
    learns = torch.cat([masks(s).learns for s in samples])
    state, out = rule.init(surge.shape[1:], surge), []
    for k in range(len(surge)):
        out.append(rule.combine(state, awake[k]))
        if learns[k].any():
            new = rule.learn(state, awake[k], torch.where(learns[k], surge[k], 0.0), dt[k])
            state = tree_map(lambda a, b, m=learns[k]: where(m, a, b), new, state)
    return torch.stack(out).numpy()


def error(log: Log, overrides: Sequence[str]) -> float:
    predicted, surge = combined(log.overrides, tuple(overrides))[:, log.lane], measured(log)
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
        "# Ablation",
        "",
        "Measured by `python benchmarks/ablation.py LOGS`: MAE of the ensemble with one piece switched off or added,",
        "over that of the default, whole logs, one step ahead. Above 1, the piece as it is by default pays.",
        "",
        *table(logs),
        "",
    ]
    publish(__file__, text)


if __name__ == "__main__":
    main()
