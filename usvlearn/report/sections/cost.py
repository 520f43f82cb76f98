"""Parameters and time per sample of each method on this machine (paper, table I)."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs, Sample, named_leaves
from usvlearn.display.terminal import Cell, ResultTable
from usvlearn.engine.online import Online
from usvlearn.estimators.aid.layer import AID
from usvlearn.estimators.arx.layer import ARX
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.layer import JointEKF
from usvlearn.estimators.least_squares.rls import RLS
from usvlearn.estimators.least_squares.sift import SIFtRLS
from usvlearn.estimators.rnn.layer import RNN
from usvlearn.evaluation.diagnostics import unwrapped
from usvlearn.report.sections.section import Section

PAPER_RESULT = (
    "AID: 9 parameters, O(p) to predict and to learn. RNN: n = 20, m = 4, 140 weights, O(n (m + 1)) both. RLS: 9 "
    "parameters, O(p) and O(p²). No times are given; it ran on a Raspberry Pi 4."
)
ORDERS = {  # to predict, to learn
    AID: ("p", "p"), RNN: ("n (m + 1)", "n (m + 1), rounds of n to project"), RLS: ("p", "p²"), SIFtRLS: ("p", "p²"),
    JointEKF: ("p", "p²"), ARX: ("p", "p²"),
}  # fmt: skip
STEPS, PASSES = 400, 5


def cost_section(ensemble: Ensemble) -> Section:
    """The time of one boat, one sample at a time, as in live use: the median over passes.

    Args:
        ensemble: whose members and combiners are timed.
    """
    sample = Sample(Inputs(0.5, 0.4, 1.0, 0.05, 0.4), 0.8, True, True)
    rows: list[tuple[Cell, ...]] = []
    total = 0
    for name, member in ensemble.members.items():
        inner, core = unwrapped(member, member.init(()))
        orders = next((found for kind, found in ORDERS.items() if isinstance(inner, kind)), ("1", "1"))
        total += (count := _parameters(core))
        rows.append((name, type(inner).__name__, count, *(f"O({o})" for o in orders), *_times(member, sample)))
    rows.append(("all together", "Ensemble", total, "–", "–", *_times(ensemble, sample)))
    columns = "method", "kind", "parameters", "to predict", "to learn", "predict, µs", "predict and learn, µs"
    machine = f"{platform.machine()}, Python {platform.python_version()}, one thread"
    here = [f"Measured on {machine}: one boat, one sample at a time from Python, the median of {PASSES} passes."]
    return Section(
        "cost", "Parameters and time per sample", PAPER_RESULT, here, (), [ResultTable("cost", columns, rows)]
    )


def _times(estimator: Estimator, sample: Sample) -> tuple[float, float]:
    """The times in µs: to predict, and to predict and learn."""
    boat = Online(estimator)
    return _median(lambda: boat.predict(sample.inputs)), _median(lambda: boat.step(sample))


def _parameters(state: Any) -> int:
    """The identified parameters of a method: θ, the network's weights, or what a joint EKF reads of its state."""
    identified = [
        leaf for name, leaf in named_leaves(state) if name in ("theta", "reading") or name.startswith("weights.")
    ]
    return sum(leaf.numel() for leaf in identified)


def _median(work: Callable[[], object]) -> float:
    """µs a call."""
    work()
    passes = []
    for _ in range(PASSES):
        start = time.perf_counter()
        for _ in range(STEPS):
            work()
        passes.append((time.perf_counter() - start) / STEPS)
    return 1e6 * statistics.median(passes)
