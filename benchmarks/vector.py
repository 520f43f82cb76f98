"""A network of surge, sway and yaw rate that contracts: its open-loop simulations beside models of each axis alone.

python benchmarks/vector.py [VTEC_LOGS] [--quick]        writes docs/benchmarks/vector.md

Every network learns online, sample by sample; SEEDS initial networks are elements of one batch. A row's learning rate
is the best of RATES by open-loop simulations on tuning runs, which are neither those that were learned nor those that
are reported. The page tells the rest.
"""

from __future__ import annotations

import argparse
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from pages import publish
from torch import Tensor

from certify.networks.vector import RELU, VectorWeights, check
from certify.proofs import vector_exact
from certify.search.vector_scaling import best_diagonal
from usvlearn import VectorRNN, VectorSample
from usvlearn.core.samples import tree_map
from usvlearn.simulate.planar import planar_runs

DT, SEEDS, RATES, KAPPA = 0.2, 5, (4e-4, 1e-3, 2.5e-3), 0.999
AXES = ("surge, m/s", "sway, m/s", "yaw rate, rad/s")
ROWS = {
    "network, none": {"stability": "none"},
    "network, exact": {},
    "network, exact, T = 1": {"scaling": None},
    "network, gershgorin": {"condition": "gershgorin", "scaling": None},
}
VTEC_INPUTS = {
    "command_left": {"name": "*left_thruster", "span": 36.5, "delay": 0.2},  # as in configs/data/vtec.yaml
    "command_right": {"name": "*right_thruster", "span": 36.5, "delay": 0.2},
    "heading": {"name": "*ins_pose", "field": "theta", "unit": "rad"},
}
VTEC_COMPONENTS = {
    name: {"name": "*local_vel", "field": field} for name, field in (("surge", "x"), ("sway", "y"), ("yaw_rate", "z"))
}


class Boat(NamedTuple):
    """Runs of one boat; leaves of samples are `(time, runs)`; shorter runs are padded with stale samples."""

    name: str
    maxima: tuple[float, ...]  # by which the components are divided
    importance: tuple[float, ...]  # about 1/σ of a linear fit; better than ones on the tuning runs
    passes: int  # over the runs that are learned
    learned: VectorSample
    tuning: VectorSample
    reported: VectorSample
    truth: Tensor  # (time, runs, 3) of the reported runs: without noise, or the measured velocity itself


def tensors(samples: VectorSample) -> VectorSample:
    return tree_map(lambda x: torch.from_numpy(np.ascontiguousarray(x)), samples)


def simulated(quick: bool) -> Boat:
    minutes, length, count = (1.0, 0.5, 2) if quick else (30.0, 5.0, 6)
    learned, _ = planar_runs(0, minutes, 1, DT)
    tuning, _ = planar_runs(1, length, count, DT)
    reported, truth = planar_runs(2, length, count, DT)
    runs = [tensors(each) for each in (learned, tuning, reported)]
    return Boat("a simulated Heron", (2.75, 0.25, 0.75), (10.0, 1.0, 10.0), 1, *runs, torch.from_numpy(truth))


def recorded(path: Path, quick: bool) -> Boat:
    """The runs of every day in turn: learned, tuning, learned, reported, reported."""
    from usvlearn.logs.formats.ros.rosbag import Rosbag
    from usvlearn.logs.velocities import read_velocities

    runs = read_velocities(path, Rosbag(), VTEC_INPUTS, VTEC_COMPONENTS, dt=DT)
    parts = [[run.samples for k, run in enumerate(runs) if k % 5 in turn] for turn in ((0, 2), (1,), (3, 4))]
    tuning, reported = (padded(part) for part in parts[1:])
    one = tensors(tree_map(lambda *x: np.concatenate(x)[:, None], *parts[0]))  # one after the other
    top = one.velocity.nan_to_num(0.0).abs().amax((0, 1)).tolist()
    maxima = tuple(float(f"{each:.2g}") for each in top)
    truth = torch.where(reported.measured, reported.velocity, torch.nan)
    return Boat("VTec", maxima, (5.8, 1.0, 1.7), 1 if quick else 10, one, tuning, reported, truth)


def padded(runs: list[VectorSample]) -> VectorSample:
    longest = max(len(run.fresh) for run in runs)

    def fill(*leaves: np.ndarray) -> np.ndarray:
        whole = np.zeros((longest, len(leaves), *leaves[0].shape[1:]), leaves[0].dtype)
        for k, leaf in enumerate(leaves):
            whole[: len(leaf), k] = leaf
        return whole

    found = tree_map(fill, *runs)
    beyond = np.arange(longest)[:, None] >= np.array([len(run.fresh) for run in runs])
    velocity = np.where(beyond[..., None], np.nan, found.velocity)
    dt = np.where(beyond, 1.0, found.inputs.dt)  # no start
    return tensors(found._replace(velocity=velocity, inputs=found.inputs._replace(dt=dt)))


class Errors(NamedTuple):
    """Of all batch elements, `(*elements, 3)`: mean absolute and root mean square, m/s, m/s, rad/s."""

    mae: Tensor
    rmse: Tensor


def errors(predicted: Tensor, truth: Tensor) -> Errors:
    """Of predictions `(time, *elements, runs, 3)`; a run that diverged counts with its error at 1000."""
    e = (predicted - truth.reshape(len(truth), *(1,) * (predicted.ndim - 3), *truth.shape[1:])).clamp(-1e3, 1e3)
    there = e.isfinite()
    e, count = torch.where(there, e, 0.0), there.sum((0, -2))
    return Errors(e.abs().sum((0, -2)) / count, (e.square().sum((0, -2)) / count).sqrt())


def learn(maxima: tuple[float, ...], samples: VectorSample, passes: int, options: dict, seeds: int):
    """A module, and the networks of all rates and seeds that learn the samples, a batch of `(rates, seeds, runs)`."""
    rates = [[[each]] for each in RATES]
    options = {"contraction_rate": KAPPA, "rate": rates} | options
    modules = [VectorRNN(maxima, seed=k, **options).requires_grad_(False) for k in range(seeds)]
    runs = samples.fresh.shape[1]
    state = tree_map(lambda *x: torch.cat(x, 1), *(each.init((len(RATES), 1, runs)) for each in modules))
    for _ in range(passes):
        state, _ = modules[0].rollout(state, of_elements(samples, (len(RATES), seeds)))
    return modules[0], state


def of_elements(samples: VectorSample, elements: tuple[int, ...]) -> VectorSample:
    """Leaves `(time, *elements, …)`."""
    return tree_map(
        lambda x: x[(slice(None), *(None,) * len(elements))].expand(len(x), *elements, *x.shape[1:]), samples
    )


def run(module: VectorRNN, state, samples: VectorSample, free: bool) -> Tensor:
    """Open-loop simulations, or predictions one step ahead from the measured velocities; batch elements of the state,
    then those of samples.

    Args:
        state: leaves `(rates, seeds, k, …)`.
        samples: leaves `(time, k, runs, …)`.
    """
    elements, runs = tuple(state.updates.shape), samples.fresh.shape[2]
    state = tree_map(lambda x: x.unsqueeze(3).expand(*elements, runs, *x.shape[3:]), state)
    whole = of_elements(samples, elements[:2])
    if free:
        return module.rollout(state, whole, learn=False)[1]
    found = []
    for k in range(len(samples.fresh)):
        sample = tree_map(lambda x, k=k: x[k], whole)
        _, predicted = module.rollout(state, tree_map(lambda x: x[None], sample), learn=False)
        found.append(predicted[0])
        known = sample.measured | (sample.inputs.dt == 0)[..., None]
        state = module.start(state, torch.where(known & sample.velocity.isfinite(), sample.velocity, state.velocity))
    return torch.stack(found)


def joint(boat: Boat, options: dict, seeds: int) -> tuple[Errors, Tensor, Any, int]:
    """A network of all components: open-loop errors and MAE one step ahead of each seed at the best rate, `(seeds, 3)`.

    And the state of these seeds, leaves `(seeds, …)`, and the place of the rate.
    """
    module, state = learn(boat.maxima, boat.learned, boat.passes, options, seeds)

    def predicted(samples: VectorSample, free: bool) -> Tensor:
        return run(module, state, tree_map(lambda x: x[:, None], samples), free)[:, :, :, 0]

    tuned = errors(predicted(boat.tuning, True), measured(boat.tuning)).mae / module.maxima
    best = int(tuned.mean((-1, -2)).nan_to_num(torch.inf).argmin())
    free, one = errors(predicted(boat.reported, True), boat.truth), errors(predicted(boat.reported, False), boat.truth)
    chosen = tree_map(lambda x: x[best, :, 0], state)
    return Errors(free.mae[best], free.rmse[best]), one.mae[best], chosen, best


def separate(boat: Boat, options: dict, seeds: int) -> tuple[Errors, Tensor, Any, list[int]]:
    """Three networks, each of one component, as `joint`; their states have leaves `(seeds, 3, …)`."""
    scale = torch.tensor(boat.maxima, dtype=torch.float64)

    def apart(samples: VectorSample) -> VectorSample:  # leaves (time, 3, runs, …), one component each
        inputs = tree_map(lambda x: x[:, None].expand(-1, 3, -1), samples.inputs)
        velocity, seen = (x.movedim(-1, 1)[..., None] for x in (samples.velocity / scale, samples.measured))
        return VectorSample(inputs, velocity, samples.fresh[:, None].expand(-1, 3, -1), seen)

    only = tree_map(lambda x: x[:, :, 0], apart(boat.learned))  # one run
    module, state = learn((1.0,), only, boat.passes, options, seeds)

    def predicted(samples: VectorSample, free: bool) -> Tensor:
        return run(module, state, apart(samples), free)[..., 0].movedim(-2, -1) * scale

    tuned = errors(predicted(boat.tuning, True), measured(boat.tuning)).mae.mean(1)  # (rates, 3)
    best = tuned.nan_to_num(torch.inf).argmin(0)
    free, one = errors(predicted(boat.reported, True), boat.truth), errors(predicted(boat.reported, False), boat.truth)
    at = [each[best, :, torch.arange(3)].T for each in (free.mae, free.rmse, one.mae)]
    chosen = tree_map(lambda x: x[best, :, torch.arange(3)].transpose(0, 1), state)
    return Errors(*at[:2]), at[2], chosen, best.tolist()


def measured(samples: VectorSample) -> Tensor:
    return torch.where(samples.measured, samples.velocity, torch.nan)


def networks_of(state) -> list[VectorWeights]:
    """Of all batch elements."""
    elements = np.ndindex(*state.updates.shape)
    return [check(VectorWeights(*(w[element].numpy() for w in state.weights))) for element in elements]


def largest_rate(state, scaling) -> Fraction:
    """The largest exact rate of all batch elements, in the norm of `scaling`."""
    T = None if scaling is None else vector_exact.matrix(np.diag(scaling))
    return max(vector_exact.rate(each, vector_exact.everywhere(each, RELU), scaling=T) for each in networks_of(state))


def features(x: Tensor, u: Tensor, kind: str) -> Tensor:
    """Regressors of a least-squares fit of the next x, `(…, features)`."""
    parts = [x, u, torch.ones_like(u[..., :1])]
    if kind == "products":
        pairs = torch.stack([x[..., i] * x[..., j] for i in range(3) for j in range(i, 3)], -1)
        parts += [pairs, x * x.abs(), u * u.abs(), x[..., :1].abs() * x[..., 1:]]
    return torch.cat(parts, -1)


def least_squares(boat: Boat, kind: str) -> tuple[Errors, Tensor]:
    """Batch fits of the runs that the networks learned: "axis", "joint" or "products"."""
    scale = torch.tensor(boat.maxima, dtype=torch.float64)

    def parts(samples: VectorSample) -> tuple[Tensor, Tensor]:
        return samples.velocity / scale, torch.stack(samples.inputs[:2], -1)

    x, u = parts(boat.learned)
    steps = boat.learned.fresh & (boat.learned.inputs.dt > 0) & boat.learned.measured.all(-1)
    departs = boat.learned.measured.all(-1) | (boat.learned.inputs.dt == 0)
    use = (steps[1:] & departs[:-1])[:, 0]
    before, target, command = x[:-1, 0][use], x[1:, 0][use], u[1:, 0][use]
    axes = [[0], [1], [2]] if kind == "axis" else [[0, 1, 2]]
    fits = [
        torch.linalg.lstsq(features(before[:, a], command, kind), target[:, a], driver="gelsd").solution for a in axes
    ]

    def step(x: Tensor, u: Tensor) -> Tensor:
        pairs = zip(axes, fits, strict=True)
        return torch.cat([features(x[..., a], u, kind) @ fit for a, fit in pairs], -1).clamp(-1e3, 1e3)

    return simulated_by(boat, step)


def simulated_by(boat: Boat, step) -> tuple[Errors, Tensor]:
    """Open-loop errors and MAE one step ahead of a map of x and u on the reported runs, `(3,)` each."""
    scale = torch.tensor(boat.maxima, dtype=torch.float64)
    samples = boat.reported
    u, found = torch.stack(samples.inputs[:2], -1), {}
    for free in (True, False):
        x, predictions = torch.zeros_like(samples.velocity[0]), []
        for k in range(len(u)):
            moves = (samples.fresh[k] & (samples.inputs.dt[k] > 0))[:, None]
            predicted = torch.where(moves, step(x, u[k]), torch.nan)
            predictions.append(predicted * scale)
            known = samples.velocity[k].isfinite() & ((samples.inputs.dt[k] == 0)[:, None] | (not free))
            x = torch.where(known, samples.velocity[k] / scale, torch.where(moves, predicted, x))
        found[free] = errors(torch.stack(predictions), boat.truth)
    return found[True], found[False].mae


def line(name: str, rate: str, free: Errors, one: Tensor, K: str) -> str:
    """A row; several seeds are their mean ± sample standard deviation."""

    def cell(values: Tensor) -> list[str]:
        if values.ndim == 1:
            return [f"{x:.4f}" for x in values.tolist()]
        return [f"{x:.4f} ± {s:.4f}" for x, s in zip(values.mean(0).tolist(), values.std(0).tolist(), strict=True)]

    return "| " + " | ".join([name, rate, *cell(free.mae), *cell(free.rmse), *cell(one), K]) + " |"


def above(rate: Fraction) -> str:
    """Rounded up, so that the bound remains true."""
    return f"≤ {-(-rate.numerator * 10000 // rate.denominator) / 10000:.4f}"


def study(boat: Boat, seeds: int) -> list[str]:
    heads = [f"{axis.partition(',')[0]}" for axis in AXES]
    columns = [f"{kind} {head}" for kind in ("MAE", "RMSE", "one step") for head in heads]
    lines = [
        f"## {boat.name[0].upper()}{boat.name[1:]}", "",
        f"{int(boat.learned.fresh.sum())} steps learned, {boat.passes} times; {int(boat.tuning.fresh.sum())} for "
        f"tuning; {int(boat.reported.fresh.sum())} reported, in {boat.reported.fresh.shape[1]} runs. "
        f"`maxima` are {', '.join(f'{x:g}' for x in boat.maxima)}; `importance` is "
        f"{', '.join(f'{x:g}' for x in boat.importance)}.", "",
        "| model | rate | " + " | ".join(columns) + " | K |", "|---|" + "---:|" * (len(columns) + 2),
    ]  # fmt: skip
    scaling: list[float] | None = None
    for name, options in ROWS.items():
        norm = None if name == "network, none" else options.get("scaling", scaling)
        free, one, chosen, best = joint(boat, {**options, "scaling": norm, "importance": boat.importance}, seeds)
        if name == "network, none":  # T of `exact`: where the networks of all seeds contract fastest, in the mean
            found = np.log([best_diagonal(each) for each in networks_of(chosen)]).mean(0)
            norm = scaling = [float(f"{x:.2g}") for x in np.exp(found - found.max())]
        note = above(largest_rate(chosen, norm))
        if options.get("condition") == "gershgorin":
            held = [vector_exact.gershgorin(each)[1] for each in networks_of(chosen)]
            note += f"; lemma {above(max(each or Fraction(9) for each in held))}"
        lines.append(line(name, f"{RATES[best]:g}", free, one, note))
        print(lines[-1], flush=True)
    free, one, chosen, bests = separate(boat, {}, seeds)
    rates = ", ".join(f"{RATES[each]:g}" for each in bests)
    lines.append(line("three networks, exact", rates, free, one, above(largest_rate(chosen, None))))
    print(lines[-1], flush=True)
    for name, kind in (("least squares, each axis", "axis"), ("least squares, joint", "joint"),
                       ("least squares, products", "products")):  # fmt: skip
        lines.append(line(name, "", *least_squares(boat, kind), ""))
    lines.append(line("persistence", "", *simulated_by(boat, lambda x, u: x), ""))
    print("\n".join(lines[-4:]), flush=True)
    return [*lines, "", f"T = diag({', '.join(f'{x:g}' for x in scaling or [])}).", ""]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("logs", nargs="?", type=Path)
    parser.add_argument("--quick", action="store_true", help="short runs and two seeds; prints, and writes nothing")
    given = parser.parse_args()
    torch.set_num_threads(1)
    boats = [simulated(given.quick)] + ([recorded(given.logs, given.quick)] if given.logs else [])
    tables = [each for boat in boats for each in study(boat, 2 if given.quick else SEEDS)]
    if not given.quick:
        publish(__file__, page(tables))


TEXT = f"""\
# A network of surge, sway and yaw rate that contracts

Every network learns online, sample by sample, from {SEEDS} initial states of its neurons. A row's learning rate is the
best of {", ".join(f"{rate:g}" for rate in RATES)} by open-loop simulations on tuning runs. Those are neither the runs
that were learned nor the reported ones. A step is {DT:g} s.

| model | |
|---|---|
| network, none | `VectorRNN` without a constraint |
| network, exact | projected after every update onto K ≤ {KAPPA:g} in the norm ‖T x‖_∞; x are the divided components |
| network, exact, T = 1 | the same in the norm ‖x‖_∞ |
| network, gershgorin | projected onto the paper's lemma for a vector state at the rate {KAPPA:g} |
| three networks, exact | one for each component, which knows this component and the commands |
| least squares, each axis | one linear fit for each component, likewise; in one batch, of the learned runs |
| least squares, joint | a linear fit of all components |
| least squares, products | the same with products and squares of velocities and commands |
| persistence | the velocity stays as it was at the start |

T is chosen before, from the networks without a constraint: `best_diagonal` of each seed, and their geometric mean.
`importance` of the components in the loss is about 1/σ of the residual of a linear fit to the learned runs. It was
better than equal weights on the tuning runs; on VTec equal weights had been reported before it was tried.

An open-loop simulation takes the velocity at its start, and then the commands alone. Errors are in m/s, m/s and rad/s,
over all steps of the reported runs. Networks have the mean ± the sample standard deviation over the seeds. Errors of
simulated runs are relative to the true velocity, those of recorded runs to the measured one. Of VTec's runs, in the
order of their names, the first and third of every five are learned, the second is for tuning, and the other two are
reported.

K is the largest exact rate in fractions of the networks of all seeds after the last sample, rounded up. It is in the
norm onto which is projected, for `none` in that of T, for the lemma and the three networks with T = 1. `lemma` is the
smallest rate at which the lemma holds.
"""


def page(tables: list[str]) -> list[str]:
    return [*TEXT.splitlines(), "", *tables]


if __name__ == "__main__":
    main()
