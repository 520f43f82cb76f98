"""Batch elements on a GPU: steps and gradients by torch on CUDA, beside torch and compiled code on the CPU.

python benchmarks/cuda.py                        where torch finds CUDA; writes the page
python benchmarks/cuda.py --short                fewer steps and sizes, without the default ensemble: a minute, printed
python benchmarks/cuda.py --cpu                  the CPU's part alone, printed
python benchmarks/cuda.py --compile              also by torch.compile, which compiles for minutes

All is float64. Every batch element has its own samples, and learns from each. The results of every way are compared
with those of torch on the CPU.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import accuracy
import torch
from cuda_ways import Graphed, Work, backward, compiled, eager, error, mapped, stepped
from pages import publish
from speed_steps import samples
from timing import counted, machine, table, three_digits
from torch import Tensor

from usvlearn import AID, RLS, RNN, Estimator, JointEKF, Sample
from usvlearn.core.samples import named_leaves, tree_map

MASS, SURGE_MAX, NOISE = 28.0, 2.74, 0.02  # kg, m/s, m/s
PREDICTIONS, GRADIENTS = 1e-6, 1e-6  # m/s; of the largest entry: how far results may lie from those of the CPU
TEMPORARIES = 8  # copies of a state that a step holds, about
AT_REST = 100  # steps with which the boat's log begins, at most
SLOW = 5.0  # s of a work that is done once
NONE = "No CUDA device was found, so nothing was measured; --cpu measures the part of the CPU."

Make = Callable[[Estimator, Sample], Work]


class Effort(NamedTuple):
    """How much is measured."""

    elements: tuple[int, ...] = (1, 16, 256, 4096, 65536)
    element_steps: int = 2**19  # of a run, at least `fewest` steps and at most `most`
    fewest: int = 4  # also of a first run, which tells how long the others take
    most: int = 200
    back: int = 50  # steps through which a gradient is taken
    repeats: int = 5
    longest: float = 20.0  # s of a run: above it has fewer steps, or a gradient is left out

    def steps(self, elements: int) -> int:
        return min(self.most, max(self.fewest, self.element_steps // elements))


SHORT = Effort((1, 4096, 65536), 2**16, 2, 20, 10, 1, 2.0)
QUICK = Effort((1, 4), 40, 2, 5, 3, 2)


class Way(NamedTuple):
    """Where and how a result is computed."""

    device: str
    make: Make


class Kind(NamedTuple):
    """What is measured."""

    title: str
    ways: Mapping[str, Way]
    reference: Make  # on the CPU
    keeps: bool  # all steps in memory, for a gradient


def estimators() -> dict[str, Estimator]:
    """One of each kind of arithmetic, and the default ensemble.

    The network's weights are random: those of "persistence" are zero in most neurons, where the projection has a kink.
    Its gradient by the first weights is then another one after a rounding of 1e-16, on every device.
    """
    rnn = RNN(surge_max=SURGE_MAX, initial="random")
    known = {"aid": AID(MASS), "rls": RLS(), "rnn": rnn, "joint": JointEKF(SURGE_MAX, MASS)}
    return known | {"default ensemble": accuracy.ensemble(())}


def elements_of(steps: int, elements: int) -> Sample:
    """A simulated boat's samples, `(steps, elements)`; commands and noise differ by batch element."""
    generator = torch.Generator().manual_seed(0)
    wide = tree_map(lambda x: x[AT_REST:, None].expand(steps, elements), samples(AT_REST + steps))
    shares = torch.linspace(0.5, 1.0, elements, dtype=torch.float64)
    left, right = (x * shares for x in wide.inputs[:2])
    surge = wide.surge + NOISE * torch.randn(steps, elements, generator=generator, dtype=torch.float64)
    return wide._replace(inputs=wide.inputs._replace(command_left=left, command_right=right), surge=surge)


def sent(run: Sample, device: str) -> Sample:
    return tree_map(lambda x: x.contiguous().to(device), run)


def kinds(cuda: bool, compile_steps: bool) -> list[Kind]:
    """What is measured, and by which ways; those of graphs last, because a failed capture may harm what follows."""
    steps, back, elements, graph = (
        {"CPU, compiled": Way("cpu", compiled), "CPU, torch": Way("cpu", eager)},
        {"CPU, torch": Way("cpu", backward)},
        {"CPU, torch": Way("cpu", mapped)},
        {},
    )
    device = "cuda" if cuda else "cpu"
    if cuda:
        steps["CUDA, torch"] = Way("cuda", eager)
        back["CUDA, torch"] = Way("cuda", backward)
        elements["CUDA, torch"] = Way("cuda", mapped)
        graph["CUDA graph"] = Way("cuda", Graphed)
    if compile_steps:
        steps[f"{device.upper()}, torch.compile"] = Way(device, stepped)
    found = [
        Kind("A step", steps, eager, False),
        Kind("A gradient of all batch elements together", back, backward, True),
    ]
    found += [
        Kind("A gradient of each batch element", elements, mapped, True),
        Kind("A step as a CUDA graph", graph, eager, False),
    ]
    return [kind for kind in found if kind.ways]


def seconds(work: Work, device: str, repeats: int) -> float:
    """Median time of a work; a slow one is done once. The first call, which may compile, is not measured."""
    work()
    spent = [_once(work, device)]
    if spent[0] < SLOW:
        spent += [_once(work, device) for _ in range(repeats - 1)]
    return statistics.median(spent)


def _once(work: Work, device: str) -> float:
    if device != "cuda":
        begin = time.perf_counter()
        work()
        return time.perf_counter() - begin
    begun, ended = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    begun.record()
    work()
    ended.record()
    torch.cuda.synchronize()
    return begun.elapsed_time(ended) / 1000  # from ms


def room(device: str) -> float:
    """Bytes that a measurement may use: half of what is free."""
    if device == "cuda":
        torch.cuda.empty_cache()
        return torch.cuda.mem_get_info()[0] / 2
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2
    except (AttributeError, OSError, ValueError):  # no such question on this system
        return 2.0**31


def needed(estimator: Estimator, keeps: bool) -> float:
    """Bytes for a batch element of a step, about: of the state and its temporaries, or of what a gradient keeps."""
    estimator, kept = estimator.to("cpu"), {}
    if not keeps:
        return TEMPORARIES * sum(x.numel() * x.element_size() for _, x in named_leaves(estimator.init()))

    def keep(x: Tensor) -> Tensor:
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    run = elements_of(2, 2)
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda x: x):
        error(estimator, run)
    return sum(kept.values()) / run.surge.numel()


def rates(kind: Kind, way: Way, estimator: Estimator, effort: Effort) -> list[str]:
    """Thousand element-steps a second, by the number of batch elements; – where it would not fit, or take too long."""
    found, each = [], needed(estimator, kind.keeps)  # bytes of an element-step
    for elements in effort.elements:
        steps = effort.back if kind.keeps else effort.steps(elements)
        fits = each * elements * (steps if kind.keeps else 1) <= room(way.device)
        first = timed(way, estimator, effort.fewest, elements, 1) if fits else None
        if first is not None and not kind.keeps:
            steps = min(steps, max(effort.fewest, int(effort.longest / first * effort.fewest)))
        if first is None or first / effort.fewest * steps > effort.longest:
            found.append("–")
            continue
        spent = timed(way, estimator, steps, elements, effort.repeats)
        found.append("–" if spent is None else three_digits(0.001 * steps * elements / spent))
    return found


def timed(way: Way, estimator: Estimator, steps: int, elements: int, repeats: int) -> float | None:
    """Seconds of a run; None if the GPU's memory does not suffice."""
    try:
        work = way.make(estimator.to(way.device), sent(elements_of(steps, elements), way.device))
        return seconds(work, way.device, repeats)
    except torch.OutOfMemoryError:
        return None


def compared(kind: Kind, way: Way, estimator: Estimator, effort: Effort) -> str:
    """The largest difference from torch on the CPU: of predictions in m/s, of gradients relative to the largest entry.

    Raises:
        SystemExit: it is too large.
    """
    reference = Way("cpu", kind.reference)
    if way == reference:
        return ""
    elements, limit = effort.elements[1], GRADIENTS if kind.keeps else PREDICTIONS
    run = elements_of(min(effort.back, effort.steps(elements)), elements)
    found, expected = (result(each, estimator, run) for each in (way, reference))
    worst = max(_difference(found[name], x, expected if kind.keeps else {}) for name, x in expected.items())
    if not worst <= limit:
        raise SystemExit(f"{kind.title}: differs by {worst:.2g} from torch on the CPU, expected {limit:g} or less")
    return f"{worst:.1g}"


def result(way: Way, estimator: Estimator, run: Sample) -> dict[str, Tensor]:
    """What a way computes, by name, on the CPU."""
    found = way.make(estimator.to(way.device), sent(run, way.device))()
    return {name: x.detach().cpu().clone() for name, x in named_leaves(found)}


def _difference(found: Tensor, expected: Tensor, gradients: Mapping[str, Tensor]) -> float:
    """The largest difference; that of a gradient relative to its largest entry, or to a thousandth of that of all."""
    largest = max((float(x.abs().max()) for x in gradients.values()), default=0.0)
    scale = max(float(expected.abs().max()), 1e-3 * largest) if gradients else 1.0
    return float((found - expected).abs().max()) / (scale or 1.0)


def section(kind: Kind, known: Mapping[str, Estimator], effort: Effort) -> list[str]:
    """The table of a kind; its last column is the difference from torch on the CPU."""
    rows = []
    for name, estimator in known.items():
        for title, way in kind.ways.items():
            print(f"{kind.title}: {name}, {title} …", flush=True)
            try:
                shown = [*rates(kind, way, estimator, effort), compared(kind, way, estimator, effort)]
            except RuntimeError as failure:
                if way.make not in (Graphed, stepped):
                    raise
                shown = [f"not possible: {str(failure).splitlines()[0]}"] + [""] * len(effort.elements)
            rows.append([f"{name}, {title}", *shown])
    head = ["thousand element-steps/s", *(counted(n, "batch element") for n in effort.elements), "difference"]
    return [f"## {kind.title}", "", *table(head, rows), ""]


def page(cuda: bool, compile_steps: bool, effort: Effort, known: Mapping[str, Estimator]) -> list[str]:
    """The page, as Markdown."""
    gpu = f"{torch.cuda.get_device_name()}, CUDA {torch.version.cuda}; " if cuda else ""
    threads = counted(torch.get_num_threads(), "thread")
    text = [
        "# Batch elements on a GPU",
        "",
        f"Measured by `python benchmarks/cuda.py` in float64: medians of {effort.repeats} runs, after one that is not",
        f"counted. The CPU uses {threads}. A gradient is taken through {effort.back} steps, and each of them counts",
        "as an element-step. – marks what does not fit into half of the free memory, or takes more than "
        f"{effort.longest:g} s.",
        "The last column is the largest difference from torch on the CPU: of predictions in m/s, of gradients relative",
        f"to the largest entry. More than {PREDICTIONS:g} and {GRADIENTS:g} would have ended the measurement.",
        "",
        f"{gpu}{machine()}.",
        "",
    ]
    for kind in kinds(cuda, compile_steps):
        text += section(kind, known, effort)
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--cpu", action="store_true", help="the CPU's part alone, printed")
    asked.add_argument("--compile", action="store_true", help="also by torch.compile")
    asked.add_argument("--short", action="store_true", help="fewer steps and sizes, without the ensemble; printed")
    asked.add_argument("--quick", action="store_true", help="on little data: whether it runs; printed")
    given = asked.parse_args(arguments)
    cuda = torch.cuda.is_available() and not given.cpu
    if not cuda and not given.cpu:
        print(NONE)
        return
    known, effort = estimators(), QUICK if given.quick else SHORT if given.short else Effort()
    if given.short:
        del known["default ensemble"]
    text = page(cuda, given.compile, effort, known)
    if cuda and effort == Effort():
        publish(__file__, text)
    else:
        print(*text, sep="\n")


if __name__ == "__main__":
    main()
