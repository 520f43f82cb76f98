"""Ratios of speed, accuracy, stress and certificates beside those of earlier runs, for use before a release.

python benchmarks/overview.py                    ten minutes; wants an idle machine with a C compiler
python benchmarks/overview.py --logs LOGS        also recorded boats; LOGS: a folder with blueboat, vtec, dalian
python benchmarks/overview.py --check            exits with 1 if a figure has become worse
python benchmarks/overview.py --only speed       one section; --check works with it, too
python benchmarks/overview.py --quick            all, on little data: whether it runs

A whole run appends its figures to docs/benchmarks/history.csv. With --only or --quick nothing is written, unless
--folder names a place. `benchmarks/history.py` states when a figure is worse.
"""

import argparse
import math
import platform
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from time import process_time
from typing import NamedTuple

import accuracy
import history
import numpy as np
import stress
import torch
from families import initial_networks, random_networks
from history import Comparison, Entry, Figure, Run, timed
from pages import FOLDER, hardware, table, three_digits
from speed import WAYS, Effort, Work, costs, estimators, in_turn, loop

import usvlearn
from certify.proofs import exact
from certify.search import box
from certify.training import conditions
from usvlearn.errors import UsvlearnError, exit_on_user_error

LOOP = "plain RLS in numpy"  # the reference of a time that has none in C
SHOWN = ("aid", "rls, exponential", "sift", "joint, n = 23", "rnn, n = 20", "default ensemble")
CALLED = ("sift", "default ensemble")  # whose calls from Python and steps in torch are in the history, too
RECORDED = accuracy.REAL[:3]  # folders of logs
OURS = ("robust_sift_rls", "joint_ekf", "ensemble")
FOLLOWED = {("closed_tight", 100): 200, ("exact_rate", 100): 20, ("proof", 100): 2, ("box", 20): 2}  # calls a round


class Amount(NamedTuple):
    """How much is measured."""

    effort: Effort
    plants: tuple[str, ...]
    data: tuple[str, ...]  # overrides of the simulated boats
    cases: tuple[str, ...]
    steps: int  # limit of every part of a scenario
    elements: int


WHOLE = Amount(
    effort=Effort(repeats=15, steps=50_000, eager=50, calls=2000, clock=process_time),
    plants=accuracy.PLANTS, data=(), cases=("idle", "outliers", "nan", "thruster", "outage"), steps=100_000,
    elements=24,
)  # fmt: skip
QUICK = Amount(
    effort=Effort(repeats=3, steps=1000, eager=10, calls=100, clock=process_time),
    plants=("heron",), data=("data.hours=0.2", "data.mission_minutes=2"),
    cases=("outliers", "nan"), steps=300, elements=2,
)  # fmt: skip


def by_round(spent: Sequence[float], reference: Sequence[float]) -> list[float]:
    return [a / b for a, b in zip(spent, reference, strict=True)]


@torch.no_grad()
def speed(amount: Amount, logs: Path | None) -> list[Figure]:
    known, figures = estimators(), []
    for name in SHOWN:
        ways = costs(known[name], amount.effort, [*WAYS, "loop"])
        reference, named = ("C", "C") if "C" in ways else ("loop", LOOP)
        figures.append(timed(f"speed: {name}, streamed", by_round(ways["streamed"], ways[reference]), named))
        if name in CALLED:
            figures += [
                timed(f"speed: {name}, {label}", by_round(ways[way], ways["loop"]), LOOP)
                for way, label in (("call", "called"), ("torch", "eager torch"))
            ]
    return figures


def predictions(amount: Amount, logs: Path | None) -> list[Figure]:
    """Mean errors in the second halves of the runs, of the boats of a plant together."""
    boats = {
        f"{plant}, simulated": [accuracy.second_half(log) for log in accuracy.simulated((plant,), *amount.data)]
        for plant in amount.plants
    }
    for name in RECORDED:
        if logs is not None and (logs / name).is_dir():
            boats[name] = [accuracy.second_half(accuracy.recorded(logs, name))]
    figures = []
    for name, errors in boats.items():
        persistence, ensemble, free_squares, free_ensemble = np.mean(errors, axis=0)
        figures += [
            Figure(f"accuracy: {name}, one step", ensemble / persistence, "MAE of persistence"),
            Figure(
                f"accuracy: {name}, open-loop simulation", free_ensemble / free_squares, "MAE of batch least squares"
            ),
        ]
    return figures


def stresses(amount: Amount, logs: Path | None) -> list[Figure]:
    cases, known, figures = stress.scenarios(amount.steps, amount.elements), stress.ours(), []
    with np.errstate(all="ignore"):
        for name in OURS:
            for case in amount.cases:
                error = stress.run_ours(cases[case], known[name]).error / stress.true_model(cases[case]).error
                figures.append(Figure(f"stress: {name}, {case}", error, "the true model"))
    return figures


def followed(n: int, rng: np.random.Generator) -> dict[str, Work]:
    """What is timed of networks of n neurons; `box` takes an initial network."""
    weights, initial = random_networks(1, n, rng)[0], initial_networks(1, n, rng)[0]
    a, w1 = torch.tensor(weights.a), torch.tensor(weights.w1)
    a *= 0.9 / float(conditions.rate(a, w1))
    return {
        "closed_tight": partial(conditions.exact, a, w1),
        "exact_rate": partial(exact.extreme_slopes, a.numpy(), weights.w1),
        "proof": lambda: exact.proves(
            "exact", a.numpy(), weights.w1, exact.multipliers("exact", a.numpy(), weights.w1)
        ),
        "box": partial(box.rate, initial, box.operating_box(4)),
    }


def certificates(amount: Amount, logs: Path | None) -> list[Figure]:
    """Times of verdicts, round by round with the loop."""

    def often(work: Work, calls: int) -> None:
        for _ in range(calls):
            work()

    effort, works = amount.effort, {n: followed(n, np.random.default_rng(1)) for n in {n for _, n in FOLLOWED}}
    repeated = {(name, n): partial(often, works[n][name], calls) for (name, n), calls in FOLLOWED.items()}
    spent = in_turn({"loop": loop(effort.calls), **repeated}, effort.repeats, effort.clock)
    return [timed(f"certify: {x}, n = {n}", by_round(spent[x, n], spent["loop"]), LOOP) for x, n in repeated]


SECTIONS: Mapping[str, Callable[[Amount, Path | None], list[Figure]]] = {
    "speed": speed,
    "accuracy": predictions,
    "stress": stresses,
    "certify": certificates,
}


def this_run(effort: str) -> Run:
    now = datetime.now(UTC).replace(microsecond=0)
    packages = (version(name) for name in ("torch", "numba", "numpy"))
    return Run(now.isoformat(), usvlearn.__version__, effort, hardware(), platform.python_version(), *packages)


def percent(change: float | None) -> str:
    if change is None:
        return ""
    return f"{round(100 * change):+d} %" if math.isfinite(change) else "from 0"


def beside_earlier(comparisons: Sequence[Comparison]) -> list[str]:
    """The figures, and what they were before."""
    rows = [
        [each.figure.name, three_digits(each.figure.value), each.figure.reference,
         "" if each.figure.spread is None else f"{100 * each.figure.spread:.0f} %", str(each.entries),
         percent(each.last), percent(each.median), f"{100 * each.tolerance:.0f} %", "**worse**" if each.worse else ""]
        for each in comparisons
    ]  # fmt: skip
    head = ["figure", "ratio", "to", "spread", "entries", "since the last", "since their median", "t", ""]
    return table(head, rows)


def verdict(comparisons: Sequence[Comparison]) -> str:
    """What has become worse, in a sentence."""
    if worse := [each.figure.name for each in comparisons if each.worse]:
        return f"{len(worse)} of {len(comparisons)} figures are worse: {'; '.join(worse)}."
    known = sum(each.entries > 0 for each in comparisons)
    return f"No figure is worse, of {known} with comparable entries." if known else "Nothing to compare with."


def work(given: argparse.Namespace, spare: Path) -> int:
    """The command; returns its exit code."""
    whole = given.only is None and not given.quick
    file = (given.folder or (spare if given.quick else FOLDER)) / "history.csv"
    before = history.read(file)  # a damaged file is found before ten minutes have passed
    if given.logs and not any((given.logs / name).is_dir() for name in RECORDED):
        raise UsvlearnError(f"--logs: found no folder {', '.join(RECORDED)} in {given.logs}, expected one at least")
    run, now = this_run("quick" if given.quick else "whole"), []
    for name in [given.only] if given.only else SECTIONS:
        print(f"{name} …", file=sys.stderr, flush=True)
        now += [Entry(run, figure) for figure in SECTIONS[name](QUICK if given.quick else WHOLE, given.logs)]
    comparisons = [history.compare(before, entry) for entry in now]
    if whole or given.folder:
        file.parent.mkdir(parents=True, exist_ok=True)
        history.append(file, now)
    print(*beside_earlier(comparisons), "", verdict(comparisons), sep="\n")
    return int(given.check and any(each.worse for each in comparisons))


def main(arguments: Sequence[str] | None = None) -> int:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--only", choices=SECTIONS, help="one section")
    asked.add_argument("--quick", action="store_true", help="on little data")
    asked.add_argument("--check", action="store_true", help="exit with 1 if a figure has become worse")
    asked.add_argument("--logs", type=Path, help="a folder with recorded boats")
    asked.add_argument("--folder", type=Path, help="of the history; by default docs/benchmarks")
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as spare, exit_on_user_error():
        return work(asked.parse_args(arguments), Path(spare))


if __name__ == "__main__":
    sys.exit(main())
