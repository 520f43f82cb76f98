"""A run's folder: saves checkpoints and predictions during a replay, and resumes from them."""

from __future__ import annotations

import hashlib
import json
import shlex
import time
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import usvlearn
from usvlearn.core.checkpoint import SUFFIX, checkpoints, restore, restore_newest, verify, write_atomically
from usvlearn.core.checkpoint import save as save_checkpoint
from usvlearn.core.samples import Fleet, Run, named_leaves, tree_map
from usvlearn.engine import of_element
from usvlearn.engine.rollouts import stack
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.evaluation.identification import Truth
from usvlearn.runs.index import begun, check_own, no_run, number, own_predictions, same_run
from usvlearn.runs.layout import CHECKPOINTS, ERRORS, ESTIMATOR, PREDICTIONS, RESULTS, RUNS, save_results
from usvlearn.runs.legacy import first_named
from usvlearn.runs.outcome import judged
from usvlearn.runs.published import BEGIN, Position, Published, joined, packed, position, stem, widths_of
from usvlearn.runs.replay import Chunk


class Start(NamedTuple):
    """Where a run begins."""

    state: EnsembleState  # leaves (boats, ...)
    position: Position
    note: str  # for the person who started it


class Set(NamedTuple):
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
        data_check: what the data check found, for `results.json`; None if nothing was checked.
        setups: boat -> `usvlearn.logs.setup.Setup.json`, which its checkpoints contain.
    """

    def __init__(
        self, path: str | Path, fleet: Fleet, metadata: Mapping[str, Any], names: Sequence[str], forecasts: Any = None,
        data_check: Sequence[Mapping[str, str]] | None = None, setups: Mapping[str, Any] | None = None,
        filters: Sequence[str] = (),
    ):  # fmt: skip
        self.path, self.fleet, self.names = Path(path), fleet, tuple(names)
        self._forecasts, self._filters = forecasts, tuple(filters)
        self._widths = widths_of(names, forecasts, filters)
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
        return self._published(self.path)

    def _published(self, folder: Path) -> Published:
        lengths = [len(run.time) for run in self.fleet.runs]
        return Published(folder, lengths, len(self.fleet.boats), self._widths)

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
            source = self._latest() if resume == "latest" else Path(str(resume))
            if source.is_file():
                start = self._from_file(source, start)
            elif source.is_dir():
                continued = same_run(source, self._runs)
                if not continued and source.resolve() == self.path.resolve():
                    raise ConfigError(
                        f"{source}: holds a run over other samples or with another ensemble: to start from its "
                        f"parameters, give resume={source} and another hydra.run.dir{_own_settings(source)}"
                    )
                start = start if continued else self._from_newest(source, start)
            else:
                raise CheckpointError(f"resume: {source} does not exist: give a run's folder, a checkpoint or latest")
        if _has_sets(self.path) and not (continued and source.resolve() == self.path.resolve()):
            raise ConfigError(
                f"{self.path}: already holds the checkpoints of a run: continue from them with resume=latest, "
                "or choose another hydra.run.dir"
            )
        own = own_predictions(self.path)
        if foreign := [path for path in self._published(self.path).paths() if path not in own]:
            raise no_run(foreign[0])
        if continued:
            start = self._continued(source, start)
        elif resume is not None:  # saved in case the run stops before its first checkpoint
            for element, boat in enumerate(self.fleet.boats):
                first = self._element_set(start.state, element, boat, BEGIN)
                save_checkpoint(first.path, first.state, **first.facts)
        self._saved = self._reached = start.position
        self.state = start.state
        self._forget(own, start.position)
        others = [*self.path.parent.glob("*"), *([] if resume is None else [source])]
        began = 1 + max(map(number, others), default=0)
        noted = self._runs | {"began": {"number": began, "time": time.strftime("%FT%TZ", time.gmtime(time.time()))}}
        write_atomically(self.path / RUNS, json.dumps(noted, indent=2).encode())
        return start

    def save(self, chunk: Chunk) -> None:
        """Write what is due after a chunk: predictions first, because a run resumes from a state only with them."""
        self.state, self._reached = chunk.state, chunk.end
        self._pending.append(chunk.published)
        if chunk.save:
            self._hand_on()

    def _hand_on(self) -> None:
        """Start to write the pending predictions and every boat's checkpoint."""
        self._wait()
        index, step = self._reached
        run, before = self.fleet.runs[index], self._saved.step if self._saved.run == index else 0
        sets = [
            self._element_set(self.state, element, boat, Position(index, min(step, run.lengths[element])))
            for element, boat in enumerate(self.fleet.boats)
            if run.lengths[element] > before
        ]
        self._writing = self._writer.submit(self._write, self._reached, self._pending, sets)
        self._pending, self._saved = [], self._reached

    def _write(self, place: Position, published: Sequence[Mapping[str, np.ndarray]], sets: Sequence[Set]) -> None:
        """Write the predictions and checkpoints of one place, in a thread, while the replay continues."""
        run = self.fleet.runs[place.run]
        content = packed(
            joined(published), run, place.step, self.fleet.boats, self.names, self._forecasts, self._filters
        )
        folder = self.path / PREDICTIONS
        folder.mkdir(exist_ok=True)
        write_atomically(folder / f"{stem(place)}.npz", content)
        for each in sets:
            save_checkpoint(each.path, each.state, **each.facts)

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
        objective = self.metadata.get("configuration", {}).get("objective")
        found, errors = judged(ensemble, self.fleet, self.state, self.published, self._after, truth, objective)
        return found | self._checked | {"seconds": time.perf_counter() - began}, errors

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
            now = _element(self.state, element)
            elements.append(restore(paths[-1], now, ESTIMATOR)[0] if paths else now)
        return stack(elements)

    def _element_set(self, state: EnsembleState, element: int, boat: str, place: Position) -> Set:
        run = self.fleet.runs[place.run]
        time = float(run.time[place.step - 1, element]) if place.step else 0.0
        facts = {"estimator": ESTIMATOR, "boat": boat, "run": run.names[element], "step": place.step, "time": time}
        copied = tree_map(lambda leaf: leaf[element].detach().numpy().copy(), state)
        built = {"kernel": of_element(self.metadata.get("kernel"), len(self.fleet.boats), element)}
        if boat in self._setups:
            built["setup"] = self._setups[boat]
        return Set(_set(self.path, boat, place), copied, facts | self.metadata | built)

    @cached_property
    def _runs(self) -> dict[str, Any]:
        """The identity of this run: per boat, name, length and digest of each run; and the digest of the ensemble."""
        configuration = self.metadata.get("configuration", {})
        parts = [configuration.get(name) for name in ("estimators", "combiners")]
        parts += [made] if (made := configuration.get("forecasts")) else []  # runs without forecasts keep their digest
        parts += ["conditional"] if configuration.get("conditional") else []  # nor did earlier ones have such intervals
        ensemble = json.dumps(first_named(parts))
        boats = {
            boat: [[run.names[element], run.lengths[element], digest(run, element)] for run in self.fleet.runs]
            for element, boat in enumerate(self.fleet.boats)
        }
        return {"boats": boats, "ensemble": hashlib.sha256(ensemble.encode()).hexdigest()}

    def _latest(self) -> Path:
        """The run that began or resumed last: this folder if it has one, else a sibling with checkpoints."""
        if (self.path / RUNS).exists():
            return self.path
        found = [path.parent for path in self.path.parent.glob(f"*/{RUNS}")]
        found = [folder for folder in found if any((folder / CHECKPOINTS).glob(f"*/*{SUFFIX}"))]
        if not found:
            raise CheckpointError(
                f"resume=latest: no run with checkpoints in {self.path.parent}: give a run's folder, or leave it out"
            )
        return max(found, key=begun)

    def _from_file(self, source: Path, start: Start) -> Start:
        """Every boat starts from one checkpoint."""
        state, facts = from_sets(start.state, [source] * len(self.fleet.boats))
        of = ", run ".join(str(facts[0][name]) for name in ("boat", "run") if name in facts[0])
        return start._replace(state=state, note=f"starting from {of or 'a checkpoint'}, {source}")

    def _from_newest(self, source: Path, start: Start) -> Start:
        """Every boat starts from its newest readable checkpoint, at the first run."""
        elements = []
        for element, boat in enumerate(self.fleet.boats):
            folder = source / CHECKPOINTS / boat
            if not checkpoints(folder):
                boats = ", ".join(sorted(path.name for path in (source / CHECKPOINTS).glob("*"))) or "none"
                raise CheckpointError(
                    f"{source}: has no checkpoint of {boat} (it has: {boats}): give the checkpoint to start from"
                )
            try:
                elements.append(restore_newest(folder, _element(start.state, element), ESTIMATOR)[0])
            except CheckpointError as error:
                raise CheckpointError(f"{error}{_own_settings(source)}") from error
        note = f"starting from the newest checkpoints of {source}, from the first run on"
        return start._replace(state=stack(elements), note=note)

    def _continued(self, source: Path, start: Start) -> Start:
        """Resume from the newest place at which every boat's checkpoint and all predictions can be read."""
        published, readable, before = self._published(source), [], BEGIN
        for run, step, end in published.places():
            try:
                if run != before.run and (run - 1 != before.run or before.step != len(self.fleet.runs[run - 1].time)):
                    raise CheckpointError(f"{source}: predictions of the end of run {before.run + 1} are missing")
                published.read(run, step, end)
            except CheckpointError as error:
                warnings.warn(f"{error}; resuming from before it", stacklevel=2)
                break
            before = Position(run, end)
            readable.append(before)
        paths: list[Path] = []
        while readable:
            place = readable[-1]
            paths = [_set(source, boat, self._own(element, place)) for element, boat in enumerate(self.fleet.boats)]
            try:
                for path in paths:
                    verify(path)
                break
            except CheckpointError as error:
                warnings.warn(f"{error}; resuming from before it", stacklevel=2)
                readable.pop()
        if not readable:
            place, note = BEGIN, "learning from the start"
            paths = [_set(source, boat, BEGIN) for boat in self.fleet.boats]
            if not all(path.exists() for path in paths):  # it began without saved checkpoints
                self._bring(source, BEGIN)
                return start
        else:
            note = f"resuming after step {place.step} of run {place.run + 1} of {len(self.fleet.runs)}, from {source}"
        elements = [restore(path, _element(start.state, element), ESTIMATOR)[0] for element, path in enumerate(paths)]
        self._bring(source, place)
        return Start(stack(elements), place, note)

    def _own(self, element: int, place: Position) -> Position:
        """A boat's own place when the fleet is at `place`: its runs may be shorter, or fewer."""
        for run in range(place.run, -1, -1):
            if length := self.fleet.runs[run].lengths[element]:
                return Position(run, min(length, place.step) if run == place.run else length)
        raise AssertionError(f"{self.fleet.boats[element]} has no run up to {place}")

    def _bring(self, source: Path, place: Position) -> None:
        """Copy the checkpoints and predictions up to `place` from another folder, so that this one is complete."""
        if source.resolve() == self.path.resolve():
            return
        for old in [*(source / CHECKPOINTS).glob(f"*/*{SUFFIX}"), *(source / PREDICTIONS).glob("*.npz")]:
            if (found := position(old)) is not None and found <= place:
                new = self.path / old.relative_to(source)
                new.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(new, old.read_bytes())

    def _forget(self, own: Sequence[Path], place: Position) -> None:
        """Remove this run's results, and those of its own predictions after `place`, the last first."""
        self.path.mkdir(parents=True, exist_ok=True)
        for name in (RESULTS, ERRORS):
            (self.path / name).unlink(missing_ok=True)
        for old in reversed(own):
            if (found := position(old)) is not None and found > place:
                old.unlink()


def from_sets(state: EnsembleState, paths: Sequence[Path]) -> tuple[EnsembleState, list[dict[str, Any]]]:
    """The state of all boats from one saved checkpoint for each, and the metadata of these checkpoints.

    The monitors, and what they have told the filters, start anew, because the checkpoints may be of other boats, or of
    an earlier day.

    Args:
        state: of a fresh start, leaves `(boats, ...)`.
        paths: of each boat a checkpoint, or a folder of them, of which the newest readable one is taken.

    Raises:
        CheckpointError: a checkpoint cannot be read, or belongs to another ensemble.
    """
    template = _element(state, 0)
    sets = {
        path: (restore_newest if path.is_dir() else restore)(path, template, ESTIMATOR) for path in dict.fromkeys(paths)
    }
    anew = {"monitors": state.monitors, "accommodation": state.accommodation}
    return stack([sets[path][0] for path in paths])._replace(**anew), [sets[path][1] for path in paths]


def _own_settings(source: Path) -> str:
    """How to continue a run with the settings that it was made with, if Hydra has saved them."""
    settings = source / ".hydra"
    if not (settings / "config.yaml").is_file():
        return ""
    return f"; its own settings are those of --config-dir {shlex.quote(str(settings))} --config-name config"


def _set(folder: Path, boat: str, place: Position) -> Path:
    return folder / CHECKPOINTS / boat / f"{stem(place)}{SUFFIX}"


def digest(run: Run, element: int) -> str:
    """A sha256 of one boat's samples."""
    total = hashlib.sha256()
    for name, leaf in named_leaves(run.samples):
        total.update(name.encode() + leaf[: run.lengths[element], element].tobytes())
    return total.hexdigest()


def _has_sets(folder: Path) -> bool:
    """Whether a folder contains checkpoints that must be kept, besides those from which a run was to start."""
    sets = [position(path) for path in (folder / CHECKPOINTS).glob(f"*/*{SUFFIX}")]
    return any(at is None or at > BEGIN for at in sets) or (bool(sets) and (folder / RUNS).exists())


def _element(state: EnsembleState, element: int) -> EnsembleState:
    return tree_map(lambda x: x[element], state)
