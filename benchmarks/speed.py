"""Measures the time of a step, of a grid and of whole jobs, in one run.

python benchmarks/speed.py                       all, ten minutes; wants the extra bench and an idle machine
python benchmarks/speed.py --only steps          one section, printed alone
python benchmarks/speed.py --quick               all, on little data: whether it runs
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import accuracy
import numpy as np
import peers
import torch
from pages import counted, machine, micro, publish, table, three_digits
from reference import compiler, reference

from usvlearn import (
    AID,
    ARX,
    RLS,
    Ensemble,
    Estimator,
    Inputs,
    JointEKF,
    Online,
    Sample,
    SIFtRLS,
    SurgeDynamics,
    SwayEKF,
    YawEKF,
    rollout,
)
from usvlearn.core.samples import Fleet, masks, tree_map
from usvlearn.estimators.axis.layer import AxisEKF
from usvlearn.estimators.planar.state import MEASURED_SWAY, TURN
from usvlearn.evaluation.crossval import cross_validate
from usvlearn.evaluation.metrics import fleet_scores
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.replay import replay
from usvlearn.runs.run_folder import RunFolder
from usvlearn.runs.tensorboard import TensorBoardLogger
from usvlearn.simulate.fleet import fleet as simulated
from usvlearn.simulate.planar_fleet import planar_fleet
from usvlearn.sweeps.tuning.batches import element_errors

Work = Callable[[], Any]
Clock = Callable[[], float]
WAYS = {"C": "C", "streamed": "streamed", "call": "called from Python", "torch": "eager torch"}


class Effort(NamedTuple):
    """How much is measured."""

    repeats: int = 5
    steps: int = 50_000  # streamed through one batch element
    eager: int = 200  # of them through torch
    calls: int = 3000  # from Python
    hours: tuple[float, float] = (3.0, 30.0)  # of a season, and of a short one
    settings: int = 512  # of a grid
    sets: int = 80  # of a cross-validation
    clock: Clock = time.perf_counter  # s


WHOLE = Effort()
QUICK = Effort(2, 1000, 20, 100, (0.2, 0.4), 8, 4)


def once(work: Work, clock: Clock = time.perf_counter) -> float:
    """Seconds of a call."""
    start = clock()
    work()
    return clock() - start


def in_turn(works: Mapping[Any, Work], repeats: int, clock: Clock = time.perf_counter) -> dict[Any, list[float]]:
    """Seconds of every work, once each and all again: a machine that drifts harms their ratios least.

    Before, each is done once unmeasured: it may compile, and fills the caches.
    """
    for work in works.values():
        work()
    rounds = [{name: once(work, clock) for name, work in works.items()} for _ in range(repeats)]
    return {name: [each[name] for each in rounds] for name in works}


def ratio(spent: Sequence[float], reference: Sequence[float]) -> float:
    """Median over the rounds of the one's time over the other's."""
    return statistics.median(a / b for a, b in zip(spent, reference, strict=True))


def estimators() -> dict[str, Estimator]:
    """One of each kind, as the configuration has them, and the default ensemble."""
    ensemble = accuracy.ensemble(())
    more = ("dynamic_rls", "rnn_replay")
    of = accuracy.ensemble([f"+estimator@estimators.{name}={name}" for name in more]).members
    mass = float(of["aid"].model.mass)
    return {
        "persistence": of["persistence"],
        "aid": of["aid"],
        "rls, exponential": RLS(),
        "sift": of["dynamic_rls"].estimator,
        "robust sift": of["dynamic_rls"],
        "arx, p = 27": ARX(),
        "joint, n = 23": of["joint"],
        "rnn, n = 20": of["rnn"],
        "rnn_replay, n = 20": of["rnn_replay"],
        "joint, n = 16": JointEKF(2.74, mass, even=None),
        "yaw, n = 22": YawEKF(2.74),
        "sway, n = 14": SwayEKF(2.74),
        "default ensemble, no forecasts": accuracy.ensemble(("forecasts=null",)),
        "default ensemble": ensemble,
    }


@cache
def samples(steps: int, kind: str = "surge") -> Sample:
    """One boat, what can be learned from, `(steps,)`, again and again: C knows no other."""
    every = surge_samples() if kind == "surge" else axis_samples(kind)
    learned = masks(every).learns
    places = torch.arange(steps) % int(learned.sum())
    return tree_map(lambda x: x[learned][places].contiguous(), every)


def surge_samples() -> Sample:
    """A simulated boat, `(time,)`."""
    (run,) = align_fleet(simulated(n=1, hours=1.0, mission_minutes=60.0)).runs
    return tree_map(lambda x: torch.as_tensor(x[:, 0]), run.samples)


def axis_samples(kind: str, hours: float = 0.25) -> Sample:
    """A simulated boat as the axis EKF of a kind sees it, `(time,)`: what is known of the others is one step old."""
    (run,) = align_fleet(planar_fleet(hours=hours, mission_minutes=60 * hours, current=0.0)).runs
    every, poses = tree_map(lambda x: torch.as_tensor(x[:, 0]), run.samples), torch.as_tensor(run.poses[:, 0])
    measured, other = poses[:, [TURN, MEASURED_SWAY] if kind == "yaw" else [MEASURED_SWAY, TURN]].unbind(-1)
    left, right, *_, dt = every.inputs
    inputs = Inputs(left, right, other.roll(1), every.surge.roll(1), dt)
    return every._replace(inputs=inputs, surge=measured)


def as_numbers(run: Sample) -> list[Sample]:
    """Samples as a program aboard has them."""
    inputs = zip(*(x.tolist() for x in run.inputs), strict=True)
    return [Sample(Inputs(*x), *y) for x, *y in zip(inputs, *(y.tolist() for y in run[1:]), strict=True)]


def streamed(estimator: Estimator, run: Sample, backend: str = "kernel") -> None:
    rollout(estimator, estimator.init(run.surge.shape[1:]), run, backend=backend)


def called(step: Work, calls: Sequence) -> None:
    for each in calls:
        step(each)


@cache
def regression(steps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """What other libraries are handed: regressors, `(steps, 9)`, and increments of the speed, m/s, `(steps,)`."""
    run = samples(steps)
    before = run.surge.roll(1)
    return SurgeDynamics(1.0)(before, run.inputs)[1], run.surge - before


@cache
def pairs(steps: int) -> list[tuple[np.ndarray, float]]:
    """The same, step by step."""
    phi, increments = regression(steps)
    return list(zip(phi.numpy(), increments.tolist(), strict=True))


def one_by_one(make: Callable[[], peers.Peer], given: Sequence[tuple[np.ndarray, float]]) -> None:
    """Another library's predictions, each before its measurement."""
    peer = make()
    for x, y in given:
        peer.predict(x)
        peer.learn(x, y)


def loop(steps: int) -> Work:
    """Plain RLS in numpy over so many steps: what a time is a ratio to that has nothing in C."""
    return partial(one_by_one, peers.plain_rls, pairs(steps))


def costs(estimator: Estimator, effort: Effort, ways: Sequence[str]) -> dict[str, list[float]]:
    """Seconds of a step in each way, round by round."""
    run = samples(effort.steps, estimator.kind if isinstance(estimator, AxisEKF) else "surge")
    short, calls = tree_map(lambda x: x[: effort.eager], run), as_numbers(tree_map(lambda x: x[: effort.calls], run))
    works = {
        "streamed": partial(streamed, estimator, run),
        "call": partial(called, Online(estimator).step, calls),
        "torch": partial(streamed, estimator, short, "torch"),
        "loop": loop(effort.calls),
    }
    if in_c := compiler() and reference(estimator, run):
        works["C"] = in_c
    counts = {"streamed": effort.steps, "C": effort.steps, "call": len(calls), "torch": effort.eager}
    counts["loop"] = effort.calls
    spent = in_turn({way: works[way] for way in ways if way in works}, effort.repeats, effort.clock)
    return {way: [s / counts[way] for s in each] for way, each in spent.items()}


def median(spent: Mapping[str, Sequence[float]], way: str) -> float | None:
    return statistics.median(spent[way]) if way in spent else None


def times(spent: Mapping[str, Sequence[float]], way: str, reference: str) -> str:
    return f"{three_digits(ratio(spent[way], spent[reference]))}×" if reference in spent else ""


def steps(effort: Effort) -> list[str]:
    times = {name: costs(estimator, effort, list(WAYS)) for name, estimator in estimators().items()}
    note = "C is `benchmarks/reference.c`, equal to ours to rounding; called from Python is `Online.step`."
    return [*steps_table(times), "", note]


def steps_table(spent_by: Mapping[str, Mapping[str, Sequence[float]]]) -> list[str]:
    """The times of steps, by estimator and way."""
    rows = [
        [name, *(micro(median(spent, way)) for way in WAYS), times(spent, "streamed", "C"),
         times(spent, "torch", "streamed")]
        for name, spent in spent_by.items()
    ]  # fmt: skip
    return table(["µs a step", *WAYS.values(), "streamed / C", "torch / streamed"], rows)


def costs_of_others(effort: Effort) -> dict[str, list[float]]:
    """Seconds of a step of ours and of other libraries, p = 9, on the same regressors and increments, by round."""
    run = samples(effort.steps)
    model = SurgeDynamics(1.0)
    phi = regression(effort.steps)[0]
    calls = as_numbers(tree_map(lambda x: x[: effort.calls], run))
    rls, sift = RLS(model), SIFtRLS(model)
    works: dict[str, Work] = {
        "ours, RLS": partial(called, Online(rls).step, calls),
        "ours, SIFt-RLS": partial(called, Online(sift).step, calls),
        "ours, RLS, streamed": partial(streamed, rls, run),
        "ours, SIFt-RLS, streamed": partial(streamed, sift, run),
    }
    counts = dict(zip(works, [len(calls)] * 2 + [effort.steps] * 2, strict=True))
    for name, make in peers.peers(phi.T @ phi / len(phi)).items():
        works[name], counts[name] = partial(one_by_one, make, pairs(effort.calls)), len(calls)
    spent = in_turn(works, effort.repeats, effort.clock)
    return {name: [s / counts[name] for s in each] for name, each in spent.items()}


def others(effort: Effort) -> list[str]:
    spent = costs_of_others(effort)
    rows = [
        [
            name,
            micro(median(spent, name)),
            times(spent, name, "ours, SIFt-RLS"),
            times(spent, name, "ours, RLS, streamed"),
        ]
        for name in spent
    ]
    note = (
        "A prediction, then a measurement, p = 9, from Python unless streamed. Others are handed the regressor; ours "
        "make it, and keep the limits and the noise's variance."
    )
    return [*table(["", "µs a step", "over our SIFt-RLS, called", "over our RLS, streamed"], rows), "", note]


MASS, MISSION = 28.0, 15.0  # kg, minutes
MANY = 50_000_000  # element-steps of a job that is measured once
SETTINGS = {"estimators": {}, "combiners": {}, "align": {}, "data": {}}


@cache
def season(boats: int, hours: float) -> Fleet:
    return align_fleet(simulated(n=boats, hours=hours, mission_minutes=MISSION))


def replayed(ensemble: Ensemble, fleet: Fleet) -> None:
    for _ in replay(ensemble, fleet, ensemble.init((len(fleet.boats),))):
        pass


def grid_of(kind: str, settings: int) -> Estimator:
    """So many settings of one hyperparameter, as batch elements."""
    values = torch.logspace(-1, 1, settings, dtype=torch.float64)[:, None]
    return AID(MASS, values) if kind == "aid" else SIFtRLS(SurgeDynamics(MASS), 10 * values)


def jobs(effort: Effort) -> list[str]:
    """From aligned samples in memory to the end."""
    short, long = effort.hours
    ensemble = accuracy.ensemble(())
    rows = []

    def row(title: str, work, element_steps: int) -> None:
        repeats = 1 if element_steps > MANY else 3
        spent = statistics.median(once(work) for _ in range(repeats))
        rows.append([title, f"{element_steps:,}", f"{spent:.2f}", micro(spent / element_steps)])

    replayed(ensemble, season(1, short))  # compiled by now
    one = season(1, long)
    for boats in (1, 8):
        fleet = season(boats, long)
        title = f"{long:g} h of the default ensemble, {counted(boats, 'boat')}"
        row(title, partial(replayed, ensemble, fleet), fleet.steps * boats)
    for kind in ("aid", "sift"):
        estimator = grid_of(kind, effort.settings)
        element_errors(estimator, season(1, short), (effort.settings,))
        title = f"{effort.settings} settings of one {kind} × {long:g} h"
        row(title, partial(element_errors, estimator, one, (effort.settings,)), effort.settings * one.steps)
    runs = [tree_map(lambda x, n=run.lengths[0]: x[:n, 0], run.samples) for run in one.runs]
    cross_validate(ensemble, ensemble.init((1,)), runs[:1])
    title = f"cross-validation, {effort.sets} sets × {long:g} h"
    work = partial(cross_validate, ensemble, ensemble.init((effort.sets,)), runs)
    row(title, work, effort.sets * one.steps)
    note = f"Medians of 3, of jobs beyond {MANY // 1_000_000} million element-steps once. One thread."
    return [*table(["job", "element-steps", "s", "µs an element-step"], rows), "", note]


def around(effort: Effort) -> list[str]:
    """What a replay is surrounded by, as a share of it."""
    hours = min(1.0, effort.hours[1])
    return [logging(season(1, hours), effort), logging(season(8, hours), effort)]


def logging(fleet: Fleet, effort: Effort) -> str:
    """Time in TensorBoard, checkpoints and predictions over time in the replay itself, within one run."""
    model, shares, seconds = accuracy.ensemble(()), [], []
    for _ in range(effort.repeats):
        with (
            tempfile.TemporaryDirectory() as folder,
            TensorBoardLogger(folder, fleet, model) as watch,
            RunFolder(folder, fleet, model, {}) as archive,
        ):
            start = archive.begin(model.init((len(fleet.boats),)), None)
            began, spent = time.perf_counter(), 0.0
            for chunk in replay(model, fleet, start.state, every=watch.every):
                spent += once(partial(archive.save, chunk)) + once(partial(watch.show, chunk))
            boats = fleet_scores(fleet, archive.published, model.names)
            results = {"boats": boats, "events": {boat: [] for boat in fleet.boats}}
            spent += once(partial(watch.finish, SETTINGS, results, archive.published))
            seconds.append(spent)
            shares.append(spent / (time.perf_counter() - began - spent))
    boats = counted(len(fleet.boats), "boat")
    return (
        f"- {boats}, {fleet.steps} steps: logging and saving take {statistics.median(seconds):.2f} s, "
        f"{statistics.median(shares):.0%} of the replay of the default ensemble"
    )


SECTIONS: dict[str, tuple[str, Callable[[Effort], list[str]]]] = {
    "steps": ("A step", steps),
    "others": ("Other libraries", others),
    "jobs": ("Whole jobs", jobs),
    "around": ("Around a replay", around),
}


def page(effort: Effort, names: list[str]) -> str:
    """The page, as Markdown."""
    text = [
        "# Speed of steps and jobs",
        "",
        "Measured by `python benchmarks/speed.py` in one run: float64, one thread where not said otherwise, medians of",
        f"{effort.repeats} rounds in which all works of a row are timed in turn.",
        "",
        f"{machine()}.",
        "",
    ]
    for name in names:
        title, measure = SECTIONS[name]
        print(f"{title} …", flush=True)
        text += [f"## {title}", "", *measure(effort), ""]
    return "\n".join(text)


@torch.no_grad()
def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", choices=SECTIONS, help="one section, printed alone")
    asked.add_argument("--quick", action="store_true", help="on little data")
    given = asked.parse_args()
    torch.set_num_threads(1)
    text = page(QUICK if given.quick else WHOLE, [given.only] if given.only else list(SECTIONS))
    if given.only is None and not given.quick:
        publish(__file__, text)
    else:
        print(text)


if __name__ == "__main__":
    main()
