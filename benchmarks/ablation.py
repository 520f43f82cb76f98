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
ROBUST = ("dynamic_rls", "steady_rls", "memory_aid", "memory_rls", "ambient_rls.estimator")
SIFT = ("sift_map", "dynamic_rls.estimator", "steady_rls.estimator.estimator", "memory_rls.estimator.estimator",
        "ambient_rls.estimator.estimator.estimator")  # fmt: skip


def exponential(place: str) -> list[str]:
    """SIFt-RLS there becomes RLS with exponential forgetting of the paper's memory."""
    at = f"{E}.{place}"
    return [f"{at}._target_=usvlearn.RLS", f"~{at}.memory", f"~{at}.floor", f"+{at}.forgetting=0.995"]


def pieces(members: Sequence[str]) -> Mapping[str, list[str]]:
    """Overrides of the configuration, by what they switch off or add."""
    priors = configuration(()).combiners.ensemble.prior
    without = {
        f"without {name}": [f"~{E}.{name}", *(f"~{RULE}.prior.{p}" for p in priors if f"{p}_".startswith(f"{name}_"))]
        for name in members
    }
    return {
        **without,
        "and constant acceleration": [f"+estimator@{E}.acceleration=acceleration"],
        "and AID at gains 0.3 and 3": [
            f"+estimator@{E}.{name}=aid" for name in ("slow_aid", "fast_aid")
        ] + [f"{E}.slow_aid.gain=0.3", f"{E}.fast_aid.gain=3"],
        "and dynamic RLS with memories of 30 and 1000 s": [
            f"+estimator@{E}.{name}=dynamic_rls" for name in ("middle_rls", "long_rls")
        ] + [f"{E}.middle_rls.estimator.memory=30", f"{E}.long_rls.estimator.memory=1000"],
        "exponential forgetting for SIFt": [o for place in SIFT for o in exponential(place)],
        "no robustness": [f"{E}.{place}.threshold=1e9" for place in ROBUST],
        "Huber's threshold, 1.345": [f"{E}.{place}.threshold=1.345" for place in ROBUST],
        "patience of 2, inflation of 20": [
            f"{E}.{place}.{setting}" for place in ROBUST for setting in ("patience=2", "inflation=20")
        ],
        "no inflation at an escape": [f"{E}.{place}.inflation=1.0" for place in ROBUST],
        "no signs of the drag": [f"{E}.steady_rls.estimator.signs=[0,0,0,0,0,0,0,0,0]"],
        "AID: no leakage": [f"{E}.aid.sigma=0.0", f"{E}.memory_aid.estimator.estimator.sigma=0.0"],
        "AID: equal spreads": [f"{E}.{place}.spread=EQUAL" for place in ("aid", "memory_aid.estimator.estimator")],
        "RNN: random start": [f"{E}.rnn.initial=random"],
        "RNN: no projection": [f"{E}.rnn.stability=none"],
        "RNN: no clipping": [f"{E}.rnn.clip=null"],
        "BOA that never forgets": [f"{RULE}.memory=null"],
        "BOA, square loss": [f"{RULE}.loss=square"],
        "BOA, equal priors": [f"{RULE}.prior=null"],
        "BOA, no shared weight": [f"{RULE}.share=0.0"],
        "exponential weights": [
            f"{RULE}._target_=usvlearn.ExponentialWeights", f"+{RULE}.rate=20.0", f"~{RULE}.scale", f"~{RULE}.share",
        ],
        "the paper's RLS weights": [
            f"{RULE}._target_=usvlearn.RecursiveWeights",
            *(f"~{RULE}.{key}" for key in ("memory", "loss", "scale", "share", "prior")),
        ],
        "the mean": [
            f"{RULE}._target_=usvlearn.Average",
            *(f"~{RULE}.{key}" for key in ("memory", "loss", "scale", "share", "prior")),
        ],
    }  # fmt: skip


def settings(given: tuple[str, ...], overrides: Sequence[str]) -> dict:
    """The configuration; EQUAL stands for the mass for each parameter."""
    cfg = OmegaConf.to_container(configuration((*given, *overrides)), resolve=True)
    text = json.dumps(cfg["estimators"])
    for names in (9, 12):  # of the dynamics, and with memory
        text = text.replace('"spread": "EQUAL"', f'"spread": {[cfg["vehicle"]["mass"]] * names}', 1)
    return {**cfg, "estimators": json.loads(text)}


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
    found = [columns(given, name, json.dumps(node)) for name, node in cfg["estimators"].items()]
    rule = instantiate(cfg["combiners"]["ensemble"], _convert_="all")
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
    for label, overrides in pieces(list(configuration(logs[0].overrides).estimators)).items():
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
