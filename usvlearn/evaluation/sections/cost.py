"""Parameters and time per sample of each method on this machine (paper, table I)."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch

from usvlearn.estimators.aid import AID
from usvlearn.estimators.ensemble import Bank, Ensemble
from usvlearn.estimators.rls import RLS
from usvlearn.estimators.rnn import RNN
from usvlearn.estimators.sift import SIFtRLS
from usvlearn.evaluation.section import Section
from usvlearn.evaluation.sections.parameters import unwrapped
from usvlearn.evaluation.sheet import Sheet
from usvlearn.signals import Inputs, named_leaves

SAID = (
    "AID: 9 parameters, O(p) to predict and to learn. RNN: n = 20, m = 4, 140 weights, O(n (m + 1)) both. RLS: 9 "
    "parameters, O(p) and O(p²). No times are given; it ran on a Raspberry Pi 4."
)
ORDERS = {  # to predict, to learn
    AID: ("p", "p"), RNN: ("n (m + 1)", "n (m + 1), sorting n to project"), RLS: ("p", "p²"),
    SIFtRLS: ("p", "p³: a solve"),
}  # fmt: skip
STEPS, PASSES, MANY = 40, 5, 1000


def cost_section(ensemble: Ensemble) -> Section:
    """One boat, one sample at a time, as aboard: median over passes.

    Args:
        ensemble: whose members and rules are timed.
    """
    dtype = ensemble.init(()).predictions.dtype
    value = [torch.tensor(x, dtype=dtype) for x in (0.5, 0.4, 1.0, 0.05, 0.4)]
    inputs, surge = Inputs(*value), torch.tensor(0.8, dtype=dtype)
    rows = []
    with torch.no_grad():
        for name, member in ensemble.members.items():
            state = member.init(())
            inner, core = unwrapped(member, state)
            orders = next((found for kind, found in ORDERS.items() if isinstance(inner, kind)), ("1", "1"))
            predict = _median(lambda m=member, s=state: m.predict(s, inputs))
            learn = _median(lambda m=member, s=state: m.learn(s, inputs, surge))
            lanes = len(member.labels) if isinstance(member, Bank) else 1
            kind = f"{type(inner).__name__}, {lanes} settings" if lanes > 1 else type(inner).__name__
            rows.append((name, kind, _parameters(core), *(f"O({o})" for o in orders), predict, learn))
        state = ensemble.init(())
        whole = _median(lambda: ensemble.predict(state, inputs)), _median(lambda: ensemble.learn(state, inputs, surge))
        wide, seen = ensemble.init((MANY,)), (Inputs(*(x.expand(MANY) for x in inputs)), surge.expand(MANY))
        many = _median(lambda: ensemble.learn(wide, *seen), steps=STEPS // 10)
        rows.append(("all together", "Ensemble", sum(row[2] for row in rows), "–", "–", *whole))
    columns = ("method", "kind", "parameters", "to predict", "to learn", "predict, µs", "predict and learn, µs")
    machine = f"{platform.machine()}, Python {platform.python_version()}, torch {torch.__version__}, one thread"
    here = [
        f"Measured on {machine}: one boat, one sample at a time, the median of {PASSES} passes of {STEPS} steps.",
        f"{MANY} boats as lanes of one batch take {many / whole[1]:.1f} × the time of one.",
    ]
    return Section("cost", "Parameters and time per sample", SAID, here, (), [Sheet("cost", columns, rows)])


def _parameters(state: Any) -> int:
    """What the method identifies: θ, or the network's weights."""
    identified = [leaf for name, leaf in named_leaves(state) if name == "theta" or name.startswith("weights.")]
    return sum(leaf.numel() for leaf in identified)


def _median(work: Callable[[], object], steps: int = STEPS) -> float:
    """µs a call."""
    work()
    passes = []
    for _ in range(PASSES):
        start = time.perf_counter()
        for _ in range(steps):
            work()
        passes.append((time.perf_counter() - start) / steps)
    return 1e6 * statistics.median(passes)
