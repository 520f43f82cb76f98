"""What batch peers share: how they run free and forecast, on which steps they are judged, how a setting is chosen.

A batch peer is a module with `fit(runs, top) -> Fitted`. It is told all runs to learn from at once, and chooses its
settings on the last 20 % of them. Runs are `Sample`s of NumPy arrays `(time,)`, on a grid of 0.4 s; `top` is the top
speed of the boat, m/s, as a user states it. A fitted model has

    free_run(run)              speeds (time,), m/s, from the inputs and the speeds with which segments start
    forecast(run, horizons)    (origins, horizons), m/s, of the steps that `targets` names, NaN where that is none; told
                               the speeds that were measured up to the origin, and the inputs up to the target
"""

from __future__ import annotations

import importlib.util
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import Sample, masks, tree_map

HORIZONS = (1, 3, 5, 13, 25, 75)  # steps of 0.4 s
EVERY = 5  # steps from origin to origin
LATE = 0.2  # share of the runs to learn from that settings are chosen on
HIGHEST = 10.0  # m/s, bound of every prediction, as of the library's own estimators
WARM, FREE = 10, 75  # steps of a training window: told the measured speeds, then free
MOST, STRIDE = 600, 10  # windows, about; least steps from one to the next


class Fitted(NamedTuple):
    """A peer's model of a boat."""

    model: Any
    setting: str  # that was chosen
    seconds: float  # of the processor, for all training


class Targets(NamedTuple):
    """What the forecasts of a run are compared with."""

    origins: np.ndarray  # (origins,) rows with a measured speed
    rows: np.ndarray  # (origins, horizons) row of each target, at most the last of the run
    reached: np.ndarray  # (origins, horizons) bool: a step is made in each row from the origin to the target
    scored: np.ndarray  # (origins, horizons) bool: and the target's speed is measured


def targets(run: Sample, horizons: Sequence[int] = HORIZONS) -> Targets:
    """Origins are every fifth row, where its speed is measured; a forecast does not cross the start of a segment."""
    use, count = masks(run), len(run.surge)
    origins = np.flatnonzero((use.learns | use.starts) & (np.arange(count) % EVERY == 0))
    rows = origins[:, None] + np.asarray(horizons)
    inside, rows = rows < count, rows.clip(max=count - 1)
    steps = np.cumsum(use.steps)
    reached = inside & (steps[rows] - steps[origins][:, None] == np.asarray(horizons))
    return Targets(origins, rows, reached, reached & use.learns[rows])


def features(run: Sample, heading: bool) -> np.ndarray:
    """Both commands, the yaw rate, and cos and sin of the heading if asked for, `(time, 3 or 5)`."""
    x = run.inputs
    columns = [x.command_left, x.command_right, x.yaw_rate]
    if heading:
        columns += [np.cos(x.heading), np.sin(x.heading)]
    return np.nan_to_num(np.stack(columns, -1).astype(float))


class Stepper(ABC):
    """A model that makes one step of many batch elements; its state is an array `(elements, n)`."""

    heading: bool  # the inputs have the heading

    @abstractmethod
    def begin(self, speeds: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """The state at the start of a segment, from speeds `(elements,)`, m/s, and inputs `(elements, n)`."""

    @abstractmethod
    def step(self, state: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The state and the speeds `(elements,)`, m/s, one step later; the inputs are those of the step."""

    @abstractmethod
    def correct(self, state: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """The state that is told what was measured after the step."""

    def free_run(self, run: Sample) -> np.ndarray:
        return self._follow(run, told=False)[0]

    def forecast(self, run: Sample, horizons: Sequence[int] = HORIZONS) -> np.ndarray:
        x, aim = features(run, self.heading), targets(run, horizons)
        state = self._follow(run, told=True)[1][aim.origins]
        forecasts = np.full(aim.rows.shape, np.nan)
        for ahead in range(1, max(horizons) + 1):
            state, speeds = self.step(state, x[(aim.origins + ahead).clip(max=len(x) - 1)])
            if ahead in horizons:
                forecasts[:, horizons.index(ahead)] = speeds
        return np.where(aim.reached, forecasts, np.nan)

    def _follow(self, run: Sample, told: bool) -> tuple[np.ndarray, np.ndarray]:
        """Speeds `(time,)` and states `(time, n)` along a run."""
        use, x = masks(run), features(run, self.heading)
        speed, state = np.zeros(1), self.begin(np.zeros(1), x[:1])
        speeds, states = np.empty(len(x)), np.empty((len(x), state.shape[-1]))
        for k in range(len(x)):
            if use.starts[k]:
                speed = run.surge[k : k + 1]
                state = self.begin(speed, x[k : k + 1])
            elif use.steps[k]:
                state, speed = self.step(state, x[k : k + 1])
                if told and use.learns[k]:
                    state = self.correct(state, run.surge[k : k + 1])
            speeds[k], states[k] = speed[0], state[0]
        return speeds, states


class Windows(NamedTuple):
    """Stretches of runs as batch elements; rows after the end of a stretch are not scored."""

    inputs: np.ndarray  # (time, elements, n) of each step
    first: np.ndarray  # (elements,) m/s, measured before the first step
    speeds: np.ndarray  # (time, elements) m/s, measured after each step; 0 where there was none
    told: np.ndarray  # (time, elements) bool: the model is told the speed after the step
    scored: np.ndarray  # (time, elements) bool: the model has to predict it


def windows(runs: Sequence[Sample], heading: bool) -> Windows:
    """Overlapping stretches of `WARM + FREE` steps or less; every second one is free from its first step on."""
    pieces, stride = [], max(STRIDE, sum(len(run.surge) for run in runs) // MOST)
    for run in runs:
        use, x = masks(run), features(run, heading)
        usable = use.learns | use.starts
        for begin, end in stretches(use.steps, use.starts):
            for first in range(begin, end - 1, stride):
                if usable[first]:
                    rows = np.arange(first + 1, min(end, first + 1 + WARM + FREE))
                    warm = WARM if len(pieces) % 2 and len(rows) > WARM else 0
                    learned, ahead = use.learns[rows], np.arange(len(rows)) >= warm
                    speeds = np.where(learned, run.surge[rows], 0.0)
                    pieces.append((x[rows], run.surge[first], speeds, learned & ~ahead, learned & ahead))
    padded = [np.zeros((WARM + FREE, len(pieces), *np.shape(part)[1:]), part.dtype) for part in pieces[0] if part.ndim]
    for element, (x, _, *rest) in enumerate(pieces):
        for whole, part in zip(padded, (x, *rest), strict=True):
            whole[: len(part), element] = part
    inputs, *rest = padded
    return Windows(inputs, np.array([one[1] for one in pieces]), *rest)


def stretches(steps: np.ndarray, starts: np.ndarray) -> list[tuple[int, int]]:
    """First row and the row after the last one of all stretches in which every row but the first makes a step."""
    begins = np.flatnonzero(starts | (steps & ~np.append(False, (steps | starts)[:-1])))
    broken = np.append(np.flatnonzero(~steps), len(steps))
    return [(int(k), int(broken[np.searchsorted(broken, k, "right")])) for k in begins]


def cut(runs: Sequence[Sample], share: float) -> tuple[list[Sample], list[Sample]]:
    """The runs before and after a share of all rows; the run that is cut begins a segment there."""
    left, before, after = round(share * sum(len(run.surge) for run in runs)), [], []
    for run in runs:
        place = min(max(left, 0), len(run.surge))
        left -= len(run.surge)
        if place:
            before.append(tree_map(lambda x, n=place: x[:n], run))
        if place < len(run.surge):
            rest = tree_map(lambda x, n=place: x[n:].copy(), run)
            rest.inputs.dt[0] = 0.0
            after.append(rest)
    return before, after


def errors(
    runs: Sequence[Sample], forecasts: Sequence[np.ndarray], horizons: Sequence[int] = HORIZONS
) -> dict[int, tuple[float, float]]:
    """MAE of the forecasts of each run, and of persistence from the same origins, m/s, by horizon.

    Both are NaN where no forecast of that horizon has a target.
    """
    wrong: dict[int, list[np.ndarray]] = {h: [] for h in horizons}
    for run, predicted in zip(runs, forecasts, strict=True):
        aim = targets(run, horizons)
        truth, held = run.surge[aim.rows], run.surge[aim.origins][:, None]
        pairs = np.stack(np.broadcast_arrays(bounded(predicted - truth), abs(held - truth)), -1)
        for k, h in enumerate(horizons):
            wrong[h].append(pairs[aim.scored[:, k], k])
    every = {h: np.concatenate(parts) for h, parts in wrong.items()}
    return {h: tuple(pairs.mean(0).tolist()) if len(pairs) else (math.nan, math.nan) for h, pairs in every.items()}


def free_run_errors(model: Any, runs: Sequence[Sample]) -> tuple[float, float]:
    """MAE of the open-loop simulation, and of holding the speed with which each segment starts, m/s."""
    wrong = []
    for run in runs:
        use, held = masks(run), Held().free_run(run)
        wrong.append(np.stack([bounded(model.free_run(run) - run.surge), abs(held - run.surge)], -1)[use.learns])
    return tuple(np.concatenate(wrong).mean(0).tolist())


class Held:
    """Persistence: the speed with which a segment starts, or that of the origin."""

    def free_run(self, run: Sample) -> np.ndarray:
        begun = np.maximum.accumulate(np.where(masks(run).starts, np.arange(len(run.surge)), -1))
        return np.where(begun >= 0, run.surge[begun], 0.0)

    def forecast(self, run: Sample, horizons: Sequence[int] = HORIZONS) -> np.ndarray:
        aim = targets(run, horizons)
        return np.where(aim.reached, run.surge[aim.origins][:, None], np.nan)


def bounded(wrong: np.ndarray) -> np.ndarray:
    """Absolute errors; one that is not finite or above the bound counts as the bound."""
    return np.nan_to_num(np.abs(wrong), nan=HIGHEST, posinf=HIGHEST).clip(max=HIGHEST)


def judged(model: Any, runs: Sequence[Sample]) -> float:
    """MAE over that of persistence, mean over the horizons and the open-loop simulation."""
    scores = errors(runs, [model.forecast(run) for run in runs])
    pairs = [*scores.values(), free_run_errors(model, runs)]
    return float(np.nanmean([mae / held if held > 0 else math.nan for mae, held in pairs]))


def choose(settings: Mapping[str, Callable[[Sequence[Sample]], Any]], runs: Sequence[Sample]) -> Fitted:
    """Fit each setting to the first 80 % of the runs, judge it on the rest, and fit the best one to all runs."""
    began = time.process_time()
    early, late = cut(runs, 1 - LATE)
    scores = {name: judged(make(early), late) for name, make in settings.items()} if len(settings) > 1 else {}
    best = min(scores or settings, key=lambda name: scores.get(name, 0.0))
    return Fitted(settings[best](runs), best, time.process_time() - began)


def need(module: str, package: str) -> None:
    """Raise unless a peer's library can be imported."""
    if importlib.util.find_spec(module) is None:
        raise ModuleNotFoundError(f"{package} is not installed: pip install 'usvlearn[bench]'")
