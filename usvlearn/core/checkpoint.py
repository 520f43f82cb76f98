"""A checkpoint on disk: one safetensors file, whose header also contains the metadata and a checksum over both.

It is written to a temporary file, flushed to the disk and renamed, so that a reader sees a complete file or none. torch
is not imported, because small computers on boats do not have it.
"""

from __future__ import annotations

import errno
import hashlib
import itertools
import json
import os
import platform
import re
import reprlib
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from usvlearn.core.former_names import today
from usvlearn.core.samples import named_leaves, rebuild, sort_of
from usvlearn.errors import CheckpointError, printable

SCHEMA, READ = 3, (2, 3)  # written; read, where 2 is also that of version 0.2, whose runs know no tracks
SUFFIX = ".safetensors"
KEY = "usvlearn"  # of the metadata in the safetensors header
LISTED = 8  # folders in an error
QUOTED = 400  # characters of an error that quotes the file
HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]  # in the names of temporary files
LEFT = re.compile(rf"\..+\.{HOST}-(\d{{1,19}})-\d+\.tmp")
_COUNT, _WRITING = itertools.count(), set[str]()  # of this process's temporary files


class FormerVersionError(CheckpointError):
    """A checkpoint of a version whose files are not opened; those before it are none either."""


def save(path: str | Path, state: Any, **metadata: Any) -> Path:
    """Write a state, a tree of arrays or tensors, with its metadata, JSON values, atomically; returns the path."""
    path = Path(path)
    leaves = {name: as_array(leaf) for name, leaf in named_leaves(state)}
    facts = {"schema": SCHEMA, **metadata}
    facts["sha256"] = _digest(leaves, facts)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, save_tensors(leaves, {KEY: json.dumps(facts)}))
    return path


def load(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read a checkpoint: arrays by dotted name, and the metadata, with the names of today; else a CheckpointError."""
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # reading a device or a pipe would never end
            raise OSError(errno.EINVAL, "it is no file")
        content = path.read_bytes()
    except (OSError, MemoryError) as error:
        cause = getattr(error, "strerror", "it is larger than the memory")
        raise CheckpointError(f"{path}: cannot be read ({cause}): give the path of a checkpoint") from error
    try:
        leaves = load_tensors(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        facts = json.loads(header["__metadata__"][KEY])
        if not isinstance(facts, dict):
            raise TypeError(f"its metadata are {reprlib.repr(facts)}, expected a dictionary")
        stated = facts.pop("sha256", None)
        found = _digest(leaves, facts)
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise CheckpointError(
            f"{path}: is not a usvlearn checkpoint or is damaged ({str(error)[:QUOTED]}): use the checkpoint saved "
            "before it"
        ) from error
    settings, schema = facts.get("configuration"), facts.get("schema")
    if schema == 1 or (schema == 2 and isinstance(settings, dict) and not {"tracks", "conditional"} & settings.keys()):
        version = printable(".".join(str(facts.get("version", "0.2")).split(".")[:2]))
        raise FormerVersionError(
            f"{path}: was made by usvlearn {version}, which this version does not open: open it with "
            f"`pip install usvlearn=={version}`, or train again"
        )
    if schema not in READ:
        raise CheckpointError(
            f"{path}: has the format {reprlib.repr(schema)}, this version reads {READ[0]} and {READ[1]}: "
            "read it with the version of usvlearn that wrote it"
        )
    if stated != found:
        raise CheckpointError(f"{path}: is damaged (its checksum does not fit): use the checkpoint saved before it")
    return today(leaves), today(facts)


def restore(path: str | Path, template: Any, estimator: str | None = None) -> tuple[Any, dict[str, Any]]:
    """Read a checkpoint of the named estimator into the structure of `template`, a state whose leaves, NumPy or torch,
    give names, shapes and dtypes.
    """
    leaves, facts = load(path)
    found = facts.get("estimator")
    if estimator is not None and found != estimator:
        raise CheckpointError(
            f"{path}: belongs to the estimator {reprlib.repr(found)}, expected {estimator!r}: "
            f"give a checkpoint of {estimator}"
        )
    wanted = dict(named_leaves(template))
    for kind, names in (("lacks", wanted.keys() - leaves.keys()), ("has in addition", leaves.keys() - wanted.keys())):
        if names:
            raise CheckpointError(
                f"{path}: does not fit this estimator, it {kind} {', '.join(sorted(names)[:5])}: "
                "use the configuration that it was saved with"
            )
    for name, leaf in wanted.items():
        if tuple(leaf.shape) != leaves[name].shape:
            raise CheckpointError(
                f"{path}: {name} has the shape {leaves[name].shape}, expected {tuple(leaf.shape)}: "
                "use the configuration that it was saved with"
            )
        if sort_of(leaf.dtype) != sort_of(leaves[name].dtype):
            raise CheckpointError(
                f"{path}: {name} is {leaves[name].dtype}, expected {leaf.dtype}: use the checkpoint saved before it"
            )
    return rebuild(template, {name: _like(leaf, leaves[name]) for name, leaf in wanted.items()}), facts


def checkpoints(folder: str | Path) -> list[Path]:
    """The checkpoints in a folder, oldest first (sorted by name, which increases)."""
    return sorted(Path(folder).glob(f"*{SUFFIX}"))


def newest(folder: str | Path, read: Callable[[Path], tuple[Any, dict[str, Any]]]) -> tuple[Any, dict[str, Any]]:
    """The result of `read` for the newest checkpoint of a folder for which it raises no CheckpointError.

    Without checkpoints of its own, the folder may be a run's: that of its only boat is read.
    """
    paths = checkpoints(folder)
    if not paths and (boats := sorted({path.parent for path in Path(folder).glob(f"*/*/*{SUFFIX}")})):
        if len(boats) > 1:
            raise CheckpointError(f"{folder}: holds the checkpoints of several boats: give {_either(boats)}")
        paths = checkpoints(boats[0])
    for path in reversed(paths):
        try:
            return read(path)
        except FormerVersionError:
            raise
        except CheckpointError as error:
            warnings.warn(f"{error}; trying the one before", stacklevel=3)
    raise CheckpointError(f"{folder}: none of its {len(paths)} checkpoints can be read: give another folder")


def _either(paths: Sequence[Path]) -> str:
    shown = [str(path) for path in paths[:LISTED]]
    return " or ".join(shown) + (f", or one of {len(paths) - LISTED} more" if len(paths) > LISTED else "")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a kill at any moment leaves the complete old file or the complete new one.

    Several processes may write it at the same time: each writes its own temporary file, and the last one's remains.
    Temporary files of writers that were killed are removed from the folder.
    """
    _sweep(path.parent)
    temporary = path.with_name(f".{path.name}.{HOST}-{os.getpid()}-{next(_COUNT)}.tmp")
    _WRITING.add(temporary.name)
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        if hasattr(os, "O_DIRECTORY"):
            folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    except OSError as error:
        error.filename = str(path)  # a write to a full disk names no file
        raise
    finally:
        temporary.unlink(missing_ok=True)
        _WRITING.discard(temporary.name)


def _sweep(folder: Path) -> None:
    """Remove the temporary files of writers of this machine that no longer run, if that is permitted."""
    with suppress(OSError):
        for name in os.listdir(folder):
            if (match := LEFT.fullmatch(name)) and name not in _WRITING and not _runs_elsewhere(int(match[1])):
                (folder / name).unlink(missing_ok=True)


def _runs_elsewhere(process: int) -> bool:
    """Whether another process of this machine has this number, as far as that can be found out."""
    if process == os.getpid():
        return False
    try:
        if os.name == "posix":
            os.kill(process, 0)
        return True
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True


def as_array(leaf: Any) -> np.ndarray:
    """An array from an array or a tensor, contiguous."""
    array = leaf if isinstance(leaf, np.ndarray) else leaf.detach().cpu().numpy()
    return np.ascontiguousarray(array).reshape(array.shape)


def _like(leaf: Any, array: np.ndarray) -> Any:
    if isinstance(leaf, np.ndarray):
        return array.astype(leaf.dtype)
    import torch

    return torch.from_numpy(array.copy()).to(dtype=leaf.dtype, device=leaf.device)


def _digest(leaves: Mapping[str, np.ndarray], facts: Mapping[str, Any]) -> str:
    total = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for name in sorted(leaves):
        array = leaves[name]
        total.update(f"{name} {array.dtype.str} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()
