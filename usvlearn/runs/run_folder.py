"""A run's folder: saves checkpoints and predictions during a replay, resumes from them, and is judged at its end."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import usvlearn
from usvlearn.core.checkpoint import SUFFIX, checkpoints, restore, write_atomically
from usvlearn.core.checkpoint import save as save_checkpoint
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.core.unconfirmed import SECTION, open_questions
from usvlearn.engine import select_element
from usvlearn.engine.rollouts import stack
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.planar.layer import Planar, PlanarState
from usvlearn.estimators.planar.state import AXES
from usvlearn.evaluation.comparison import as_csv, one_step_sums, run_errors
from usvlearn.evaluation.diagnostics import Truth, as_results, events, identified_boats, verdicts
from usvlearn.evaluation.free_simulation import FreeErrors, free_errors, has_halves, middle
from usvlearn.evaluation.horizons import ensemble_sums, horizon_scores, track_scores
from usvlearn.evaluation.metrics import fleet_scores
from usvlearn.evaluation.objective import measure_of
from usvlearn.runs.files import (
    CHECKPOINTS,
    ERRORS,
    ESTIMATOR,
    ESTIMATOR_BESIDE,
    PLANAR,
    RESULTS,
    RUNS,
    check_own,
    digest,
    ensemble_digest,
    no_run,
    number,
    own_predictions,
    same_run,
    save_results,
)
from usvlearn.runs.prediction_files import BEGIN, PREDICTIONS, Position, Published, joined, packed, position, stem
from usvlearn.runs.replay import Chunk
from usvlearn.runs.resuming import Resumption, Start, checkpoint_path, of_boat, own_settings

KEPT = 2  # checkpoints with sway and yaw rate, of each boat


class Unsaved(NamedTuple):
    """A checkpoint that is to be written."""

    path: Path
    state: Any  # a tree of arrays, a copy
    facts: dict[str, Any]


class RunFolder:
    """Saves a replay while it runs, and finds where to resume. As a context manager, it waits until all is written.

    Every checkpoint contains the configuration, JSON values, and its boat's setup; `data_check` goes into
    `results.json`.
    """

    def __init__(
        self, path: str | Path, fleet: Fleet, ensemble: Ensemble, configuration: Mapping[str, Any],
        planar: Planar | None = None, data_check: Sequence[Mapping[str, str]] | None = None,
        setups: Mapping[str, Any] | None = None,
    ):  # fmt: skip
        self.path, self.fleet, self.ensemble, self.planar = Path(path), fleet, ensemble, planar
        self._resumption = Resumption(self.path, fleet, ensemble, planar)
        self.beside: PlanarState | None = None  # of sway and yaw rate, from `begin` on; None: a fresh start
        self._checked = {} if data_check is None else {"data_check": data_check}
        self._configuration, self._setups = configuration, setups or {}
        self._pending: list[dict[str, np.ndarray]] = []  # those since the last save
        self._saved = self._reached = BEGIN
        self._writer = ThreadPoolExecutor(1)
        self._writing: Future[None] | None = None  # at most one place at a time
        self.state: EnsembleState  # the newest, from `begin` on; leaves (boats, ...)

    @property
    def published(self) -> Published:
        """What was published up to the last save, including earlier sessions."""
        self._wait()
        return self._resumption.published(self.path)

    def begin(self, state: EnsembleState, resume: str | None) -> Start:
        """Where to start: from `state`, or from what `resume` ("latest", a run's folder or a checkpoint) names.

        With unchanged samples and ensemble, a folder continues bit for bit from where it stopped. Otherwise learning
        starts from its newest checkpoints, in another folder. A ConfigError if this run would mix its files with
        others'.
        """
        check_own(self.path)
        start, continued, source = Start(state, BEGIN, "learning from the start"), False, None
        if resume is not None:
            source = self._resumption.latest() if resume == "latest" else Path(str(resume))
            if source.is_file():
                start = self._resumption.from_file(source, start)
            elif source.is_dir():
                continued = same_run(source, self._runs)
                if not continued and source.resolve() == self.path.resolve():
                    raise ConfigError(
                        f"{source}: holds a run over other samples or with another ensemble: to start from its "
                        f"parameters, give resume={source} and another hydra.run.dir{own_settings(source)}"
                    )
                start = start if continued else self._resumption.from_newest(source, start)
            else:
                raise CheckpointError(f"resume: {source} does not exist: give a run's folder, a checkpoint or latest")
        if _has_checkpoints(self.path) and not (continued and source and source.resolve() == self.path.resolve()):
            raise ConfigError(
                f"{self.path}: already holds the checkpoints of a run: continue from them with resume=latest, "
                "or choose another hydra.run.dir"
            )
        predictions = own_predictions(self.path)
        if foreign := [path for path in self._resumption.published(self.path).paths() if path not in predictions]:
            raise no_run(foreign[0])
        if continued and source:
            start = self._resumption.continued(source, start)
        self._saved = self._reached = start.position
        self.state = start.state
        self.beside, anew = self._resumption.planar(source, start.position, continued)
        if source is not None and not continued:  # saved in case the run stops before its first checkpoint
            for first in self._due([BEGIN] * len(self.fleet.boats)):
                save_checkpoint(first.path, first.state, **first.facts)
        self._forget(predictions, start.position)
        others = [*self.path.parent.glob("*"), *([] if source is None else [source])]
        began = 1 + max(map(number, others), default=0)
        noted = self._runs | {"began": {"number": began, "time": time.strftime("%FT%TZ", time.gmtime(time.time()))}}
        write_atomically(self.path / RUNS, json.dumps(noted, indent=2).encode())
        return start._replace(anew=anew)

    def save(self, chunk: Chunk) -> None:
        """Write what is due after a chunk."""
        self.state, self._reached, self.beside = chunk.state, chunk.end, chunk.planar
        self._pending.append(chunk.published)
        if chunk.save:
            self._hand_on()

    def _hand_on(self) -> None:
        """Start to write the pending predictions and every boat's checkpoint."""
        self._wait()
        index, step = self._reached
        run, before = self.fleet.runs[index], self._saved.step if self._saved.run == index else 0
        due = self._due([Position(index, min(step, length)) if length > before else None for length in run.lengths])
        self._writing = self._writer.submit(self._write, self._reached, self._pending, due)
        self._pending, self._saved = [], self._reached

    def _due(self, places: Sequence[Position | None]) -> list[Unsaved]:
        """The checkpoints of the boats at their places; None: there is nothing new."""
        makers = [self._checkpoint] + ([self._planar_checkpoint] if self.beside is not None else [])
        boats = list(enumerate(zip(self.fleet.boats, places, strict=True)))
        return [make(element, boat, at) for make in makers for element, (boat, at) in boats if at is not None]

    def _write(self, place: Position, published: Sequence[Mapping[str, np.ndarray]], due: Sequence[Unsaved]) -> None:
        """Write the checkpoints and predictions of one place, in a thread, while the replay continues.

        The predictions are last: a run resumes from the newest place that has them, where all files are whole then.
        """
        run = self.fleet.runs[place.run]
        content = packed(joined(published), run, place.step, self.fleet.boats, self.ensemble, self.planar)
        for each in due:
            save_checkpoint(each.path, each.state, **each.facts)
        for boat in self.fleet.boats if self.planar is not None else ():
            _forget_older(self.path / PLANAR / CHECKPOINTS / boat)
        folder = self.path / PREDICTIONS
        folder.mkdir(exist_ok=True)
        write_atomically(folder / f"{stem(place)}.npz", content)

    def _wait(self) -> None:
        """Wait for the thread that writes, and raise its error, if any."""
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self._wait()

    def finish(self, began: float, truth: Truth | None = None) -> dict[str, Any]:
        """Score all predictions, and write `errors.csv` and `results.json`; returns the content of the latter."""
        content, errors = self._judged(began, truth or {})
        write_atomically(self.path / ERRORS, errors.encode())
        save_results(self.path, content)
        return content

    def stop(self, began: float) -> None:
        """Save a replay that ends early, so that it can resume; its results so far are marked as partial."""
        if self._pending:
            self._hand_on()
        steps = {"steps": self.fleet.steps_before(*self._reached), "of": self.fleet.steps}
        save_results(self.path, {"partial": {**steps, **self._judged(began, {})[0]}})

    def _judged(self, began: float, truth: Truth) -> tuple[dict[str, Any], str]:
        """The content of `results.json` and of `errors.csv`."""
        ensemble, fleet, published = self.ensemble, self.fleet, self.published
        names, limit = ensemble.names, ensemble.surge_limit
        model, state = (ensemble, self.state) if self.beside is None else (self.planar or ensemble, self.beside)
        boats = identified_boats(model, state, fleet.boats)
        content: dict[str, Any] = {
            "boats": fleet_scores(fleet, published.only("predictions", "halfwidths"), names, limit),
            "events": events(fleet, published.only("thrusters", "health"), ensemble.accommodated),
            "rejected": fleet.rejected,
            **as_results(boats, truth),
        }
        if (ahead := ensemble_sums(ensemble, fleet, published.only("forecasts", "forecast_halfwidths"))) is not None:
            content["forecast"] = horizon_scores(ahead, fleet.boats)
        if self.planar is not None:
            stretches = (stretch.arrays for stretch in published.only("predictions", "tracks"))
            parts = (arrays["tracks"] for arrays in stretches if "tracks" in arrays)
            content["tracks"] = track_scores(parts, self.planar.horizons, fleet.boats)
        if (free := self._free()) is not None:
            content["free"] = free.mae(fleet.boats, names)
            content["free_fit"] = free.fit(fleet.boats, names)
        if networks := verdicts(ensemble, self.state, fleet.boats):
            content["network"] = {
                boat: {name: each.json() for name, each in members.items()} for boat, members in networks.items()
            }
        measure = measure_of(self._configuration.get("objective"), ensemble.output)
        content |= {"output": ensemble.output, "measure": str(measure), "objective": measure.value(content)}
        one_step = one_step_sums(fleet, published.only("predictions"), len(names), limit)
        errors = as_csv(run_errors(fleet, names, one_step, ahead, free), names)
        asked = [{"key": key, **each} for key, each in open_questions(self._configuration).items()]
        return content | self._checked | {SECTION: asked, "seconds": time.perf_counter() - began}, errors

    def _free(self) -> FreeErrors | None:
        """Errors of open-loop simulations of the boats that have runs in both halves; None if there are none."""
        first = middle(self.fleet.runs)
        elements = [has_halves(self.fleet, element) for element in range(len(self.fleet.boats))]
        if not any(elements) or (state := self._after(first)) is None:
            return None
        errors = free_errors(self.ensemble, state, self.fleet, first)
        errors.steps[:, [not each for each in elements]] = 0
        return errors

    def _after(self, runs: int) -> EnsembleState | None:
        """The state of every boat after the first `runs` runs, from its checkpoints; None if they are not done.

        A boat that has no run among them keeps its newest state.
        """
        if self._reached.run < runs and self._reached != Position(runs - 1, len(self.fleet.runs[runs - 1].time)):
            return None
        elements = []
        for element, boat in enumerate(self.fleet.boats):
            paths = [
                path
                for path in checkpoints(self.path / CHECKPOINTS / boat)
                if (place := position(path)) is not None and place.run < runs and place.step
            ]
            now = of_boat(self.state, element)
            elements.append(restore(paths[-1], now, ESTIMATOR)[0] if paths else now)
        return stack(elements)

    def _checkpoint(self, element: int, boat: str, place: Position) -> Unsaved:
        run = self.fleet.runs[place.run]
        facts = {
            "estimator": ESTIMATOR, "boat": boat, "run": run.names[element], "step": place.step,
            "time": float(run.time[place.step - 1, element]) if place.step else 0.0,
            "version": usvlearn.__version__, "configuration": self._configuration,
            "kernel": select_element(self.ensemble.description(), len(self.fleet.boats), element),
        }  # fmt: skip
        if boat in self._setups:
            facts["setup"] = self._setups[boat]
        return Unsaved(checkpoint_path(self.path, boat, place), _copied(self.state, element), facts)

    def _planar_checkpoint(self, element: int, boat: str, place: Position) -> Unsaved:
        """As `_checkpoint`, of all axes and the tracks."""
        assert self.planar is not None and self.beside is not None
        kernel = self.planar.description()
        kernel |= {axis: select_element(kernel[axis], len(self.fleet.boats), element) for axis in AXES}
        facts = self._checkpoint(element, boat, place).facts | {"estimator": ESTIMATOR_BESIDE, "kernel": kernel}
        return Unsaved(checkpoint_path(self.path / PLANAR, boat, place), _copied(self.beside, element), facts)

    @cached_property
    def _runs(self) -> dict[str, Any]:
        """The content of this run's `runs.json`."""
        boats = {
            boat: [[run.names[element], run.lengths[element], digest(run, element)] for run in self.fleet.runs]
            for element, boat in enumerate(self.fleet.boats)
        }
        return {"boats": boats, "ensemble": ensemble_digest(self._configuration)}

    def _forget(self, predictions: Sequence[Path], place: Position) -> None:
        """Remove this run's results, its fit if logs come, and its own predictions after `place`, the last first."""
        self.path.mkdir(parents=True, exist_ok=True)
        more = self.fleet.steps_before(*place) < self.fleet.steps
        fits = [*self.path.glob("fit/*.fit.json"), *self.path.glob(f"fit/{CHECKPOINTS}/*/fit{SUFFIX}")] if more else []
        for path in [self.path / RESULTS, self.path / ERRORS, *fits]:
            path.unlink(missing_ok=True)
        for old in reversed(predictions):
            if (at := position(old)) is not None and at > place:
                old.unlink()


def _copied(state: Any, element: int) -> Any:
    """The state of one boat, as arrays that the replay does not change."""
    return tree_map(lambda leaf: leaf[element].detach().numpy().copy(), state)


def _forget_older(folder: Path) -> None:
    """Remove all but the newest checkpoints of a folder, and the last of the run before, which has not learned theirs.

    They hold the ensemble's state, too, so that `Online.open(RUN/planar)` forecasts tracks.
    """
    placed = [(path, at) for path in checkpoints(folder) if (at := position(path)) is not None]
    before = [path for path, at in placed if at.run < placed[-1][1].run]
    for old, _ in placed[:-KEPT]:
        if old not in before[-1:]:
            old.unlink(missing_ok=True)


def _has_checkpoints(folder: Path) -> bool:
    """Whether a folder contains checkpoints that must be kept, besides those from which a run was to start."""
    saved = [position(path) for path in (folder / CHECKPOINTS).glob(f"*/*{SUFFIX}")]
    return any(at is None or at > BEGIN for at in saved) or (bool(saved) and (folder / RUNS).exists())
