"""The checkpoints of runs as families to compare, each checkpoint with the step dt of the samples that it learned from.

RUN/checkpoints/BOAT/RRRRR_SSSSSSS.safetensors   the checkpoint after S steps of run R
RUN/predictions/RRRRR_SSSSSSS.npz                of the steps before it: dt (steps, boats), s; boats (boats,)

A boat whose run ends sooner than those of others has its last checkpoint before the end of a file.

These files may come from anybody: what is absent or damaged is reported, and the rest is used.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from certify.analysis.sweep_jobs import printable
from certify.errors import CertifyError, shortened
from certify.networks.shallow import UNPACKED, Network, find, load, matched

CHECKPOINTS, PREDICTIONS = "checkpoints", "predictions"
LONGEST_STEP = 1e4  # s
NAMED = re.compile(r"(\d{1,18})_(\d{1,18})", re.ASCII)


class Given(NamedTuple):
    """Networks that somebody gave, as one family."""

    name: str
    networks: list[Network]
    steps: list[float | None]  # dt of each, s; None where it is unknown
    notes: list[str]  # a sentence for each file whose step is unknown though a run saved it, and for those without


def given(paths: Iterable[str | Path], dt: float | None = None, most: int = 100) -> list[Given]:
    """A family for each path: a run's folder, that of a sweep, or a file.

    Args:
        paths: of files and folders, and patterns.
        dt: s, of the checkpoints whose run does not tell.
        most: files of a path that are read, evenly spaced, if it holds more.

    Raises:
        CertifyError: a path names nothing, or a file is no checkpoint.
    """
    families: list[Given] = []
    for path in matched(paths):
        networks: list[Network] = []
        steps: list[float | None] = []
        notes, unknown = [], 0
        every = find([path])
        files = every if len(every) <= most else [every[round(k)] for k in np.linspace(0, len(every) - 1, most)]
        for file in files:
            found = load(file)
            try:
                step = step_of(file)
            except CertifyError as error:
                step = None
                notes.append(str(error))
            unknown += step is None
            networks += found
            steps += [dt if step is None else step] * len(found)
        name = printable(path.name if path.is_dir() else path.stem) or printable(str(path.resolve().name))
        while name in {each.name for each in families}:
            name += "'"
        if unknown:
            instead = "their time constants are in steps: give --dt" if dt is None else f"--dt, {dt:g} s, is used"
            notes.append(f"{name}: no step is saved beside {unknown} of {len(files)} files; {instead}")
        if len(files) < len(every):
            notes.append(f"{name}: {len(files)} of {len(every)} files, evenly spaced; --checkpoints takes more")
        families.append(Given(name, networks, steps, notes))
    return families


def _beside(folder: Path, name: str) -> Path | None:
    """The file of predictions in which the steps before a checkpoint end: of its run, the first up to its step."""
    if not (wanted := NAMED.fullmatch(name)):
        return None
    run, step = wanted.groups()
    ends = [(int(found[2]), path) for path in folder.glob("*.npz") if (found := NAMED.fullmatch(path.stem))
            and found[1] == run and path.is_file()]  # fmt: skip
    return min(((end, path) for end, path in ends if end >= int(step)), default=(0, None))[1]


def step_of(file: Path) -> float | None:
    """The median step of the samples from which a run learned a checkpoint, s; None where no run saved it.

    Raises:
        CertifyError: the file that should tell it is damaged.
    """
    folder = file.absolute().parent
    if folder.parent.name != CHECKPOINTS:
        return None
    beside = _beside(folder.parent.parent / PREDICTIONS, file.stem)
    if beside is None:
        return None
    try:
        with zipfile.ZipFile(beside) as archive:
            sizes = {each.filename: each.file_size for each in archive.infolist()}
        if "dt.npy" not in sizes:
            return None  # an older run
        if (size := sizes["dt.npy"] + sizes.get("boats.npy", 0)) > UNPACKED:
            raise ValueError(f"its steps unpack to {size / 1e6:.0f} MB")
        with np.load(beside, allow_pickle=False) as arrays:
            dt = np.asarray(arrays["dt"], dtype=np.float64)
            boats = [str(name) for name in np.ravel(arrays["boats"])] if "boats" in arrays.files else []
        if dt.ndim != 2 or (boats and dt.shape[1] != len(boats)):
            raise ValueError(f"dt has the shape {dt.shape}")
        if folder.name in boats:
            dt = dt[:, boats.index(folder.name)]
        known = dt[np.isfinite(dt) & (dt > 0)]
        if not len(known) or not (step := float(np.median(known))) <= LONGEST_STEP:
            raise ValueError(f"dt is not in (0, {LONGEST_STEP:g}] s")
    except Exception as error:  # a damaged archive can make a reader raise anything
        cause = shortened(error) or type(error).__name__
        raise CertifyError(
            f"{beside}: its steps cannot be read ({cause}), expected dt in s, (steps, boats): repeat the run, or give "
            "--dt"
        ) from error
    return step
