"""The identified boats of a run, of a node's folder, or of one checkpoint."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.core.unconfirmed import unconfirmed
from usvlearn.engine.identified import identified, members_of
from usvlearn.engine.validate import read_checkpoint
from usvlearn.errors import CheckpointError, ConfigError, did_you_mean, printable
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.logs.setup import Setup
from usvlearn.model.fit.boat import FITTED, FittedBoat
from usvlearn.model.surge import SurgeModel
from usvlearn.runs.files import CHECKPOINTS

LONGEST = 100  # bytes of a boat's name in that of a file


class IdentifiedBoat(NamedTuple):
    """A boat as its newest checkpoint knows it.

    >>> from tempfile import TemporaryDirectory
    >>> from usvlearn import JointEKF, Online
    >>> joint = JointEKF(surge_max=2.7, mass=28.0, estimate_every=600.0)
    >>> with TemporaryDirectory() as folder:
    ...     (boat,) = read_boats(Online(joint).save(f"{folder}/heron/1.safetensors"))
    >>> boat.name, boat.model.mass
    ('heron', 28.0)
    """

    name: str  # of the boat
    path: Path  # of the checkpoint
    identified: Identified  # its identified quantities
    model: SurgeModel  # at the means of the periodic estimates, or of a batch fit
    setup: Setup | None  # None: it states none
    leaves: dict[str, np.ndarray]  # of the state, arrays (…,) by dotted name
    facts: dict[str, Any]  # the checkpoint's metadata

    @property
    def stem(self) -> str:
        """What the names of its files begin with: its name, of which whatever leads to another folder is removed."""
        name = re.sub(r"[^-.\w]", "_", self.name).lstrip(".")
        return name.encode("utf-8", "replace")[:LONGEST].decode("utf-8", "ignore") or "boat"

    def check_physical(self, remedy: str = "") -> None:
        """Raise a ConfigError if no boat can have what was identified.

        Args:
            remedy: what can be done beside learning anew, for the error.

        Raises:
            ConfigError: no boat can have what was identified.

        >>> from types import SimpleNamespace
        >>> wrong = SimpleNamespace(unphysical="drag pushes the boat.")
        >>> boat = IdentifiedBoat("heron", None, wrong, None, None, {}, {})
        >>> boat.check_physical()
        Traceback (most recent call last):
        usvlearn.errors.ConfigError: heron: drag pushes the boat.
        """
        if self.identified.unphysical:
            raise ConfigError(f"{printable(self.name)}: {self.identified.unphysical}{remedy}")

    @property
    def lacks(self) -> tuple[str, ...]:
        """What its model rests on that nobody has confirmed, and what is not identified well; a sentence each."""
        return (*self.guessed, *self.identified.lacks)

    @property
    def guessed(self) -> list[str]:
        """The sentence on what nobody has confirmed, if there is something."""
        return unconfirmed(self.setup.unconfirmed) if self.setup else []

    @property
    def members(self) -> Mapping[str, Any]:
        """Descriptions of the estimators by name."""
        return members_of(self.facts["kernel"])


def read_boats(path: str | Path, boat: str | None = None) -> list[IdentifiedBoat]:
    """The boats of a run's folder, of a folder of checkpoints, or of a checkpoint; each from its newest readable
    checkpoint.

    Args:
        path: of the checkpoint or the folder.
        boat: the name of the only one that is read.

    Returns:
        The boats, in the order of their names.

    Raises:
        CheckpointError: there is no readable checkpoint.
        ConfigError: there is no boat of this name, or nothing of it is identified.

    >>> read_boats("nowhere")
    Traceback (most recent call last):
    usvlearn.errors.CheckpointError: nowhere: there is no such file or folder: give the folder of a run, or a checkpoint
    """
    path = Path(os.path.expanduser(path))
    if not path.exists():
        raise CheckpointError(f"{path}: there is no such file or folder: give the folder of a run, or a checkpoint")
    if path.is_dir() and not checkpoint.checkpoints(path):
        folders = {each.name: each for each in sorted((path / CHECKPOINTS).glob("*")) if each.is_dir()}
        if not folders:
            below = sorted({each.parent.parent for each in path.glob(f"**/{CHECKPOINTS}/*") if each.is_dir()})
            hint = " or ".join(map(str, below[:4])) or "the folder of a run, or a checkpoint"
            raise CheckpointError(f"{path}: found no checkpoint there: give {hint}")
        if boat is not None and boat not in folders:
            raise ConfigError(
                f"--boat: found {boat!r}, expected one of {', '.join(folders)}{did_you_mean(boat, folders)}"
            )
        return _apart({name: _read(each) for name, each in folders.items() if boat in (None, name)})
    single = _read(path)
    if boat not in (None, single.name):
        raise ConfigError(f"--boat: found {boat!r}, expected {single.name}, the only boat of {path}")
    return [single]


def _apart(boats: Mapping[str, IdentifiedBoat]) -> list[IdentifiedBoat]:
    """Boats by the names of their folders; a ConfigError if files of two would have one name, on any system or in C."""
    owners: dict[str, str] = {}
    for folder, each in boats.items():
        if (other := owners.setdefault(re.sub(r"\W", "_", each.stem).casefold(), folder)) != folder:
            raise ConfigError(
                f"--boat: found {printable(other)} and {printable(folder)}, whose files would have one name, "
                f"{each.stem}: give one of them, and another folder for the files of each"
            )
    return list(boats.values())


def _read(path: Path) -> IdentifiedBoat:
    """The newest readable checkpoint of a folder, or one that is named."""
    used = [path]

    def read(each: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        used[:] = [each]
        return read_checkpoint(each)

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        leaves, facts = checkpoint.newest(path, read) if path.is_dir() else read(path)
    boat: Identified
    try:
        if FITTED in facts:
            boat = FittedBoat.read(facts[FITTED])
            model = boat.model
        else:
            (boat,) = identified(facts["kernel"], {name: leaf[None] for name, leaf in leaves.items()})
            if boat.beside is None:
                raise ConfigError("; ".join(boat.lacks))
            model = SurgeModel.of(boat)
        setup = Setup.of_set(facts)
    except (ConfigError, CheckpointError) as error:
        raise type(error)(f"{used[0]}: {error}") from error
    name = facts.get("boat")
    return IdentifiedBoat(
        name if isinstance(name, str) and name else used[0].parent.name, used[0], boat, model, setup, leaves, facts
    )
