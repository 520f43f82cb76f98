"""Forecasts seconds ahead: skill and coverage by horizon, of recorded and simulated boats.

Writes `docs/benchmarks/forecast.md`.

python benchmarks/forecast.py LOGS        a folder with blueboat, vtec, dalian; five minutes

What was chosen (the members that are weighed, the overlap) was chosen on the first halves of the recorded runs and on
simulated boats of seeds 5 and 11. The second halves and seed 77 are reported.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from accuracy import Log, ensemble, first_half, fleet_of, measured, recorded
from pages import publish
from truths import NOMINAL, PLANTS

from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.estimators.ensemble.forecasts.state import HORIZONS
from usvlearn.evaluation.horizons import groups_of

REAL, SEED, HOURS = ("blueboat", "vtec", "dalian"), 77, 3
FEW = 8  # forecasts, below which no skill is stated,
MANY = 100  # and no coverage of a group
AIMS = {
    "blueboat": (None, None, 0.74, 0.84, 0.87, 0.89),
    "vtec": (None, None, 0.49, 0.77, 0.85, None),
    "dalian": (None, None, 0.28, 0.17, 0.15, 0.25),
    "simulated": (None, None, 0.74, 0.84, 0.89, 0.90),
}


@cache
def replayed(given: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Forecasts `(time, boats, horizons, columns)` and half-widths `(time, boats, horizons)`, m/s."""
    fleet, model = fleet_of(tuple(key for key in given if "conditional" not in key)), ensemble(given)
    leaves, found = ["forecasts.predictions", "forecasts.halfwidths"], []
    for _, kept in chunked_rollout(model, model.init((len(fleet.boats),)), [run.samples for run in fleet.runs], leaves):
        found.append([kept[name] for name in leaves])
    made, widths = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return made, widths


def by_horizon(log: Log, more: tuple[str, ...] = (), part: np.ndarray | None = None) -> np.ndarray:
    """Skill of the ensemble, coverage of its intervals, and number of forecasts, `(3, horizons)`, NaN where few."""
    made, widths = (x[:, log.element] for x in replayed((*log.overrides, *more)))
    surge = measured(log)
    found = np.full((3, made.shape[1]), np.nan)
    for j in range(made.shape[1]):
        due = np.isfinite(made[:, j, -1]) & np.isfinite(surge) & (True if part is None else part)
        found[2, j] = due.sum()
        if due.sum() < FEW:
            continue
        own, held = (np.abs(made[due, j, k] - surge[due]) for k in (-1, -2))
        known = np.isfinite(widths[due, j])
        found[0, j] = 1 - own.mean() / held.mean()
        found[1, j] = (own[known] <= widths[due, j][known]).mean() if known.any() else np.nan
    return found


def simulated(seed: int = SEED) -> list[Log]:
    """Three boats of each of five plants."""
    logs = []
    for plant in PLANTS:
        mass, top = NOMINAL[plant]
        given = (f"data.plant={plant}", "data.n=3", f"data.hours={HOURS}", f"data.seed={seed}", f"vehicle.mass={mass}",
                 f"vehicle.surge_max={top}")  # fmt: skip
        fleet = fleet_of(given)
        logs += [Log(boat, fleet, element, given) for element, boat in enumerate(fleet.boats)]
    return logs


def cells(values: Sequence[float], digits: int = 3) -> str:
    return " | ".join("–" if not np.isfinite(x) else f"{x:.{digits}f}" for x in values)


def head(first: str) -> Iterator[str]:
    yield f"| {first} | " + " | ".join(f"{h:g} s" for h in HORIZONS) + " |"
    yield "|---|" + "---:|" * len(HORIZONS)


def aim(name: str) -> str:
    return " | ".join("" if x is None else f"{x:.2f}" for x in AIMS[name])


def reported(real: Sequence[Log], boats: Sequence[Log]) -> Iterator[str]:
    yield from head("skill")
    for log in real:
        yield f"| {log.name}, second half | {cells(by_horizon(log, (), ~first_half(log))[0])} |"
        yield f"| aim | {aim(log.name)} |"
        yield f"| {log.name}, first half | {cells(by_horizon(log, (), first_half(log))[0])} |"
    every = np.stack([by_horizon(log) for log in boats])
    yield f"| {len(boats)} simulated boats, mean | {cells(every[:, 0].mean(0))} |"
    yield f"| aim | {aim('simulated')} |"
    yield f"| the least of them | {cells(every[:, 0].min(0))} |"
    yield ""
    yield from head("share of the speeds within the intervals of 90 %")
    for log in real:
        yield f"| {log.name}, second half | {cells(by_horizon(log, (), ~first_half(log))[1], 2)} |"
    yield f"| simulated boats, mean | {cells(every[:, 1].mean(0), 2)} |"
    yield f"| simulated boats, least | {cells(every[:, 1].min(0), 2)} |"
    yield f"| simulated boats, greatest | {cells(every[:, 1].max(0), 2)} |"
    yield ""
    yield from head("forecasts")
    for log in real:
        yield f"| {log.name}, second half | {cells(by_horizon(log, (), ~first_half(log))[2], 0)} |"
    yield f"| a simulated boat, median | {cells(np.median(every[:, 2], 0), 0)} |"


def manoeuvres(real: Sequence[Log], boats: Sequence[Log]) -> Iterator[str]:
    """The section on coverage by group, and on the interval score beside that of `conditional=false`."""
    yield "## Intervals by how far the commands move"
    yield ""
    yield "Share inside where the commands stay / move / move much: the range of the mean command within the horizon is"
    yield "below .05, at most .25, or more. *Score* is the interval score over that of intervals that do not know the"
    yield f"manoeuvre. Whole logs; – : fewer than {MANY} forecasts. Settings were chosen on boats of seed 9301 and on"
    yield "the recorded boats; seed 77 is reported."
    yield ""
    yield from head("share inside")
    found = {label: [by_manoeuvre(log) for log in logs] for label, logs in _groups(real, boats).items()}
    for label, each in found.items():
        shares = np.stack([x[:3] for x in each])
        for what, reduce in (("", np.nanmean), (", least", np.nanmin), (", greatest", np.nanmax))[
            : 3 if len(each) > 1 else 1
        ]:
            rows = reduce(shares, 0)
            yield (
                f"| {label}{what} | "
                + " | ".join(" / ".join(_share(x) for x in rows[:, k]) for k in range(len(HORIZONS)))
                + " |"
            )
    yield ""
    yield from head("score")
    for label, each in found.items():
        scores = np.stack([x[3] for x in each])
        yield f"| {label} | {cells(np.nanmean(scores, 0))} |"
        if len(each) > 1:
            yield f"| {label}, worst | {cells(np.nanmax(scores, 0))} |"


def _groups(real: Sequence[Log], boats: Sequence[Log]) -> dict[str, Sequence[Log]]:
    return {log.name: [log] for log in real} | {f"{len(boats)} simulated boats": boats}


def _share(x: float) -> str:
    return f"{x:.2f}" if np.isfinite(x) else "–"


def by_manoeuvre(log: Log) -> np.ndarray:
    """Coverage of the three groups, and the ratio of the interval scores, `(4, horizons)`; NaN where few."""
    (made, widths), (_, before) = replayed(log.overrides), replayed((*log.overrides, "conditional=false"))
    surge, found = measured(log), np.full((4, len(HORIZONS)), np.nan)
    groups = np.concatenate([groups_of(run.samples, HORIZONS)[:, log.element] for run in log.fleet.runs])
    for j in range(len(HORIZONS)):
        e, own, other = (
            np.abs(made[:, log.element, j, -1] - surge),
            widths[:, log.element, j],
            before[:, log.element, j],
        )
        due = np.isfinite(e) & np.isfinite(own) & np.isfinite(other)
        for group in range(3):
            if (here := due & (groups[:, j] == group)).sum() >= MANY:
                found[group, j] = (e <= own)[here].mean()
        if due.sum() >= FEW:
            score, was = ((2 * w + 20 * np.maximum(e - w, 0))[due].mean() for w in (own, other))
            found[3, j] = score / was
    return found


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    real, boats = [recorded(folder, name) for name in REAL], simulated()
    publish(__file__, [
        "# Accuracy of forecasts by horizon",
        "",
        "Measured by `python benchmarks/forecast.py LOGS`: the default configuration, learned online. Each forecast",
        "is made before anything after its origin is seen, and is told only the commands, headings and yaw rates that",
        "came. Skill is 1 − MAE/MAE(persistence from the same origins).",
        f"Simulated: five plants, 3 boats each, {HOURS} h, seed {SEED}. – : fewer than {FEW} forecasts.",
        "",
        *reported(real, boats),
        "",
        *manoeuvres(real, boats),
        "",
    ])  # fmt: skip


if __name__ == "__main__":
    main()
