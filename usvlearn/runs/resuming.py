"""Where a run begins: from the start, from a checkpoint, or where another run or an earlier session stopped."""

from __future__ import annotations

import json
import shlex
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from usvlearn.core.checkpoint import SUFFIX, checkpoints, load, write_atomically
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.engine.rollouts import stack
from usvlearn.engine.validate import restored
from usvlearn.errors import CheckpointError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.planar.layer import Planar, PlanarState
from usvlearn.live.recorder import RECORDED
from usvlearn.runs.files import CHECKPOINTS, ESTIMATOR, ESTIMATOR_BESIDE, HYDRA, PLANAR, RUNS, begun
from usvlearn.runs.prediction_files import BEGIN, PREDICTIONS, Position, Published, position, stem, widths_of


class Start(NamedTuple):
    """Where a run begins."""

    state: EnsembleState  # leaves (boats, ...)
    position: Position
    note: str  # for the person who started it
    anew: str = ""  # what is learned anew although the note does not say so, and why


class Resumption:
    """Finds where a run of an ensemble may resume, and brings what it then needs into its folder."""

    def __init__(self, path: Path, fleet: Fleet, ensemble: Ensemble, planar: Planar | None):
        self.path, self.fleet, self._planar, self.kernel = path, fleet, planar, ensemble.description()
        self._widths = widths_of(ensemble, planar)

    def published(self, folder: Path) -> Published:
        """What the run of a folder has published, if it is over the same samples."""
        lengths = [len(run.time) for run in self.fleet.runs]
        return Published(folder, lengths, len(self.fleet.boats), self._widths)

    def latest(self) -> Path:
        """The run that began or resumed last: this folder if it has one, else a sibling with checkpoints."""
        if (self.path / RUNS).exists():
            return self.path
        runs = [path.parent for path in self.path.parent.glob(f"*/{RUNS}")]
        runs = [folder for folder in runs if any((folder / CHECKPOINTS).glob(f"*/*{SUFFIX}"))]
        if not runs:
            raise CheckpointError(
                f"resume=latest: no run with checkpoints in {self.path.parent}: give a run's folder, or leave it out"
            )
        return max(runs, key=begun)

    def from_file(self, source: Path, start: Start) -> Start:
        """Every boat starts from one checkpoint."""
        state, facts = from_checkpoints(start.state, [source] * len(self.fleet.boats), self.kernel)
        of = ", run ".join(str(facts[0][name]) for name in ("boat", "run") if name in facts[0])
        note = f"starting from {of or 'a checkpoint'}, {source}{other_numbers(facts[0], self.kernel)}"
        return start._replace(state=state, note=note)

    def from_newest(self, source: Path, start: Start) -> Start:
        """Every boat starts from its newest readable checkpoint, at the first run."""
        elements, told = [], ""
        for element, boat in enumerate(self.fleet.boats):
            folder = source / CHECKPOINTS / boat
            if not checkpoints(folder):
                boats = ", ".join(sorted(path.name for path in (source / CHECKPOINTS).glob("*"))) or "none"
                raise CheckpointError(
                    f"{source}: has no checkpoint of {boat} (it has: {boats}): give the checkpoint to start from"
                )
            try:
                state, facts = restored(folder, of_boat(start.state, element), ESTIMATOR, self.kernel)
                elements.append(state)
                told = told or other_numbers(facts, self.kernel)
            except CheckpointError as error:
                raise CheckpointError(f"{error}{own_settings(source)}") from error
        note = f"starting from the newest checkpoints of {source}, from the first run on{told}"
        return start._replace(state=stack(elements), note=note)

    def continued(self, source: Path, start: Start) -> Start:
        """Resume from the newest place at which every boat's checkpoint and all predictions can be read."""
        published, readable, before = self.published(source), [], BEGIN
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
        for place in reversed(readable):
            note = f"resuming after step {place.step} of run {place.run + 1} of {len(self.fleet.runs)}, from {source}"
            places = list(zip(self.fleet.boats, self.places(place), strict=True))
            try:
                for path in [checkpoint_path(source / PLANAR, *each) for each in places] if self._planar else ():
                    if path.exists():  # else, as in older runs, sway and yaw rate are learned anew
                        load(path)
                state = self._state(source, start, self.places(place))
                break
            except CheckpointError as error:
                warnings.warn(f"{error}; resuming from before it", stacklevel=2)
        else:
            place, note, state = BEGIN, "learning from the start", start.state
            if all(checkpoint_path(source, boat, BEGIN).exists() for boat in self.fleet.boats):
                state = self._state(source, start, [BEGIN] * len(self.fleet.boats))
        self._bring(source, place)
        return Start(state, place, note)

    def _state(self, source: Path, start: Start, places: Sequence[Position]) -> EnsembleState:
        """The boats' states at these places."""
        paths = map(checkpoint_path, [source] * len(places), self.fleet.boats, places)
        boats = (of_boat(start.state, element) for element in range(len(places)))
        return stack([restored(*each, ESTIMATOR, self.kernel)[0] for each in zip(paths, boats, strict=True)])

    def places(self, place: Position) -> list[Position]:
        """The boats' own places when the fleet is at `place`: their runs may be shorter, or fewer."""
        places = []
        for element in range(len(self.fleet.boats)):
            run = next(k for k in range(place.run, -1, -1) if self.fleet.runs[k].lengths[element])
            length = self.fleet.runs[run].lengths[element]
            places.append(Position(run, min(length, place.step) if run == place.run else length))
        return places

    def planar(self, source: Path | None, place: Position, continued: bool) -> tuple[PlanarState | None, str]:
        """The state from which sway and yaw rate go on, None for a fresh start; and what to say of it."""
        if self._planar is None or source is None:
            return None, ""
        template = tree_map(lambda x: x[0], self._planar.init((1,)))
        reason = ""
        for beside, paths in self._planar_paths(source, place, continued):
            states: list[Any] = []
            for boat, newest_first in zip(self.fleet.boats, paths, strict=True):
                reason = f"{beside}: has no checkpoint of {boat} at this place"
                for path in newest_first:
                    try:
                        states.append(restored(path, template, ESTIMATOR_BESIDE, self._planar.description())[0])
                        break
                    except CheckpointError as error:
                        reason = str(error)
            if len(states) == len(self.fleet.boats):
                return stack(states), ""
        return None, f"tracks, sway and yaw rate are learned anew: {reason}"

    def _planar_paths(self, source: Path, place: Position, continued: bool) -> list[tuple[Path, list[list[Path]]]]:
        """The folders in which sway and yaw rate may be, and in each the checkpoints to try, of each boat."""
        boats = self.fleet.boats
        if source.is_file():  # that of all axes was saved with the ensemble's
            boat = source.parent
            folder = boat.parent.parent / PLANAR
            return [(folder, [[folder / CHECKPOINTS / boat.name / source.name]] * len(boats))]
        at_begin = [BEGIN if continued else None] * len(boats)
        places = at_begin if place == BEGIN else self.places(place)
        folders = []
        for folder in (self.path / PLANAR, source / PLANAR):
            newest = [reversed(checkpoints(folder / CHECKPOINTS / boat)) for boat in boats]
            wanted = [at and checkpoint_path(folder, boat, at) for boat, at in zip(boats, places, strict=True)]
            pairs = zip(newest, wanted, strict=True)
            folders.append((folder, [[path for path in paths if named in (None, path)] for paths, named in pairs]))
        return folders

    def _bring(self, source: Path, place: Position) -> None:
        """Copy the checkpoints and predictions up to `place` from another folder, so that this one is complete."""
        if source.resolve() == self.path.resolve():
            return
        saved = (old for each in (source, source / PLANAR) for old in (each / CHECKPOINTS).glob(f"*/*{SUFFIX}"))
        for old in [*saved, *(source / PREDICTIONS).glob("*.npz")]:
            if (at := position(old)) is not None and at <= place:
                new = self.path / old.relative_to(source)
                new.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(new, old.read_bytes())


def from_checkpoints(
    state: EnsembleState, paths: Sequence[Path], kernel: Any
) -> tuple[EnsembleState, list[dict[str, Any]]]:
    """The state of all boats from one saved checkpoint for each, and the metadata of these checkpoints.

    The monitors, and what they have told the filters, start anew, because the checkpoints may be of other boats, or of
    an earlier day; but not where a node's record begins. Instead of a checkpoint, a path may be a folder of them, of
    which the newest readable one is taken.
    """
    template = of_boat(state, 0)
    read = {path: restored(path, template, ESTIMATOR, kernel) for path in dict.fromkeys(paths)}
    anew = {"monitors": state.monitors, "accommodation": state.accommodation}
    if all(facts.get("run") == RECORDED for _, facts in read.values()):
        anew = {}
    return stack([read[path][0] for path in paths])._replace(**anew), [read[path][1] for path in paths]


def other_numbers(facts: Mapping[str, Any], kernel: Any) -> str:
    """That a node's record was made with other numbers than those of this run's estimator, if that is so; else ""."""
    if facts.get("run") != RECORDED:
        return ""
    there, here = (_flat("", json.loads(json.dumps(each))) for each in (facts.get("kernel"), kernel))
    names = sorted(dict(there.items() ^ here.items()))[:3]
    named = ", ".join(f"{name[1:]} {there.get(name)} there, {here.get(name)} here" for name in names)
    what = f"other numbers ({named}): give the settings of the run from which the node started"
    return f"; its predictions were made with {what}" if names else ""


def _flat(name: str, value: Any) -> dict[str, str]:
    """The values in JSON by dotted names, rounded."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else None
    if items is None:
        return {name: f"{value:.9g}" if isinstance(value, float) else f"{value}"}
    return {key: each for part, inner in items for key, each in _flat(f"{name}.{part}", inner).items()}


def own_settings(source: Path) -> str:
    """How to continue a run with the settings that it was made with, if Hydra has saved them."""
    settings = source / HYDRA
    if not (settings / "config.yaml").is_file():
        return ""
    return f"; its own settings are those of --config-dir {shlex.quote(str(settings))} --config-name config"


def checkpoint_path(folder: Path, boat: str, place: Position) -> Path:
    """The checkpoint of a boat at a place, in the folder of a run, or in its part `planar`."""
    return folder / CHECKPOINTS / boat / f"{stem(place)}{SUFFIX}"


def of_boat(state: EnsembleState, element: int) -> EnsembleState:
    """The state of one boat."""
    return tree_map(lambda x: x[element], state)
