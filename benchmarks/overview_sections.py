"""The four parts of the overview: each measures by the functions of its own script, and shows a part of its page."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import NamedTuple

import accuracy
import numpy as np
import stress
import torch
from families import initial_networks, random_networks
from history import Figure, timed
from peers.online import MODULES
from speed_steps import WAYS, costs, costs_of_others, estimators, loop, median, steps_table, times
from timing import Effort, Work, in_turn, micro, ratio, table, three_digits

from certify.proofs import exact
from certify.search import box
from certify.training import conditions

LOOP = "plain RLS in numpy"  # the reference of a time that has none in C
SHOWN = ("aid", "rls, exponential", "sift", "joint, n = 23", "rnn, n = 20", "default ensemble")
CALLED = ("sift", "default ensemble")  # whose calls from Python and steps in torch are in the history, too
RECORDED = accuracy.REAL[:3]  # folders of logs
CASES = ("idle", "outliers", "nan", "thruster", "outage")
OURS = ("robust_sift_rls", "joint_ekf", "ensemble")
FOLLOWED = {("closed_tight", 100): 200, ("exact_rate", 100): 20, ("proof", 100): 2, ("box", 20): 2}  # calls a round
Costs = Mapping[str, Sequence[float]]


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
    plants=accuracy.PLANTS, data=(), cases=CASES, steps=100_000, elements=24,
)  # fmt: skip
QUICK = Amount(
    effort=Effort(repeats=3, steps=1000, eager=10, calls=100, clock=process_time),
    plants=("heron",), data=("data.hours=0.2", "data.mission_minutes=2"),
    cases=("outliers", "nan"), steps=300, elements=2,
)  # fmt: skip


class Part(NamedTuple):
    """What a section shows, and its figures for the history."""

    lines: list[str]
    figures: list[Figure]


def between(values: Iterable[float], show: Callable[[float], str] = three_digits) -> str:
    """
    >>> between([2.0, 1.0, 3.0]), between([1.0])
    ('1.00 to 3.00', '1.00')
    """
    low, *_, high = (*sorted(values),) * 2
    return show(low) if show(low) == show(high) else f"{show(low)} to {show(high)}"


def by_round(spent: Sequence[float], reference: Sequence[float]) -> list[float]:
    return [a / b for a, b in zip(spent, reference, strict=True)]


@torch.no_grad()
def speed(amount: Amount, logs: Path | None) -> Part:
    known, figures = estimators(), []
    spent = {name: costs(known[name], amount.effort, [*WAYS, "loop"]) for name in SHOWN}
    for name, ways in spent.items():
        reference, told = ("C", "C") if "C" in ways else ("loop", LOOP)
        figures.append(timed(f"speed: {name}, streamed", by_round(ways["streamed"], ways[reference]), told))
        if name in CALLED:
            figures += [
                timed(f"speed: {name}, {label}", by_round(ways[way], ways["loop"]), LOOP)
                for way, label in (("call", "called"), ("torch", "eager torch"))
            ]
    others = costs_of_others(amount.effort)
    called, streamed = "ours, RLS", "ours, RLS, streamed"
    beside = [
        [name, micro(median(others, name)), times(others, name, called), times(others, name, streamed)]
        for name in others
    ]
    lines = [
        *steps_table(spent), "",
        *table(["p = 9", "µs a step", "over our RLS, called", "over our RLS, streamed"], beside), "",
        *speed_in_words(spent, others, called, streamed), "",
        f"Medians of {amount.effort.repeats} rounds, in which all works of a row are timed in turn: time of the "
        "processor, one thread, float64. Streamed: a whole log in one call. Called: `Online.step` from Python, sample "
        "by sample. More estimators, batch elements and whole jobs: [Speed of steps and jobs]"
        "(speed.md).",
    ]  # fmt: skip
    return Part(lines, figures)


def speed_in_words(spent: Mapping[str, Costs], others: Costs, called: str, streamed: str) -> Iterator[str]:
    if in_c := [ratio(ways["streamed"], ways["C"]) for ways in spent.values() if "C" in ways]:
        yield f"A streamed step takes {between(in_c)} times as long as the same step in C."
    else:
        yield "No C compiler was found, so that nothing is compared with C."
    eager = [ratio(ways["torch"], ways["streamed"]) for ways in spent.values()]
    yield f"A step in eager torch takes {between(eager)} times as long as a streamed one."
    if libraries := [name for name in others if name in MODULES]:
        beside = [between(ratio(others[name], others[own]) for name in libraries) for own in (called, streamed)]
        yield f"A step of another library takes {beside[0]} times as long as a call of our RLS from Python,"
        yield f"and {beside[1]} times as long as a streamed step of it."
    else:
        yield "No other library was installed (extra `bench`)."


def predictions(amount: Amount, logs: Path | None) -> Part:
    found: dict[str, list[accuracy.SecondHalf]] = {}
    for plant in amount.plants:
        for log in accuracy.simulated((plant,), *amount.data):
            found.setdefault(f"{plant}, simulated", []).append(accuracy.second_half(log))
    names = [name for name in RECORDED if logs is not None and (logs / name).is_dir()]
    for name in names:
        found[name] = [accuracy.second_half(accuracy.recorded(logs, name))]
    rows, figures, ahead, free = [], [], [], []
    for name, boats in found.items():
        persistence, squares, ours, free_squares, free_ours = np.mean(boats, axis=0)
        skills = 1 - ours / persistence, 1 - ours / squares, 1 - free_ours / free_squares
        rows.append([name, f"{persistence:.4f}", *(f"{skill:.3f}" for skill in skills[:2]),
                     f"{free_squares:.4f}", f"{skills[2]:.3f}"])  # fmt: skip
        ahead.append(skills[0])
        free.append(skills[2])
        figures += [
            Figure(f"accuracy: {name}, one step", ours / persistence, "MAE of persistence"),
            Figure(f"accuracy: {name}, open-loop simulation", free_ours / free_squares, "MAE of batch least squares"),
        ]
    head = ["second half of the runs", "persistence, MAE, m/s", "skill against it", "against least squares",
            "open-loop simulation: least squares, MAE, m/s", "skill against it"]  # fmt: skip
    share = sum(each > 0 for each in free)
    lines = [
        *table(head, rows), "",
        f"One step of 0.4 s ahead, the default ensemble has a skill of {between(ahead, '{:.2f}'.format)} against "
        "persistence. In open-loop simulations, from the inputs alone, its error is below that of batch least "
        f"squares in {share} "
        f"of {len(free)} rows; the least skill there is {min(free):.2f}.", "",
        "Skill is 1 − MAE/MAE(reference). Batch least squares is told the whole first half at once; the ensemble has "
        "learned it online, and goes on learning one step ahead, but not in open-loop simulations. A simulated row "
        "is the mean of "
        "two boats." + ("" if names else " This run was given no recorded logs.") + " Recorded boats and all members: "
        "[Accuracy on recorded and simulated boats](accuracy.md); further ahead: [Accuracy of forecasts by horizon]"
        "(forecast.md); parameters: [Identified parameters against the truth](identify.md).",
    ]  # fmt: skip
    return Part(lines, figures)


def stresses(amount: Amount, logs: Path | None) -> Part:
    known = stress.scenarios(amount.steps, amount.elements)
    cases = {name: known[name] for name in amount.cases}
    own = {name: estimator for name, estimator in stress.ours().items() if name in OURS}
    found: dict[str, dict[str, stress.Result]] = {}
    with np.errstate(all="ignore"):
        for case, scenario in cases.items():
            for name, result in stress.outcomes(scenario, own):
                found.setdefault(name, {})[case] = result
    rows = [[name, *(stress.cell(result) for result in results.values())] for name, results in found.items()]
    broken = {name for name, results in found.items() if not all(each.finite for each in results.values())}
    libraries = [name for name in found if name not in own and name != "true model"]
    least = [
        f"{case} {min(found[name][case].error for name in own):.4f} and "
        f"{min(found[name][case].error for name in libraries if found[name][case].finite):.4f}"
        for case in cases
        if any(found[name][case].finite for name in libraries)
    ]
    figures = [
        Figure(f"stress: {name}, {case}", found[name][case].error / found["true model"][case].error, "the true model")
        for name in OURS
        for case in cases
    ]
    lines = [
        *table(["MAE one step ahead, m/s; steps to recover", *cases], rows), "",
        *(f"- {case}: {scenario.title}" for case, scenario in cases.items()), "",
        f"{len(broken & set(libraries))} of {len(libraries)} peers, and {len(broken & set(own))} of {len(own)} of ours "
        "have a prediction or a state that is not finite in at least one of these cases. The true model's error is "
        "that of the noise.", "",
        f"The least errors of ours and of the peers: {'; '.join(least)}. Peers get the samples as they come, as their "
        "documentation shows.", "",
        "All scenarios, more estimators, and the errors of parameters: [Stress tests beside other libraries]"
        "(stress.md).",
    ]  # fmt: skip
    return Part(lines, figures)


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


def certificates(amount: Amount, logs: Path | None) -> Part:
    """Times of verdicts, round by round with the loop."""

    def often(work: Work, calls: int) -> None:
        for _ in range(calls):
            work()

    effort, spent_on = amount.effort, {n: followed(n, np.random.default_rng(1)) for n in {n for _, n in FOLLOWED}}
    works = {(name, n): partial(often, spent_on[n][name], calls) for (name, n), calls in FOLLOWED.items()}
    spent = in_turn({"loop": loop(effort.calls), **works}, effort.repeats, effort.clock)
    figures = [timed(f"certify: {x}, n = {n}", by_round(spent[x, n], spent["loop"]), LOOP) for x, n in works]
    rows = [[x, str(n), three_digits(1e3 * np.median(spent[x, n]) / calls)] for (x, n), calls in FOLLOWED.items()]
    lines = [
        *table(["one network", "n", "ms"], rows), "",
        "`closed_tight`: the condition in torch; `exact_rate`: its rate in fractions; `proof`: that, and its "
        "multipliers; `box`: the exact rate over the states and inputs that occur.",
    ]  # fmt: skip
    return Part(lines, figures)


SECTIONS: dict[str, tuple[str, Callable[[Amount, Path | None], Part]]] = {
    "speed": ("Speed", speed),
    "accuracy": ("Accuracy", predictions),
    "stress": ("Stress", stresses),
    "certify": ("Certificates of contraction", certificates),
}
