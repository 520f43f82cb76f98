"""A run's folder: saves checkpoints and predictions during a replay, and resumes from them."""

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
from usvlearn.evaluation.identification import Truth
from usvlearn.runs.file_names import CHECKPOINTS, ERRORS, ESTIMATOR, PREDICTIONS, RESULTS, RUNS, save_results
from usvlearn.runs.index import check_own, digest, ensemble_digest, no_run, number, own_predictions, same_run
from usvlearn.runs.planar_checkpoints import ESTIMATOR as ESTIMATOR_BESIDE
from usvlearn.runs.planar_checkpoints import beside_of, forget, planar_path, started, started_from
from usvlearn.runs.prediction_files import BEGIN, Position, Published, joined, packed, position, stem, widths_of
from usvlearn.runs.replay import Chunk
from usvlearn.runs.results import judged
from usvlearn.runs.resuming import Resumption, Start, checkpoint_path, of_boat, own_settings


class Unsaved(NamedTuple):
    """A checkpoint that is to be written."""

    path: Path
    state: Any  # a tree of arrays, a copy
    facts: dict[str, Any]


class RunFolder:
    """Saves a replay while it runs, and finds where to resume. As a context manager, it waits until all is written.

    Args:
        path: the folder.
        fleet: the runs that are replayed.
        metadata: JSON values that every checkpoint contains (configuration; `kernel`, how the ensemble is
            built, of all boats).
        names: of the estimators, as `Ensemble.names`.
        forecasts: as `Ensemble.forecasts`.
        filters: as `Ensemble.accommodated`.
        planar: what learns sway and yaw rate beside it; None: nothing does.
        data_check: what the data check found, for `results.json`; None if nothing was checked.
        setups: boat -> `usvlearn.logs.setup.Setup.json`, which its checkpoints contain.
    """

    def __init__(
        self, path: str | Path, fleet: Fleet, metadata: Mapping[str, Any], names: Sequence[str], forecasts: Any = None,
        data_check: Sequence[Mapping[str, str]] | None = None, setups: Mapping[str, Any] | None = None,
        filters: Sequence[str] = (), planar: Planar | None = None,
    ):  # fmt: skip
        self.path, self.fleet, self.names = Path(path), fleet, tuple(names)
        self._forecasts, self._filters, self._planar = forecasts, tuple(filters), planar
        self._horizons = () if planar is None else planar.horizons
        self._resumption = Resumption(
            self.path, fleet, widths_of(names, forecasts, filters, self._horizons), metadata.get("kernel"),
            planar is not None,
        )  # fmt: skip
        self.beside: PlanarState | None = None  # the newest, from `begin` on; None: a fresh start
        self._sources = [self.path]  # folders in which to look for it
        self._checked = {} if data_check is None else {"data_check": data_check}
        self._setups = setups or {}
        self.metadata = {"version": usvlearn.__version__, **metadata}
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
        starts from its newest checkpoints, in another folder.

        Raises:
            ConfigError: the folder already holds checkpoints that this run would mix with its own, files of no run
                under the names of its own, or links.
            CheckpointError: nothing readable is found to resume from, or it does not fit.
        """
        check_own(self.path)
        start, continued = Start(state, BEGIN, "learning from the start"), False
        if resume is not None:
            source = self._resumption.latest() if resume == "latest" else Path(str(resume))
            self._sources.append(source)
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
        if _has_checkpoints(self.path) and not (continued and source.resolve() == self.path.resolve()):
            raise ConfigError(
                f"{self.path}: already holds the checkpoints of a run: continue from them with resume=latest, "
                "or choose another hydra.run.dir"
            )
        own = own_predictions(self.path)
        if foreign := [path for path in self._resumption.published(self.path).paths() if path not in own]:
            raise no_run(foreign[0])
        if continued:
            start = self._resumption.continued(source, start)
        self._saved = self._reached = start.position
        self.state = start.state
        self.beside, anew = self._planar_start(start.position, continued)
        if resume is not None and not continued:  # saved in case the run stops before its first checkpoint
            for first in self._due([BEGIN] * len(self.fleet.boats)):
                save_checkpoint(first.path, first.state, **first.facts)
        self._forget(own, start.position)
        others = [*self.path.parent.glob("*"), *([] if resume is None else [source])]
        began = 1 + max(map(number, others), default=0)
        noted = self._runs | {"began": {"number": began, "time": time.strftime("%FT%TZ", time.gmtime(time.time()))}}
        write_atomically(self.path / RUNS, json.dumps(noted, indent=2).encode())
        return start._replace(anew=anew)

    def _planar_start(self, place: Position, continued: bool) -> tuple[PlanarState | None, str]:
        """The state from which sway and yaw rate go on, None for a fresh start; and what to say of it."""
        if self._planar is None or len(self._sources) < 2:
            return None, ""
        if self._sources[-1].is_file():
            found, reason = started_from(self._planar, beside_of(self._sources[-1]), len(self.fleet.boats))
        else:
            at_begin = [BEGIN if continued else None] * len(self.fleet.boats)
            places = at_begin if place == BEGIN else self._resumption.own(place)
            found, reason = started(self._planar, self._sources, self.fleet, places)
        return found, f"tracks, sway and yaw rate are learned anew: {reason}" if reason else ""

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
        due = self._due([Position(index, min(step, own)) if own > before else None for own in run.lengths])
        self._writing = self._writer.submit(self._write, self._reached, self._pending, due)
        self._pending, self._saved = [], self._reached

    def _due(self, places: Sequence[Position | None]) -> list[Unsaved]:
        """The checkpoints of the boats at their places; None: there is nothing new."""
        made = [self._checkpoint] + ([self._planar_checkpoint] if self.beside is not None else [])
        boats = list(enumerate(zip(self.fleet.boats, places, strict=True)))
        return [make(element, boat, at) for make in made for element, (boat, at) in boats if at is not None]

    def _write(self, place: Position, published: Sequence[Mapping[str, np.ndarray]], due: Sequence[Unsaved]) -> None:
        """Write the checkpoints and predictions of one place, in a thread, while the replay continues.

        The predictions are last: a run resumes from the newest place that has them, where all files are whole then.
        """
        run = self.fleet.runs[place.run]
        content = packed(
            joined(published), run, place.step, self.fleet.boats, self.names, self._forecasts, self._filters,
            self._horizons,
        )  # fmt: skip
        for each in due:
            save_checkpoint(each.path, each.state, **each.facts)
        if self._planar is not None:
            forget(self.path, self.fleet.boats)
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

    def finish(self, ensemble: Ensemble, began: float, truth: Truth | None = None) -> dict[str, Any]:
        """Score all predictions, and write `errors.csv` and `results.json`; returns the content of the latter.

        Args:
            ensemble: that has learned.
            began: `time.perf_counter()` at the start of the run.
            truth: of simulated boats, to be written beside what was identified.
        """
        found, errors = self._judged(ensemble, began, truth or {})
        write_atomically(self.path / ERRORS, errors.encode())
        save_results(self.path, found)
        return found

    def stop(self, ensemble: Ensemble, began: float) -> None:
        """Save a replay that ends early, so that it can resume; its results so far are marked as partial."""
        if self._pending:
            self._hand_on()
        steps = {"steps": self.fleet.steps_before(*self._reached), "of": self.fleet.steps}
        save_results(self.path, {"partial": {**steps, **self._judged(ensemble, began, {})[0]}})

    def _judged(self, ensemble: Ensemble, began: float, truth: Truth) -> tuple[dict[str, Any], str]:
        """The content of `results.json` and of `errors.csv`."""
        self._wait()
        settings = self.metadata.get("configuration", {})
        objective, asked = settings.get("objective"), open_questions(settings).items()
        found, errors = judged(
            ensemble, self.fleet, self.state, self.published, self._after, truth, objective, self._horizons,
            self._planar, self.beside,
        )  # fmt: skip
        own = {SECTION: [{"key": key, **each} for key, each in asked], "seconds": time.perf_counter() - began}
        return found | self._checked | own, errors

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
        time = float(run.time[place.step - 1, element]) if place.step else 0.0
        facts = {"estimator": ESTIMATOR, "boat": boat, "run": run.names[element], "step": place.step, "time": time}
        copied = tree_map(lambda leaf: leaf[element].detach().numpy().copy(), self.state)
        built = {"kernel": select_element(self.metadata.get("kernel"), len(self.fleet.boats), element)}
        if boat in self._setups:
            built["setup"] = self._setups[boat]
        return Unsaved(checkpoint_path(self.path, boat, place), copied, facts | self.metadata | built)

    def _planar_checkpoint(self, element: int, boat: str, place: Position) -> Unsaved:
        """As `_checkpoint`, of all axes and the tracks."""
        assert self._planar is not None and self.beside is not None
        own = self._checkpoint(element, boat, place)
        copied = tree_map(lambda leaf: leaf[element].detach().numpy().copy(), self.beside)
        built = {"estimator": ESTIMATOR_BESIDE, "kernel": self._planar_kernel(element)}
        return Unsaved(planar_path(self.path, boat, place), copied, own.facts | built)

    def _planar_kernel(self, element: int) -> dict[str, Any]:
        assert self._planar is not None
        found = self._planar.description()
        return found | {axis: select_element(found[axis], len(self.fleet.boats), element) for axis in AXES}

    @cached_property
    def _runs(self) -> dict[str, Any]:
        """The identity of this run: per boat, name, length and digest of each run; and the digest of the ensemble."""
        configuration = self.metadata.get("configuration", {})
        boats = {
            boat: [[run.names[element], run.lengths[element], digest(run, element)] for run in self.fleet.runs]
            for element, boat in enumerate(self.fleet.boats)
        }
        return {"boats": boats, "ensemble": ensemble_digest(configuration)}

    def _forget(self, own: Sequence[Path], place: Position) -> None:
        """Remove this run's results, and those of its own predictions after `place`, the last first."""
        self.path.mkdir(parents=True, exist_ok=True)
        for name in (RESULTS, ERRORS):
            (self.path / name).unlink(missing_ok=True)
        for old in reversed(own):
            if (found := position(old)) is not None and found > place:
                old.unlink()


def _has_checkpoints(folder: Path) -> bool:
    """Whether a folder contains checkpoints that must be kept, besides those from which a run was to start."""
    saved = [position(path) for path in (folder / CHECKPOINTS).glob(f"*/*{SUFFIX}")]
    return any(at is None or at > BEGIN for at in saved) or (bool(saved) and (folder / RUNS).exists())
