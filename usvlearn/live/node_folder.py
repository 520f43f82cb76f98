"""The folder of a node: its checkpoints, the newest of which it starts from, and its status."""

from __future__ import annotations

import itertools
import json
import re
import stat
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.display.json_values import finite
from usvlearn.engine.validate import read_checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.logs.setup import Setup

NAME = re.compile(r"live_(\d{8,18})\.safetensors")  # sorted behind the checkpoints of a run, which begin with a digit
STATUS = "status.json"
LARGEST = 1_000_000  # bytes of a status


class NodeFolder:
    """The checkpoints of a folder. Those that a node has written are numbered; the oldest of them are removed."""

    def __init__(self, folder: Path, keep: int = 100):
        self.folder, self._keep = folder, max(keep, 2)
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(match[1]) for path in folder.iterdir() if (match := NAME.fullmatch(path.name))]
        with suppress(CheckpointError):  # a node starts beside a damaged status, too
            if not numbers and (status := status_of(folder)) and "middleware" not in status:
                raise ConfigError(f"{folder / STATUS}: is not the status of a node: choose another folder")
        self._count = itertools.count(1 + max(numbers, default=0))

    @property
    def any(self) -> bool:
        """Whether there is a checkpoint, readable or not."""
        return bool(checkpoint.checkpoints(self.folder))

    def save(self, leaves: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> Path:
        """Write a checkpoint, then remove the oldest of the node's own, unless the disk is full."""
        path = self.folder / f"live_{next(self._count):08d}{checkpoint.SUFFIX}"
        checkpoint.save(path, dict(leaves), **facts)
        own = sorted((each for each in self.folder.iterdir() if NAME.fullmatch(each.name)), key=lambda each: each.name)
        for old in own[: -self._keep]:
            with suppress(OSError):
                old.unlink()
        return path

    def tell(self, status: Mapping[str, Any]) -> None:
        """Write the status, which `usvlearn live status` reads; a number that is not finite becomes null."""
        checkpoint.write_atomically(self.folder / STATUS, json.dumps(finite(status), indent=1).encode())


def unsaved(folder: Path, error: BaseException | None) -> str:
    """That no checkpoint can be saved, and why."""
    cause = getattr(error, "strerror", None) or error
    return f"no checkpoint can be saved in {folder} ({cause}): make room on the disk; the earlier ones are complete"


def newest(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], Path, list[str]]:
    """A checkpoint, or the newest readable one of a folder or of a run with one boat.

    Returns leaves, metadata, the path, and sentences about newer checkpoints that cannot be read.
    """
    if not path.exists():
        raise CheckpointError(f"{path}: there is no such file or folder: correct the path")
    if not path.is_dir():
        return *_read(path), path, []
    if not checkpoint.checkpoints(path) and not any(path.glob(f"*/*/*{checkpoint.SUFFIX}")):
        below = sorted({each.parent for each in path.glob(f"**/*{checkpoint.SUFFIX}")})
        hint = " or ".join(map(str, below[:4])) or "a checkpoint, a folder of checkpoints, or the folder of a run"
        raise CheckpointError(f"{path}: found no checkpoint there: give {hint}")
    last: list[Path] = []

    def read(each: Path) -> tuple[Any, dict[str, Any]]:
        last[:] = [each]
        return _read(each)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        leaves, facts = checkpoint.newest(path, read)
    return leaves, facts, last[0], [str(each.message) for each in caught]


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """A checkpoint whose setup is legal, too."""
    leaves, facts = read_checkpoint(path)
    try:
        if (setup := Setup.of_set(facts)) is not None:
            setup.check_alignment()
    except ConfigError as error:
        raise CheckpointError(
            f"{path}: its setup is not legal ({error}): use the checkpoint saved before it"
        ) from error
    return leaves, facts


def status_of(folder: Path, name: str = STATUS) -> dict[str, Any]:
    """What a node, or a fit of its missions, wrote last; {} if it wrote nothing."""
    path = folder / name
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("it is no regular file")
        if path.stat().st_size > LARGEST:
            raise ValueError("it is too large")
        status = json.loads(path.read_text())
        if not isinstance(status, dict):
            raise ValueError("it is no object")
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: is not the status of a node ({error}): remove it") from error
    return status
