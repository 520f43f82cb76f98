"""Runs of many batch elements on a GPU: each thread has one lane, a batch element, for all steps.

The kernel is written here around the device functions of `engine.dispatch`. The table and the numbers that all lanes
share are constants of it; only numbers that differ are sent. A small state is kept in the thread, a large one in
columns, where neighbouring lanes lie beside each other. Lanes of one boat are neighbours, because they read the same
samples. Errors are added up in the kernel: predictions of 65,536 lanes over 30 h are 140 GB. Results differ from those
of the CPU by rounding, because other products are fused with sums.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import copy
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core import prepared_samples
from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.family import Row
from usvlearn.core.jit import announce, folder
from usvlearn.core.on_device import SIMULATED, Device, imported, obstacle
from usvlearn.engine import dispatch, dispatch_tables
from usvlearn.engine.parts import Description
from usvlearn.engine.program import Program, program_for
from usvlearn.errors import ConfigError, check_choice

MOST_LANES, MOST_NUMBERS = 262_144, 2**27  # lanes in one pass, and numbers in their states
INLINED, THREAD = 512, 6_000  # most numbers of state and work of a lane that is inlined, and that is kept in the thread
LAUNCH, THREADS = (200, 20_000, 10**6), 64  # least and most steps of a launch, and steps × numbers; threads of a block

KERNEL = """
def lanes(table, values, states, works, rows, columns, free, totals, counts, predictions, picks):
    lane = cuda.grid(1)
    if lane < len(columns):
        q = cuda.local.array(NUMBERS, number)
        for i in range(len(BASE)):
            q[i] = BASE[i]
        for i in range(COUNT):
            q[OWN[i]] = values[i, lane]
        PLACED
        total, count, column = 0.0, 0, columns[lane]
        for k in range(rows.shape[1]):
            row = rows[column, k]
            mode = row[MODE]
            learned = mode == LEARN
            if free and learned:
                mode = mode - LEARN + PREDICT
            STEP
            found = predicted
            if DUE >= 0:
                found = s[DUE]
                learned = learned and isfinite(s[WHEN])
            if learned:
                total += abs(found - row[SURGE])
                count += 1
            if predictions.shape[1] > 0:
                predictions[lane, k] = predicted
                for i in range(PICKS):
                    picks[lane, k, i] = s[PICKED[i]]
        totals[lane], counts[lane] = total, count
        KEPT
"""
IN_THREAD = """
        s, work = cuda.local.array(SIZE, number), cuda.local.array(WORK, number)
        for i in range(SIZE):
            s[i] = states[i, lane]
"""
KEPT = """
        for i in range(SIZE):
            states[i, lane] = s[i]
"""
IN_COLUMNS, TOGETHER = "s, work = states[:, lane], works[:, lane]", "predicted = step(table, s, q, row, mode, work)"
ALONE = """
            predicted = NAN
            if mode == START:
                start(TABLE, TABLE[1], s, q, row[SURGE])
            elif mode != HOLD:
                predicted = advance(TABLE, TABLE[1], s, q, row, mode == LEARN, work, work[COPY:])
"""
MADE: dict[str, Any] = {}  # kernels by the hash of what is constant in them


def chosen_device(device: str, key: str = "tuning.device") -> str:
    """The device as asked for, or a ConfigError; for "auto" it is "cpu", with a warning, where there is no GPU."""
    cause = obstacle() if check_choice(key, device, ("cpu", "cuda", "auto")) != "cpu" else None
    if cause and device == "cuda":
        raise ConfigError(f"{key}: found cuda, but {cause}; or use {key}=cpu")
    if cause:
        warnings.warn(f"{key}: the CPU is used, because {cause}", stacklevel=2)
    return "cpu" if cause or device == "cpu" else "cuda"


class Lanes:
    """Batch elements of an estimator on a GPU, with their states, `(elements, size)`; a `Planar` is refused.

    The last axis of the batch should be that of the boats. A launch of `steps` steps takes some tenths of a second.
    """

    def __init__(self, plan: Program, states: np.ndarray):
        if len(plan.head) > 1:
            raise ConfigError("found a Planar estimator on a GPU, whose kernels know the surge alone: use the CPU")
        if plan.external:
            raise ConfigError(f"found {plan.elsewhere[0]}… on a GPU, which no kernel steps: use the CPU")
        self.order = np.arange(plan.elements).reshape(-1, *plan.batch[-1:]).T.ravel()  # element of a lane, boat by boat
        self.steps = max(LAUNCH[0], min(LAUNCH[1], LAUNCH[2] // (plan.size + plan.work)))
        self.cuda, self.plan, self.own, self.dtype = imported(), plan, own_numbers(plan), plan.dtype
        numbers = np.broadcast_to(plan.numbers, (plan.elements, plan.numbers.shape[1]))[self.order]
        self.inputs = [self._sent(x) for x in (plan.program, numbers[:, self.own].T)]
        self.states = self._sent(states[self.order].T)
        wide = plan.elements if plan.size + plan.work > THREAD else 1
        self.works = self.cuda.device_array((plan.work, wide), plan.dtype)

    def copied(self) -> Lanes:
        """The same lanes with states of their own."""
        lanes = copy(self)
        lanes.states = self._sent(self.states.copy_to_host())
        return lanes

    def run(
        self, rows: np.ndarray, columns: np.ndarray, free: bool, due: Sequence[int] = (-1, -1),
        picked: np.ndarray | None = None,
    ) -> list[np.ndarray]:  # fmt: skip
        """Make all steps in one launch: of each element the sum of |error|, m/s, how many steps counted, and unless
        `picked` is None the predictions and what was picked. Arguments are those of `engine.dispatch.run`; `due` are
        places in the state: of the prediction that counts instead, and of a number that is finite where it does.
        """
        count, steps = len(columns), 0 if picked is None else rows.shape[1]
        places = np.array([*due, *([] if picked is None else picked)], np.int64)
        name, kernel = kernel_of(self.plan, self.own, places)
        buffers = [self.cuda.device_array(count, kind) for kind in (np.float64, np.int64)]
        buffers += [self.cuda.device_array((count, steps, *each), self.dtype) for each in ((), (len(places) - 2,))]
        read = [self._sent(x) for x in (rows, columns[self.order])]
        with announce(__file__, f"kernel {name} for the GPU"), warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*Grid size")  # few lanes leave a part of the GPU idle
            launched = kernel[-(-count // THREADS), THREADS]
            launched(*self.inputs, self.states, self.works, *read, free, *buffers)
            self.cuda.synchronize()
        return [self._by_element(x.copy_to_host()) for x in buffers]

    def ends(self) -> np.ndarray:
        """The states, `(elements, size)`."""
        return self._by_element(self.states.copy_to_host().T)

    def _by_element(self, x: np.ndarray) -> np.ndarray:
        ordered = np.empty_like(x, order="C")
        ordered[self.order] = x
        return ordered

    def _sent(self, x: np.ndarray) -> Any:
        return self.cuda.to_device(np.ascontiguousarray(x))


def most_lanes(description: Description) -> int:
    """How many batch elements of an estimator one pass may have."""
    return max(1, min(MOST_LANES, MOST_NUMBERS // max(1, program_for(description, (), np.dtype(float)).size)))


def own_numbers(plan: Program) -> np.ndarray:
    """The places of the numbers that differ by lane."""
    return np.flatnonzero((plan.numbers != plan.numbers[0]).any(0))


def kernel_of(plan: Program, own: np.ndarray, places: np.ndarray) -> tuple[str, Any]:
    """The name of a program's kernel, and the kernel, compiled when it is called; `own` are `own_numbers`.

    Places in the state are constants, too: a state that is read at any place would be kept in memory, not in registers.
    """
    numbers = np.append(plan.numbers[:1], plan.dtype.type(0))  # no array may be empty
    numbers[own] = 0.0
    sizes = np.array([plan.size, plan.work, *plan.program.shape, plan.dtype.itemsize, len(own)])
    parts = sizes, plan.program, numbers, own, places
    if (name := sha256(b"".join(each.tobytes() for each in parts)).hexdigest()[:16]) not in MADE:
        MADE[name] = _written(plan, numbers, own, places, folder(Path(__file__)) / f"lanes_{name}.py")
    return name, MADE[name]


def _written(plan: Program, numbers: np.ndarray, own: np.ndarray, places: np.ndarray, path: Path) -> Any:
    """The kernel of a program, as a file beside which numba-cuda keeps the machine code."""
    whole, alone, device = plan.program[0], plan.program[0, Row.RULES] == 0, Device(plan.size + plan.work <= INLINED)
    families = {int(row[Row.FAMILY]) for row in plan.program[1 : 1 + whole[Row.ESTIMATORS]]}
    for verb in dispatch_tables.VERBS.keys() - {"run_alone"}:
        device[getattr(dispatch_tables, verb)] = device[dispatch_tables.chain(verb, families)]
    names = {key: x for key, x in vars(prepared_samples).items() if isinstance(x, int)} | {
        "cuda": imported(), "number": plan.dtype.type, "NAN": np.nan, "isfinite": device.np.isfinite,
        "OWN": np.append(own, 0), "COUNT": len(own), "TABLE": plan.program,
        "BASE": numbers, "NUMBERS": len(numbers), "SIZE": plan.size, "WORK": plan.work, "COPY": int(whole[Row.KEPT]),
        "DUE": int(places[0]), "WHEN": int(places[1]), "PICKED": np.append(places[2:], 0), "PICKS": len(places) - 2,
    }  # fmt: skip
    names |= {name: device[getattr(dispatch, name)] for name in (("start", "advance") if alone else ("step",))}
    placed, keeping = (IN_THREAD, KEPT) if plan.size + plan.work <= THREAD else (IN_COLUMNS, "")
    source = KERNEL.replace("STEP", ALONE if alone else TOGETHER).replace("PLACED", placed).replace("KEPT", keeping)
    if not path.exists():  # numba-cuda compiles anew what has another time
        write_atomically(path, source.encode())
    exec(compile(source, str(path), "exec"), names)
    return imported().jit(names["lanes"], **({} if SIMULATED else {"lto": False, "cache": True}))
