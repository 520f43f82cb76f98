"""Shows a replay in TensorBoard while it runs, at a bounded cost."""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from usvlearn.core.samples import Fleet, Run, masks, tree_map
from usvlearn.display.activity import doing
from usvlearn.display.event_file import TensorBoardWriter, folder_name, folder_names
from usvlearn.display.figures import attempted
from usvlearn.engine.rollouts import stack
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.joint.reading import Identified
from usvlearn.evaluation.horizons import LEAST
from usvlearn.evaluation.identification import Truth, identified_boats
from usvlearn.evaluation.metrics import PERSISTENCE
from usvlearn.runs.published import BEGIN, Position, Published
from usvlearn.runs.replay import Chunk
from usvlearn.runs.tensorboard import board_tags
from usvlearn.runs.tensorboard.drawing import Replayed, figures
from usvlearn.runs.tensorboard.track_curves import TrackCurves, result_scalars

WINDOW = 750  # steps over which errors are averaged
STEPS_PER_POINT = 100  # and boat: one point of all curves costs about as much as 100 compiled steps
MOST_POINTS = 200  # of a curve
MOST_IDENTIFIED, IDENTIFIED = 60, 300  # points of a curve of what is identified, and least s between two: a point
# costs a millisecond a boat
FAR = 4.0  # times the value: ends of intervals beyond it would hide everything else in a chart
BATCH = 32  # points that are written together: monitoring many states costs little more than monitoring one
PATIENCE = 2.0  # s, after which fewer points are written
LOGS = MAIN, ALL = "main", "all"


class Point(NamedTuple):
    """What is drawn of one moment."""

    clock: np.ndarray  # (boats,) s of run time
    numbers: np.ndarray  # (boats, errors and shares)
    state: EnsembleState


class TensorBoardLogger:
    """Draws a replay's chunks in TensorBoard; `usvlearn.display.event_file` lists the runs and tags.

    Args:
        folder: of the TensorBoard files.
        fleet: the runs that are replayed.
        ensemble: the estimators that learn.
        begin: the place from which it is replayed.
        differs: the settings in which the run differs from the default, by key.
        truth: quantities of simulated boats.
        log: "main", or "all" for every number and figure.
        texts: Markdown by title, for the TEXT page.
        alone: whether it is a run of its own, not a job of a sweep, whose page compares the jobs. A job has no row on
            the HPARAMS page, and figures only with `log: all`.

    Raises:
        ConfigError: `log` is something else.
    """

    def __init__(
        self,
        folder: str | Path,
        fleet: Fleet,
        ensemble: Ensemble,
        begin: Position = BEGIN,
        differs: Mapping[str, str] | None = None,
        truth: Truth | None = None,
        log: str = MAIN,
        texts: Mapping[str, str] | None = None,
        alone: bool = True,
        tracks: Sequence[float] = (),
    ):
        check_log(log)
        self.fleet, self.ensemble, self.truth, self.everything = fleet, ensemble, truth or {}, log == ALL
        self.alone = alone
        self.every = max(STEPS_PER_POINT * len(fleet.boats), -(-fleet.steps // MOST_POINTS))  # steps between points
        self.seasons: list[tuple[np.ndarray, dict[str, Identified]]] = []  # clock, and what was identified then
        self.before_last: EnsembleState | None = None  # the state before the last run
        self.clocks = _clocks(fleet)
        self._points: list[Point] = []
        self._written, self._steps = time.monotonic(), 0  # steps since the last point
        self._errors: deque[tuple[int, np.ndarray]] = deque()  # per chunk: steps, sums (boats, …) as of `_sums`; covers
        # at least the last WINDOW steps
        self._counts = self._counted(begin)
        made = ensemble.forecasts
        horizons = [] if made is None else made.horizons.tolist()
        self._near = board_tags.shown_horizon(horizons)
        self.horizon = horizons[self._near] if horizons else None
        self.far = () if made is None else (*made.columns[:-1], ensemble.output)  # the columns of forecasts
        self._tracks = TrackCurves(tracks, ensemble.output, ensemble.names)
        self._last = np.full(len(fleet.boats), -1 if begin == BEGIN else 0) + self._clock(begin)
        self._plan: list[tuple[str, tuple[str, ...], np.ndarray]] = []  # run of a boat, tags, columns of numbers
        self.folders = dict(zip(fleet.boats, folder_names(fleet.boats), strict=True))
        self._names = dict(zip(ensemble.names, folder_names(ensemble.names), strict=True))
        self.fleet_run, self.results_run = (
            next(free for k in range(9) if (free := name + "_" * k) not in self.folders.values())
            for name in (board_tags.FLEET, board_tags.RESULTS)
        )
        runs = self._runs()
        first = {self.folders[boat]: int(clock) + 1 for boat, clock in zip(fleet.boats, self._last, strict=True)}
        first |= {self.fleet_run: max(first.values()), self.results_run: 0}
        marks = {run: first[run.partition("/")[0]] for run in runs}  # earlier files may hold points from there on
        self.differs = differs or {}
        where = Path(folder) / folder_name(board_tags.label(self.differs)) if self.differs else Path(folder)
        self.board = TensorBoardWriter(where, runs, marks, board_tags.about)
        for title, text in {**(texts or {}), "data": _data(fleet)}.items():
            self.board.text(f"run/{title}", text, run=self.results_run)

    def _runs(self) -> list[str]:
        """All runs, in the order of their colours."""
        own, every = list(self._names.values()), {}
        for boat, folder in self.folders.items():
            read = [board_tags.LOW, board_tags.IDENTIFIED, board_tags.HIGH] if self.ensemble.averaged else []
            every[folder] = [*own, *read, *([board_tags.TRUTH] if read and boat in self.truth else [])]
        if len(self.folders) > 1:
            every[self.fleet_run] = own
        return [*board_tags.in_order(every), self.results_run]

    def __enter__(self) -> TensorBoardLogger:
        return self

    def __exit__(self, *_: object) -> None:
        self._write()
        self.board.close()

    def show(self, chunk: Chunk) -> None:
        """Add one point to every curve, unless the last one is near; it is written within PATIENCE or BATCH points."""
        part = slice(chunk.begin.step, chunk.end.step)
        run = self.fleet.runs[chunk.end.run]
        samples = tree_map(lambda x: x[part], run.samples)
        surge = np.where(masks(samples, self.ensemble.surge_limit).learns, samples.surge, np.nan)
        tracks = self._tracks.sums(chunk.published, len(self.fleet.boats))
        self._errors.append((len(surge), np.concatenate([tracks, self._sums(chunk.published, surge)], -1)))
        while sum(steps for steps, _ in self._errors) - self._errors[0][0] >= WINDOW:
            self._errors.popleft()
        self._counts = self._counts + _count(run, part)
        self._steps += len(surge)
        last = len(self.fleet.runs) - 1
        if chunk.end == Position(last - 1, len(self.fleet.runs[last - 1].time)):
            self.before_last = chunk.state
        if 2 * self._steps < self.every and chunk.end != Position(last, len(self.fleet.runs[last].time)):
            return
        self._steps = 0
        shares = self._counts[:, 1:] / np.maximum(self._counts[:, :1], 1)
        tracks, sums = np.split(np.sum([sums for _, sums in self._errors], axis=0), [self._tracks.width], -1)
        numbers = np.concatenate([self._numbers(sums), self._tracks.numbers(tracks), shares], -1)
        self._points.append(Point(self._clock(chunk.end), numbers, chunk.state))
        if len(self._points) == BATCH or time.monotonic() - self._written > PATIENCE:
            self._write()

    def _sums(self, published: Mapping[str, np.ndarray], surge: np.ndarray) -> np.ndarray:
        """Per boat and estimator Σ |error| and count, those in their interval, and how many had one; then of the
        forecasts Σ |error| by column, count, those in their interval, and how many had one; `(boats, …)`.
        """
        errors = np.abs(published["predictions"] - surge[..., None])
        seen, widths = np.isfinite(errors), published["halfwidths"]
        known = seen & np.isfinite(widths)
        inside = known & (errors <= widths)
        parts = [np.where(seen, errors, 0.0).sum(0), *(np.count_nonzero(x, 0) for x in (seen, inside, known))]
        if self.far and "forecasts" in published:
            made = published["forecasts"].reshape(*surge.shape, -1, len(self.far))[:, :, self._near]
            due = np.isfinite(made[..., -1:]) & np.isfinite(surge)[..., None]
            errors, widths = np.abs(made - surge[..., None]), published["forecast_halfwidths"][..., [self._near]]
            known = due & np.isfinite(widths)
            inside = known & (errors[..., -1:] <= widths)
            parts += [np.where(due, errors, 0.0).sum(0), *(np.count_nonzero(x, 0) for x in (due, inside, known))]
        return np.concatenate(parts, -1)

    def _numbers(self, sums: np.ndarray) -> np.ndarray:
        """MAE, skill and share in the interval of each estimator, and the same over the horizon, `(boats, …)`."""
        m, names = len(self.ensemble.names), self.ensemble.names
        with np.errstate(invalid="ignore", divide="ignore"):
            total, count, inside, known = (sums[:, k * m : (k + 1) * m] for k in range(4))
            mae = total / count
            found = [mae, _skill(mae, names), inside / known]
            if self.far:
                total, (count, inside, known) = sums[:, 4 * m : -3], (sums[:, [k]] for k in (-3, -2, -1))
                mae = np.where(count >= LEAST, total / count, np.nan)
                found += [mae, _skill(mae, self.far), np.where(known >= LEAST, inside / known, np.nan)]
        return np.concatenate(found, -1)

    def _places(self, found: Sequence[str]) -> list[tuple[str, str]]:
        """The run and tag of each number: of `_numbers`, of `_counts`, of what the ensemble monitors."""
        names, output = self.ensemble.names, self.ensemble.output
        places = [(name, f"1 overview/{tag}") for tag in (board_tags.MAE, board_tags.SKILL) for name in names]
        groups = ("1 overview" if name == output else "9 all" for name in names)
        places += [(name, f"{group}/{board_tags.INSIDE}") for name, group in zip(names, groups, strict=True)]
        if self.horizon is not None:
            mae, skill, inside = (f"1 overview/{tag}" for tag in board_tags.ahead(self.horizon).values())
            places += [(name, tag) for tag in (mae, skill) for name in self.far] + [(output, inside)]
        places += self._tracks.places
        places += [(output, f"5 data/{title} (share)") for title in ("measured speed", "stale inputs")]
        return places + [board_tags.place(key, output, self.horizon) for key in found]

    def _write(self) -> None:
        """Write the pending points of all boats."""
        if self._points:
            with torch.no_grad():
                found = self.ensemble.monitor(stack([point.state for point in self._points]))
                found |= _least_excitation(found)
                states = torch.stack([x.double() for x in found.values()], -1).numpy()  # points, boats, numbers
            numbers = np.concatenate([np.stack([point.numbers for point in self._points]), states], -1)
            self._plan = self._plan or self._planned(self._places(list(found)))
            for point, rows in zip(self._points, numbers, strict=True):
                self._write_point(point, rows)
        self._points.clear()
        self._written = time.monotonic()

    def _planned(self, places: Sequence[tuple[str, str]]) -> list[tuple[str, tuple[str, ...], np.ndarray]]:
        chosen: dict[str, dict[str, int]] = {}
        for column, (name, tag) in enumerate(places):
            if self.everything or not tag.startswith("9 all/"):
                chosen.setdefault(self._names.get(name) or folder_name(name), {})[tag] = column
        return [(run, tuple(tags), np.array(list(tags.values()))) for run, tags in chosen.items()]

    def _write_point(self, point: Point, rows: np.ndarray) -> None:
        later = point.clock > self._last
        if self.ensemble.averaged is not None and self._due(point):
            self._show_identified(point, later)
        for element, folder in enumerate(self.folders.values()):
            if later[element]:
                for run, tags, columns in self._plan:
                    self._scalars(f"{folder}/{run}", tags, rows[element, columns], int(point.clock[element]))
        if len(self.folders) > 1 and later.any():
            for run, tags, columns in self._plan:
                own = [k for k, tag in enumerate(tags) if tag.startswith("1 ")]
                chosen = rows[:, columns[own]]
                with np.errstate(invalid="ignore"):
                    mean = np.nansum(chosen, 0) / np.isfinite(chosen).sum(0)
                self._scalars(f"{self.fleet_run}/{run}", tuple(tags[k] for k in own), mean, int(point.clock.max()))
        self._last = np.maximum(self._last, point.clock)

    def _scalars(self, run: str, tags: Sequence[str], values: np.ndarray, step: int) -> None:
        """Write those that are numbers."""
        row = {tag: x for tag, x in zip(tags, values.tolist(), strict=True) if x - x == 0}
        if row:
            self.board.scalars(row, step, run)

    def _due(self, point: Point) -> bool:
        """Whether it is time for another point of what is identified."""
        apart = max(self.clocks[-1].max() / MOST_IDENTIFIED, IDENTIFIED)
        return not self.seasons or bool((point.clock - self.seasons[-1][0]).max() >= apart)

    def _show_identified(self, point: Point, later: np.ndarray) -> None:
        """Write one point of every quantity, with the ends of its interval, and the truth."""
        found = identified_boats(self.ensemble, point.state, self.fleet.boats)
        self.seasons.append((point.clock, found))
        for element, (boat, quantities) in enumerate(found.items()):
            tags = {name: board_tags.quantity_tag(name) for name in quantities}
            tags = {name: tag for name, tag in tags.items() if self.everything or not tag.startswith("9 all/")}
            if later[element]:
                known = {board_tags.TRUTH: self.truth.get(boat, {})}
                known[board_tags.IDENTIFIED] = {name: quantities[name].value for name in tags}
                for run, field in ((board_tags.LOW, "low"), (board_tags.HIGH, "high")):
                    ends = {name: (getattr(quantities[name], field), quantities[name].value) for name in tags}
                    known[run] = {name: x for name, (x, value) in ends.items() if abs(x - value) <= FAR * abs(value)}
                for run, values in known.items():
                    row = {tags[name]: x for name, x in values.items() if name in tags}
                    numbers = np.array(list(row.values()), float)
                    self._scalars(f"{self.folders[boat]}/{run}", list(row), numbers, int(point.clock[element]))

    def finish(
        self,
        settings: Mapping[str, Any],
        results: Mapping[str, Any],
        published: Published,
        networks: Sequence[str] = (),
    ) -> None:
        """Write the run's results, the counts of rejected messages, and figures.

        A short run of a large fleet gets figures of its first boats only. Without matplotlib no figure is drawn, and a
        warning is raised.

        Args:
            settings: the run's configuration.
            results: of `results.json`.
            published: of the run.
            networks: what is said of the RNNs, a sentence each.
        """
        self._write()
        ends = dict(zip(self.fleet.boats, self.clocks[-1].tolist(), strict=True))
        output = self._names[self.ensemble.output]
        for boat, channels in self.fleet.rejected.items():
            counts: dict[str, float] = {}
            for cause, count in (each for causes in channels.values() for each in causes.items()):
                tag = f"5 data/rejected, {cause} (messages)"
                counts[tag] = counts.get(tag, 0) + count
            if counts and boat in self.folders:
                self.board.scalars(counts, ends[boat], f"{self.folders[boat]}/{output}")
        for boat, row in result_scalars(results.get("tracks"), self.everything):
            self.board.scalars(row, ends[boat], f"{self.folders[boat]}/{output}")
        if networks:
            self.board.text("run/networks", "\n".join(f"- {sentence}" for sentence in networks), run=self.results_run)
        row = board_tags.results_of(results, self.ensemble.output)
        self.board.scalars({board_tags.result_tag(title): x for title, x in row.items()}, 0, self.results_run)
        if self.alone:
            hours = round(float(self.clocks[-1].sum() / 3600), 2)
            compared = {"boats": len(self.fleet.boats), "hours": hours, **self.differs}
            shown = {key: board_tags.number(value) for key, value in compared.items()}
            self.board.session(shown, self.results_run, results.get("seconds"))
        if self.alone or self.everything:
            self._draw(settings["data"], results["events"], published)

    def _draw(self, data: Mapping[str, Any], events: Mapping[str, Any], published: Published) -> None:
        try:
            replayed = Replayed(
                self.fleet, self.ensemble, self.clocks, self.seasons, self.before_last, self.truth, self.everything
            )
            for figure in figures(replayed, data, events, published):
                doing(f"drawing {figure.tag.partition('/')[2]} of {figure.boat}")
                if (drawn := attempted(figure.draw, f"{figure.tag.partition('/')[2]} of {figure.boat}")) is not None:
                    run = f"{self.folders[figure.boat]}/{self._names[self.ensemble.output]}"
                    self.board.figure(figure.tag, drawn, figure.step, run)
        except MissingExtraError as error:
            warnings.warn(f"no figure of the predictions: {error}", stacklevel=3)

    def _clock(self, place: Position) -> np.ndarray:
        """Whole seconds of run time of each boat at a place, `(boats,)`."""
        run = self.fleet.runs[place.run]
        steps = np.minimum(place.step, run.lengths)
        inside = run.time[np.maximum(steps, 1) - 1, np.arange(len(steps))]
        return self.clocks[place.run] + np.where(steps > 0, np.nan_to_num(inside), 0.0).astype(int)

    def _counted(self, place: Position) -> np.ndarray:
        """Steps, those with a measured speed and those with stale inputs before a place, `(boats, 3)`."""
        runs = [(run, slice(None)) for run in self.fleet.runs[: place.run]]
        counts = [_count(*each) for each in [*runs, (self.fleet.runs[place.run], slice(0, place.step))]]
        return np.sum(counts, axis=0)


def check_log(log: Any) -> None:
    """Raise a ConfigError unless this is one of LOGS.

    >>> check_log("everything")
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: log: found 'everything', expected one of main, all
    """
    if log not in LOGS:
        raise ConfigError(f"log: found {log!r}, expected one of {', '.join(LOGS)}")


def _clocks(fleet: Fleet) -> np.ndarray:
    """Whole seconds of run time before each run, and at the end, `(runs + 1, boats)`; runs never share a second."""
    lengths = [
        [int(run.time[n - 1, element]) + 1 if n else 0 for element, n in enumerate(run.lengths)] for run in fleet.runs
    ]
    return np.concatenate([np.zeros((1, len(fleet.boats)), int), np.cumsum(lengths, axis=0)])


def _count(run: Run, part: slice) -> np.ndarray:
    """Steps, those with a measured speed and those with stale inputs, `(boats, 3)`."""
    inside = np.arange(len(run.time))[part, None] < np.array(run.lengths)
    measured, fresh = run.samples.measured[part], run.samples.fresh[part]
    return np.stack([inside.sum(0), (inside & measured).sum(0), (inside & ~fresh).sum(0)], -1)


def _skill(mae: np.ndarray, names: Sequence[str]) -> np.ndarray:
    if PERSISTENCE not in names:
        return np.full_like(mae, np.nan)
    return 1 - mae / mae[:, [names.index(PERSISTENCE)]]


def _least_excitation(found: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The least of the excitations of each estimator's parameters."""
    own: dict[str, list[torch.Tensor]] = {}
    for key, value in found.items():
        name, _, number = key.partition("/")
        if number.startswith("excitation_"):
            own.setdefault(name, []).append(value)
    return {f"{name}/least_excitation": torch.stack(values).amin(0) for name, values in own.items()}


def _data(fleet: Fleet) -> str:
    """What the logs contain, and what was rejected, as Markdown."""
    rows = ["| boat | runs | hours | steps | measured speed | stale inputs |", "|---|---|---|---|---|---|"]
    counts, clocks = np.sum([_count(run, slice(None)) for run in fleet.runs], axis=0), _clocks(fleet)[-1]
    for element, boat in enumerate(fleet.boats):
        steps, measured, stale = counts[element].tolist()
        runs = sum(run.lengths[element] > 0 for run in fleet.runs)
        rows.append(
            f"| {boat} | {runs} | {clocks[element] / 3600:.2f} | {steps} | {measured / steps:.1%} | "
            f"{stale / steps:.1%} |"
        )
    rows += ["", "| boat | channel | rejected messages, by cause |", "|---|---|---|"]
    for boat, channels in fleet.rejected.items():
        for channel, causes in channels.items():
            rows.append(f"| {boat} | {channel} | {', '.join(f'{cause} {n}' for cause, n in causes.items())} |")
    return "\n".join(rows)
