"""The batch fit of the missions that a node has kept (`usvlearn.live.missions`). It needs neither torch nor rich."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.core.lock import Lock
from usvlearn.display.json_values import finite
from usvlearn.errors import CheckpointError, ConfigError, UsvlearnError, complain
from usvlearn.live.message_buffer import recording_of
from usvlearn.live.missions import FIT, MISSIONS, RESULT, settings_of, sizes_of
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.recordings import align_fleet
from usvlearn.logs.setup import KEY, Setup
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.hand_over import last_of, table_of, write
from usvlearn.model.fit.logs import fine, missions_of


def refit(folder: Path) -> str:
    """Fit all missions in a node's folder, and write its `fit`; returns which values are to be used, a sentence."""
    with Lock(folder / FIT, "folder of a node"):
        return _refit(folder)


def _refit(folder: Path) -> str:
    sizes = sizes_of(folder / MISSIONS)
    seen, paths = {path.name: size for path, size in sizes.items()}, [*sizes]
    answer: dict[str, Any] = {"seen": seen, "use": False, "missions": 0, "quantities": {}}
    try:
        boat, setup, recordings = _read(paths)
        answer[KEY] = settings_of(setup)
        if setup.mass is None or setup.surge_max is None:
            raise ConfigError("mass: found none, or no surge_max, expected both: give the node --mass and --surge-max")
        last = last_of(folder)
        missions = missions_of(align_fleet(recordings, **fine(setup.align)), boat)
        fitted = fit_boat(boat, missions, setup.mass, setup.surge_max, online=None if last is None else last.online)
        write(folder / FIT, fitted, last, float(setup.align["dt"]))
        against, values = " ".join(fitted.doubts), fitted.identified
        many = f"the fit of {fitted.missions.number} mission{'s' * (fitted.missions.number != 1)}"
        answer |= {
            "use": not against, "missions": fitted.missions.number, "table": table_of(fitted),
            "quantities": {k: x for k in fitted.quantities if np.isfinite((x := values.displayed(k))[:3]).all()},
            "sentence": f"use those learned online, not {many}: {against}" if against else f"use those of {many}",
        }  # fmt: skip
    except UsvlearnError as error:
        answer["sentence"] = f"use those learned online: {error}"
        _tell(folder, answer)
        raise
    _tell(folder, answer)
    return str(answer["sentence"])


def _tell(folder: Path, answer: dict[str, Any]) -> None:
    """Write what a fit says; one that was killed says nothing, and the result before it stays."""
    checkpoint.write_atomically(folder / FIT / RESULT, json.dumps(finite(answer), indent=1).encode())


def _read(paths: list[Path]) -> tuple[str, Setup, list[Recording]]:
    """Boat and setup of the newest mission, and all missions that have the same."""
    missions: list[tuple[str, Setup, Recording]] = []
    for path in reversed(paths):
        try:
            leaves, facts = checkpoint.load(path)
            boat, setup = str(facts["boat"]), Setup.of(facts[KEY])
            if missions and (boat, settings_of(setup)) != (missions[0][0], settings_of(missions[0][1])):
                raise ConfigError("it is of another boat, or has other settings")
            if not setup.aligned.keys() <= leaves.keys() or any(leaf.ndim != 2 for leaf in leaves.values()):
                raise ConfigError("it lacks a channel")
            columns = {name: (leaf[0], leaf[1], leaf[2].astype(int)) for name, leaf in leaves.items()}
            missions.append((boat, setup, recording_of(setup, columns, boat, path.stem)))
        except (CheckpointError, ConfigError, KeyError, TypeError, ValueError, IndexError) as error:
            complain(f"warning: {path}: is left out ({error!r:.200})")
    if not missions:
        raise ConfigError("found no mission that can be read, expected one of a minute or more")
    return *missions[0][:2], [each for *_, each in reversed(missions)]
