"""The program of a description; that of a boat in the plane is those of its three ensembles, and the tracks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from usvlearn.core.prepared_samples import ROW
from usvlearn.engine.leaves import Description, block_size, forecast_size, track_size
from usvlearn.engine.program import Leaf, Program
from usvlearn.estimators.planar import state as at
from usvlearn.estimators.planar.state import AXES, FAMILY, TrackState, filter_of

if TYPE_CHECKING:
    from numpy.typing import DTypeLike


def program_for(description: Description, batch: Sequence[int], dtype: np.dtype) -> Program:
    """The `Program`, cached, because a replay needs the same one for every chunk."""
    return _plan(json.dumps(description), tuple(batch), np.dtype(dtype))


@lru_cache(maxsize=8)
def _plan(description: str, batch: tuple[int, ...], dtype: np.dtype) -> Program:
    found = json.loads(description)
    if found["kind"] == "planar":
        return PlanarProgram(found, batch, dtype)
    return Program(found, batch, dtype)


class PlanarProgram(Program):
    """As `Program`, of a `Planar`.

    Args:
        description: of a `Planar`, as its `description` gives it.
        batch, dtype: as of `Program`.
    """

    def __init__(self, description: Description, batch: Sequence[int] = (), dtype: DTypeLike = np.float64):
        self.batch, self.dtype = tuple(batch), np.dtype(dtype)
        self.elements = int(np.prod(self.batch, dtype=int))
        self.leaves: dict[str, Leaf] = {}
        self.size, self.head = 0, np.zeros((len(AXES) + 1, at.PLACES), np.int64)
        slots, count, length = track_size(description)
        block = at.slot_length(count, ())
        tables: list[np.ndarray] = []
        numbers: list[np.ndarray] = []
        begin = width = work = 0
        for row, axis in zip(self.head, AXES, strict=False):
            plan, own = program_for(description[axis], self.batch, self.dtype), description[axis]
            name, updates = filter_of(axis, own), 0
            mean = plan.leaves[f"members.{name}.mean"].place
            if axis != "surge":
                updates = plan.leaves[f"members.{name}.updates"].place
            _, horizons, members = forecast_size(own["forecasts"])
            weights = block + block_size(own)
            predicted = plan.leaves["predictions"].place + own["columns"].index(name)
            deviation = plan.leaves[f"members.{name}.deviation"].place
            row[: at.DEVIATION + 1] = begin, self.size, width, mean, updates, block, weights, predicted, deviation
            block = weights + horizons * members
            for leaf, each in plan.leaves.items():
                self.leaves[f"{axis}.{leaf}"] = each._replace(place=each.place + self.size)
            tables.append(plan.program)
            begin += len(plan.program)
            numbers.append(plan.numbers)
            self.size, width, work = self.size + plan.size, width + plan.numbers.shape[1], max(work, plan.work)
            if axis == "surge":
                self.slot = plan.slot
        for leaf, field in FAMILY.leaves((slots, count, length), "track.").items():
            strides = tuple(int(np.prod(field.shape[k + 1 :], dtype=int)) for k in range(len(field.shape)))
            self.leaves[leaf] = Leaf(self.size, field.shape, strides, field.flag)
            self.size += int(np.prod(field.shape, dtype=int))
        self._track(slots, count, length, width)
        own = [
            description["numbers"]["coverage"],
            description["numbers"]["overlap"],
            *description["vectors"]["horizons"],
        ]
        rows = max(len(each) for each in numbers)
        wide = [np.broadcast_to(each, (rows, each.shape[1])) for each in numbers]
        self.numbers = np.concatenate([*wide, np.broadcast_to(np.array(own), (rows, len(own)))], 1).astype(self.dtype)
        self.program = np.full((begin, max(each.shape[1] for each in tables)), -1, np.int64)
        begin = 0
        for table in tables:
            self.program[begin : begin + len(table), : table.shape[1]] = table
            begin += len(table)
        self.length, self.work = length, work + 4 * ROW
        self._lay_out()

    def _track(self, slots: int, count: int, length: int, numbers: int) -> None:
        """Fill the row of the tracks."""
        row = self.head[-1]
        names = [name for name in TrackState._fields if name not in ("learned", "due")]
        places = [self.leaves[f"track.{name}"].place for name in names]
        row[: len(places)] = places
        row[at.DUES] = self.leaves["track.due"].place
        learned = [leaf.place for name, leaf in self.leaves.items() if name.startswith("track.learned.")]
        row[at.LEARNED : at.LEARNED + len(learned)] = learned
        row[at.COUNT], row[at.HORIZON_COUNT], row[at.LENGTH], row[at.Q] = slots, count, length, numbers
