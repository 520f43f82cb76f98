"""Runs of many batch elements over samples by the kernels."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from usvlearn.core.family import Row
from usvlearn.core.prepared_samples import ROW, prepare_all
from usvlearn.core.samples import PlanarSample, Sample, named_leaves, tree_map
from usvlearn.engine import dispatch as step
from usvlearn.engine.first_use import compile_runs
from usvlearn.engine.lanes import Lanes
from usvlearn.engine.parts import Description
from usvlearn.engine.program import Program, program_for


class Result(NamedTuple):
    """The result of a run."""

    leaves: dict[str, np.ndarray]  # of the state at the end, (*batch, …), by dotted name
    predictions: np.ndarray  # (time, *batch) m/s
    record: dict[str, np.ndarray]  # (time, *batch, …) by dotted name


def roll(
    description: Description,
    leaves: Mapping[str, np.ndarray],
    samples: Sample | PlanarSample,
    free: bool = False,
    record: Sequence[str] = (),
    threads: int = 1,
    device: str = "cpu",
    given: np.ndarray | None = None,
) -> Result:
    """Run a described estimator over samples, `(time, *batch)`, predicting before learning, unless it runs `free`.

    Args:
        description: of the estimator.
        leaves: of its state, `(*batch, …)`, by dotted name.
        samples: arrays `(time, *batch)`; axes of the batch along which they are the same may have the stride 0.
        free: whether nothing is learned.
        record: names of leaves that are recorded after every step.
        threads: how many threads share the batch elements.
        device: "cpu", or "cuda": a GPU (`engine.lanes`).
        given: what members that other code steps predict, m/s, `(time, *batch, members)`; None: they are inactive.
    """
    plain = samples.sample if isinstance(samples, PlanarSample) else samples
    steps, *batch = plain.surge.shape
    plan = program_for(description, batch, plain.surge.dtype)
    states = plan.pack(leaves)
    places = {name: plan.places(name) for name in record}
    picked = np.concatenate([np.zeros(0, np.int64), *(x.reshape(-1) for x in places.values())])
    predictions = np.empty((plan.elements, steps), plan.dtype)
    picks = np.empty((plan.elements, steps, len(picked)), plan.dtype)

    def some(first: int, last: int) -> None:
        work = np.empty(plan.work, plan.dtype)
        step.run(
            plan.program, plan.head, states, plan.numbers, rows, poses, columns, free, picked, predictions, picks, work,
            first, last,
        )  # fmt: skip

    if device == "cpu":
        compile_runs(plan.dtype)
    rows, columns = prepared(plain, plan, given)
    poses = np.zeros((1, 1, 0), plan.dtype)
    if isinstance(samples, PlanarSample):  # no batch elements share a pose
        rows, columns, poses = rows[columns], np.arange(plan.elements), _poses(samples, plan)
    if device == "cuda":
        lanes = Lanes(plan, states)
        *_, predictions, picks = lanes.run(rows, columns, free, picked=picked)
        states = lanes.ends()
    else:
        in_parallel(some, plan.elements, threads)
    recorded, begin = {}, 0
    for name, place in places.items():
        part = picks[..., begin : begin + place.size].reshape(*batch, steps, *place.shape)
        recorded[name] = plan.typed(name, np.ascontiguousarray(np.moveaxis(part, len(batch), 0)))
        begin += place.size
    together = np.ascontiguousarray(np.moveaxis(predictions.reshape(*batch, steps), -1, 0))
    return Result(plan.unpack(states), together, recorded)


def _poses(samples: PlanarSample, plan: Program) -> np.ndarray:
    """What is measured at the end of each step, `(elements, time, 5)`."""
    wide = [np.asarray(x, plan.dtype).reshape(len(x), plan.elements).T for x in samples[1:]]
    return np.ascontiguousarray(np.stack(wide, -1))


def prepared(samples: Sample, plan: Program, given: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Prepared samples, `(columns, time, ROW + external)`, and the column that each batch element sees, `(elements,)`.

    Batch elements that share their samples, along an axis of stride 0, share a column, if nothing is `given`.
    """
    arrays = [leaf for _, leaf in named_leaves(samples)]
    steps, *batch = arrays[0].shape
    shared = [all(x.strides[axis + 1] == 0 for x in arrays) or length == 1 for axis, length in enumerate(batch)]
    distinct = tuple(1 if same else length for same, length in zip(shared, batch, strict=True))
    count = int(np.prod(distinct, dtype=int))
    pick = (slice(None), *(slice(0, 1) if same else slice(None) for same in shared))
    own_columns: Sample = tree_map(lambda x: np.ascontiguousarray(x[pick].reshape(steps, count)), samples)
    rows = np.empty((count, steps, ROW + plan.external), plan.dtype)
    rows[..., ROW:] = np.nan
    heads, limit = plan.program[0, Row.HEADS] > 0, step.surge_limit(plan.program, plan.numbers[0])
    prepare_all(*own_columns.inputs, *own_columns[1:], heads, limit, rows)
    columns = np.broadcast_to(np.arange(count).reshape(distinct), batch).flatten()
    if given is None:
        return rows, columns
    rows = rows[columns]
    rows[..., ROW:] = np.moveaxis(given.reshape(steps, plan.elements, -1), 0, 1)
    return rows, np.arange(plan.elements)


def in_parallel(work: Callable[[int, int], None], elements: int, threads: int) -> None:
    """Call `work(first, last)` over all batch elements on `threads` threads; kernels do not hold the GIL."""
    if threads <= 1 or elements == 1:
        work(0, elements)
        return
    edges = np.linspace(0, elements, min(threads * 4, elements) + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, edges[:-1], edges[1:]))
