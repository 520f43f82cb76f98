"""Tracks beside a constant turn, a held yaw rate and a batch fit: distance from the boat's position, and ellipses.

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

import numpy as np
import torch
from accuracy import configuration, ensemble, fleet_of
from pages import publish
from scipy.optimize import least_squares
from timing import machine, table

from usvlearn.cli.settings import planar_of
from usvlearn.core.jit import jit
from usvlearn.core.rows import COS, DT, LEFT, RIGHT, ROW, SIN, YAW_RATE
from usvlearn.core.samples import Fleet, masks
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.planar_runs import planar_stretches, with_poses
from usvlearn.engine.rollouts import stretches
from usvlearn.estimators.axis import kernel as axis
from usvlearn.estimators.axis.layer import SwayEKF, YawEKF
from usvlearn.estimators.joint import kernel as joint
from usvlearn.estimators.joint.layer import JointEKF
from usvlearn.estimators.planar.state import CONSTANT, ERROR, GROUP, HEADING_ERROR, HELD_RATE, HORIZONS, RADIUS, RHO

REAL, SEEDS, BOATS, HOURS = ("blueboat", "vtec", "dalian"), (8001, 8002, 8003, 8004), 6, 2
TARGETS = {
    "blueboat": (0.13, 0.48, 1.3), "vtec": (0.15, 0.44, 1.1), "dalian": (0.09, 0.25, 0.83),
    "simulated": (0.10, 0.30, 0.80),
}  # fmt: skip
MANY, ORIGINS = 30, 2  # ellipses of a group, below which no share is stated; steps between two origins of the batch fit
WINDOW, SCALES = 38, (0.05, 0.05, 0.03)  # steps of a window of the batch fit; m/s, m/s, rad/s of its residuals
SIZES = (19, 12, 20)  # parameters of surge, sway and yaw rate that the batch fit has


class Boat:
    """What became due of a fleet, and which steps are reported."""

    def __init__(self, name: str, overrides: Sequence[str], halves: bool):
        self.name, self.overrides = name, tuple(overrides)
        self.fleet: Fleet = fleet_of(self.overrides)
        cfg, model = configuration(self.overrides), ensemble(self.overrides)
        self.planar, why = planar_of(cfg, model)
        if self.planar is None:
            raise SystemExit(why)
        parts, boats = [with_poses(run.samples, run.poses) for run in self.fleet.runs], len(self.fleet.boats)
        began = time.perf_counter()
        with torch.no_grad():
            found = [kept["track.due"] for _, kept in self.followed(parts, boats)]
        self.seconds = time.perf_counter() - began
        lengths = [len(part) for part in found]
        first = sum(lengths[: len(lengths) // 2]) if len(lengths) > 1 else lengths[0] // 2
        self.due = np.concatenate(found)
        self.reported = np.arange(len(self.due)) >= (first if halves else 0)
        self.first = first

    def followed(self, parts, boats: int) -> Iterator:
        return planar_stretches(self.planar, self.planar.init((boats,)), parts, ["track.due"])

    def rows(self, k: int) -> np.ndarray:
        """What became due over a horizon in the reported steps, `(count, columns)`."""
        rows = self.due[self.reported, :, k].reshape(-1, self.due.shape[-1])
        return rows[np.isfinite(rows[:, ERROR])]


def mean(values: np.ndarray, digits: int = 2) -> str:
    return f"{values.mean():.{digits}f}" if len(values) else "–"


def errors(boats: Sequence[Boat], batch: dict[str, list[float]]) -> list[str]:
    rows = []
    for boat in boats:
        due = [boat.rows(k) for k in range(len(HORIZONS))]
        rows.append([f"**{boat.name}**", *(f"**{mean(x[:, ERROR], 3 if k < 2 else 2)}**" for k, x in enumerate(due))])
        if boat.name in TARGETS:
            rows.append(["target, at 2, 5 and 10 s", *(f"{x:.2f}" for x in TARGETS[boat.name]), ""])
        rows.append(["constant turn and speed", *(mean(x[:, CONSTANT], 3 if k < 2 else 2) for k, x in enumerate(due))])
        rows.append(["forecast speed, held yaw rate", *(mean(x[:, HELD_RATE]) for x in due)])
        if boat.name in batch:
            found = (f"{x:.2f}" if np.isfinite(x) else "–" for x in batch[boat.name])
            rows.append(["batch output error, of the first half", *found])
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


@jit
def simulated(theta, u, v, r, psi, commands, h, row, g, found):
    """The velocities and the way of a boat from a measured state: (2) of `estimators.planar.state`, one model an axis.

    `commands` is (steps, 4), each with those before; `found` is (steps, 6): u, v, r, heading, north, east.
    """
    north = east = 0.0
    a, b = theta[:23], theta[23:37]
    c = theta[37:]
    for k in range(len(commands)):
        left, right, left0, right0 = commands[k]
        row[LEFT], row[RIGHT], row[COS], row[DT] = left, right, 0.0, h[k]
        row[SIN], row[YAW_RATE] = v, u
        ahead = min(max(axis.flow(True, c, r, 0.0, left0, right0, row, g), -20.0), 20.0)
        row[SIN] = r
        aside = min(max(axis.flow(False, b, v, 0.0, left0, right0, row, g), -20.0), 20.0)
        row[YAW_RATE] = (r + ahead) / 2
        along = min(max(joint.flow(True, a, u, 0.0, left0, right0, row, g), -20.0), 20.0)
        turned = psi + h[k] * (r + ahead) / 2
        c0, s0, c1, s1 = np.cos(psi), np.sin(psi), np.cos(turned), np.sin(turned)
        north += h[k] / 2 * (c0 * u - s0 * v + c1 * along - s1 * aside)
        east += h[k] / 2 * (s0 * u + c0 * v + s1 * along + c1 * aside)
        u, v, r, psi = along, aside, ahead, turned
        found[k, 0], found[k, 1], found[k, 2], found[k, 3], found[k, 4], found[k, 5] = u, v, r, psi, north, east


def batch_errors(boat: Boat) -> list[float]:
    """The mean distance of tracks of a model that was fitted to all of the first half at once, in the second."""
    top = float(configuration(boat.overrides).vehicle.surge_max)
    filters = JointEKF(surge_max=top), SwayEKF(surge_max=top), YawEKF(surge_max=top)
    sizes = (4, 2, 2)  # of the states before the parameters
    prior = np.concatenate([np.concatenate([np.zeros(n), arrays_of(x.init())["mean"][n:]])
                            for n, x in zip(sizes, filters, strict=True)])  # fmt: skip
    spread = np.concatenate([np.concatenate([np.zeros(n), np.sqrt(x.variance.detach().numpy())])
                             for n, x in zip(sizes, filters, strict=True)])  # fmt: skip
    free = spread > 0
    parts = [series(run) for run in boat.fleet.runs]
    begin, learns, judged = 0, [], []
    for part in parts:
        mine = boat.first - begin
        learns += [(part, k) for k in range(0, min(mine, len(part["h"])) - WINDOW, WINDOW // 2)]
        judged += [(part, k) for k in range(max(mine, 0), len(part["h"]) - 1, ORIGINS)]
        begin += len(part["h"]) + 1
    row, g = np.zeros(ROW), np.zeros(64)

    def track(theta, part, k, steps):
        steps = min(steps, len(part["h"]) - k)
        found, (u, v, r, psi) = np.empty((steps, 6)), part["state"][k]
        simulated(theta, u, v if np.isfinite(v) else 0.0, r, psi, part["commands"][k : k + steps],
                  part["h"][k : k + steps], row, g, found)  # fmt: skip
        return found

    def residuals(x):
        theta, rest = prior.copy(), []
        theta[free] += spread[free] * x
        for part, k in learns:
            if not (part["whole"][k : k + WINDOW].all() and np.isfinite(part["state"][k][[0, 2, 3]]).all()):
                continue
            found, measured = track(theta, part, k, WINDOW), part["state"][k + 1 : k + 1 + WINDOW, :3]
            rest.append(np.nan_to_num((found[:, :3] - measured) / SCALES).ravel())
        return np.concatenate([x, *rest])

    fitted = least_squares(residuals, np.zeros(int(free.sum())), loss="soft_l1", max_nfev=25)
    theta, errors = prior.copy(), [np.zeros(0).tolist() for _ in HORIZONS]
    theta[free] += spread[free] * fitted.x
    for part, k in judged:
        if not np.isfinite(part["state"][k][[0, 2, 3]]).all() or not np.isfinite(part["position"][k]).all():
            continue
        found, elapsed = track(theta, part, k, 80), 0.0
        for j in range(len(found)):
            if not part["whole"][k + j]:
                break
            half, elapsed = part["h"][k + j] / 2, elapsed + part["h"][k + j]
            for i, horizon in enumerate(HORIZONS):
                if elapsed - half < horizon <= elapsed + half:
                    away = found[j, 4:] - (part["position"][k + j + 1] - part["position"][k])
                    errors[i].append(np.hypot(*away))
    return [float(np.nanmean(x)) if x else np.nan for x in errors]


def series(run) -> dict[str, np.ndarray]:
    """A run of one boat: what is measured after each step, and the commands of the steps between."""
    s, pose = run.samples, run.poses[:, 0]
    u = np.where(s.measured[:, 0], s.surge[:, 0], np.nan)
    commands = np.column_stack([s.inputs.command_left[:, 0], s.inputs.command_right[:, 0]])
    before = np.concatenate([commands[:1], commands[:-1]])
    return {
        "state": np.column_stack([u, pose[:, 2], pose[:, 1], pose[:, 0]]),
        "position": pose[:, 3:],
        "commands": np.ascontiguousarray(np.concatenate([commands, before], 1)[1:]),
        "h": np.ascontiguousarray(s.inputs.dt[1:, 0]),
        "whole": masks(s).steps[1:, 0],
    }


def cost(boat: Boat) -> list[str]:
    """Time of a step with and without tracks, in turn, the least of five."""
    parts, boats = [with_poses(run.samples, run.poses) for run in boat.fleet.runs], len(boat.fleet.boats)
    samples, best = [each.sample for each in parts], [np.inf, np.inf]
    for _ in range(5):
        for k in range(2):
            began = time.perf_counter()
            with torch.no_grad():
                if k == 0:
                    model = boat.planar.surge
                    list(stretches(model, model.init((boats,)), samples, ["predictions"]))
                else:
                    list(boat.followed(parts, boats))
            best[k] = min(best[k], time.perf_counter() - began)
    steps = sum(len(part.heading) for part in parts) * boats
    return [
        f"A step of the surge's ensemble takes {1e6 * best[0] / steps:.1f} µs, one of all axes with their tracks "
        f"{1e6 * best[1] / steps:.1f} µs: {best[1] / best[0]:.2f} times as long (target: 2.5)."
    ]


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    real = [Boat(name, (f"data={name}", f"data.path={folder / name}"), True) for name in REAL]
    batch = {boat.name: batch_errors(boat) for boat in real}
    made = [Boat("simulated", ("data=planar", f"data.n={BOATS}", f"data.hours={HOURS}", f"data.seed={seed}"), False)
            for seed in SEEDS]  # fmt: skip
    simulated_boats = made[0]
    simulated_boats.due = np.concatenate([each.due for each in made], 1)
    every = [*real, simulated_boats]
    publish(
        __file__,
        [
            "# Tracks: where the boat will be",
            "",
            machine(),
            "",
            "Position error of tracks that are given the commands that came, by horizon. Second halves of the recorded",
            f"boats; {BOATS * len(SEEDS)} simulated boats of {HOURS} h from the first step on. Horizons are whole",
            "numbers of steps of 0.4 s, so that 5.2 s stands for the target at 5 s. VTec logs no position that follows",
            "its velocity: its way is the integral of the measured surge and sway.",
            "",
            *errors(every, batch),
            "",
            "## Ellipses of 90 %",
            "",
            "Share of the positions inside, over all moments and by how far the commands moved since the origin.",
            "",
            *coverage(every),
            "",
            "## Cost",
            "",
            *cost(simulated_boats),
        ],
    )


if __name__ == "__main__":
    main()
