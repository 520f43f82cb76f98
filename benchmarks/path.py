"""Errors of tracks beside those of a constant turn and a held yaw rate, and coverage of their ellipses.

Writes `docs/benchmarks/path.md`.

python benchmarks/path.py LOGS        a folder with blueboat, vtec, dalian; five minutes

The members of the ensembles of sway and yaw rate, and their settings, were chosen on the first halves of the recorded
boats; the second halves are reported. Simulated boats are those of seeds 8001 to 8004, on which nothing was chosen.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from accuracy import configuration, ensemble, fleet_of
from pages import machine, publish, table

from usvlearn.composition.configuration import planar_of
from usvlearn.core.samples import Fleet
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.estimators.planar.layer import Planar
from usvlearn.estimators.planar.state import CONSTANT, ERROR, GROUP, HEADING_ERROR, HELD_RATE, HORIZONS, RADIUS, RHO

REAL, SEEDS, BOATS, HOURS = ("blueboat", "vtec", "dalian"), (8001, 8002, 8003, 8004), 6, 2
TARGETS = {
    "blueboat": (0.13, 0.48, 1.3), "vtec": (0.15, 0.44, 1.1), "dalian": (0.09, 0.25, 0.83),
    "simulated": (0.10, 0.30, 0.80),
}  # fmt: skip
MANY = 30  # ellipses of a group, below which no share is stated
OPENING = f"""\
Position error of tracks that are given the commands that came, by horizon. Second halves of the recorded
boats; {BOATS * len(SEEDS)} simulated boats of {HOURS} h from the first step on. Horizons are whole
numbers of steps of 0.4 s, so that 5.2 s stands for the target at 5 s. VTec logs no position that follows
its velocity: its way is the integral of the measured surge and sway."""
ELLIPSES = "Share of the positions inside, over all moments and by how far the commands moved since the origin."


class Boat(NamedTuple):
    """What became due of a fleet in the steps that are reported."""

    name: str
    due: np.ndarray  # (time, boats, horizons, columns)

    def rows(self, k: int) -> np.ndarray:
        """What became due over a horizon, `(count, columns)`."""
        rows = self.due[:, :, k].reshape(-1, self.due.shape[-1])
        return rows[np.isfinite(rows[:, ERROR])]


def planar(overrides: tuple[str, ...]) -> Planar:
    model, why = planar_of(configuration(overrides), ensemble(overrides))
    if model is None:
        raise SystemExit(why)
    return model


def followed(model: Planar, fleet: Fleet) -> Iterator[np.ndarray]:
    """What became due in each run."""
    parts = [run.planar for run in fleet.runs]
    with torch.no_grad():
        for _, recorded in chunked_rollout(model, model.init((len(fleet.boats),)), parts, ["track.due"]):
            yield recorded["track.due"]


def boat(name: str, overrides: tuple[str, ...], halves: bool) -> Boat:
    """The whole of a fleet, or the second half of its runs or of its only run."""
    due = list(followed(planar(overrides), fleet_of(overrides)))
    lengths = [len(part) for part in due]
    first = sum(lengths[: len(lengths) // 2]) if len(lengths) > 1 else lengths[0] // 2
    return Boat(name, np.concatenate(due)[first if halves else 0 :])


def mean(values: np.ndarray, digits: int = 2) -> str:
    return f"{values.mean():.{digits}f}" if len(values) else "–"


def errors(boats: Sequence[Boat]) -> list[str]:
    rows = []
    for boat in boats:
        due = [boat.rows(k) for k in range(len(HORIZONS))]
        rows.append([f"**{boat.name}**", *(f"**{mean(x[:, ERROR], 3 if k < 2 else 2)}**" for k, x in enumerate(due))])
        if boat.name in TARGETS:
            rows.append(["target, at 2, 5 and 10 s", *(f"{x:.2f}" for x in TARGETS[boat.name]), ""])
        rows.append(["constant turn and speed", *(mean(x[:, CONSTANT], 3 if k < 2 else 2) for k, x in enumerate(due))])
        rows.append(["forecast speed, held yaw rate", *(mean(x[:, HELD_RATE]) for x in due)])
        rows.append(["heading error, °", *(mean(np.degrees(x[:, HEADING_ERROR]), 1) for x in due)])
        rows.append(["tracks", *(str(len(x)) for x in due)])
    return table(["mean distance, m", *(f"{h:g} s" for h in HORIZONS)], rows)


def coverage(boats: Sequence[Boat]) -> list[str]:
    rows = []
    for boat in boats:
        for k, horizon in enumerate(HORIZONS):
            due = boat.rows(k)
            due = due[np.isfinite(due[:, RADIUS])]
            inside = due[:, RHO] <= due[:, RADIUS]
            groups = [inside[due[:, GROUP] == j] for j in range(3)]
            cells = [f"{x.mean():.0%}" if len(x) >= MANY else "–" for x in (inside, *groups)]
            rows.append([boat.name, f"{horizon:g} s", *cells, mean(due[:, RADIUS]), mean(due[:, ERROR])])
    return table(["boat", "horizon", "all", "stay", "move", "move much", "mean radius, m", "mean error, m"], rows)


def cost(overrides: tuple[str, ...]) -> list[str]:
    """Time of a step with and without tracks, in turn, the least of five."""
    model, fleet = planar(overrides), fleet_of(overrides)
    samples, boats, best = [run.samples for run in fleet.runs], len(fleet.boats), [np.inf, np.inf]
    for _ in range(5):
        for k in range(2):
            began = time.perf_counter()
            with torch.no_grad():
                list(followed(model, fleet) if k else
                     chunked_rollout(model.surge, model.surge.init((boats,)), samples, ["predictions"]))  # fmt: skip
            best[k] = min(best[k], time.perf_counter() - began)
    steps = sum(len(run.time) for run in fleet.runs) * boats
    return [
        f"A step of the surge's ensemble takes {1e6 * best[0] / steps:.1f} µs, one of all axes with their tracks "
        f"{1e6 * best[1] / steps:.1f} µs: {best[1] / best[0]:.2f} times as long (target: 2.5)."
    ]


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    real = [boat(name, (f"data={name}", f"data.path={folder / name}"), True) for name in REAL]
    seasons = [("data=planar", f"data.n={BOATS}", f"data.hours={HOURS}", f"data.seed={seed}") for seed in SEEDS]
    due = np.concatenate([boat("simulated", season, False).due for season in seasons], 1)
    every = [*real, Boat("simulated", due)]
    sections = ["# Tracks: where the boat will be", "", machine(), "", OPENING, "", *errors(every), ""]
    sections += ["## Ellipses of 90 %", "", ELLIPSES, "", *coverage(every), "", "## Cost", "", *cost(seasons[0])]
    publish(__file__, sections)


if __name__ == "__main__":
    main()
