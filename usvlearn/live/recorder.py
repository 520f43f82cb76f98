"""Records a live session as a MOOS log, with the checkpoint and the configuration by which train.py replays it bit for
bit.

Of record 3 of a folder there are `record_0003.alog`, all messages as they came; `record_0003.yaml`, a configuration of
data; `record_0003.safetensors`, the checkpoint with which it began. Stamps and values have all their digits. Where the
node makes tracks, a folder `record_0003` stands in place of the checkpoint, laid out as that of a run: it holds the
checkpoint of the surge's ensemble, and in `planar` that of all axes.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from usvlearn.core import checkpoint
from usvlearn.core.checkpoint import SUFFIX, write_atomically
from usvlearn.core.unconfirmed import SECTION
from usvlearn.errors import printable
from usvlearn.estimators.ensemble.forecasts.state import FIT
from usvlearn.live.diagnostics import PLANAR, fit_of, surge_alone
from usvlearn.logs.channels.channel import SURGE
from usvlearn.logs.setup import Setup

NAME = re.compile(r"record_(\d{4,9})\.alog")
FLUSH = 1.0  # s, after which what is buffered is written
APP = "usvlearn"
RECORDED = "record"  # "run" of the checkpoints with which records begin
FITTED = "usvlearn.estimators.ensemble.forecasts.fit_layer.FittedForecasts"


def variable(part: str) -> str:
    """The variable of a part in a record."""
    return part.upper().replace("[", "_").replace("]", "")


class Recorder:
    """Writes one record. A full disk ends it: what was written stays, and `problem` says what happened."""

    def __init__(self, folder: Path, setup: Setup, begins: tuple[dict[str, Any], dict[str, Any]], boat: str = "boat"):
        self.problem: str | None = None  # a sentence, once not all is written
        self._file: TextIO | None = None
        self._rows: list[str] = []
        self._written = -math.inf
        names = [NAME.fullmatch(path.name) for path in folder.glob("record_*.alog")]
        number = 1 + max((int(match[1]) for match in names if match), default=0)
        self.path = folder / f"record_{number:04d}.alog"
        try:
            start = _begin(self.path, boat, *begins)
            text = configuration(self.path, setup, boat, start, fit_of(begins[1]["kernel"]))
            write_atomically(self.path.with_suffix(".yaml"), text.encode())
            self._file = self.path.open("x", encoding="utf-8", newline="\n")
            self._file.write(f"%% LOG FILE: {self.path.name}\n%% LOGSTART {time.time():.3f}\n")
            for part in setup.parts.keys() - setup.live().parts.keys():  # may never come, and is named in the log
                self.write(part, 0.0, math.nan)
        except OSError as error:
            self._stop(error)

    def write(self, part: str, time: float, raw: float) -> None:
        """Add one message; `time` as the node aligned it, s."""
        if self._file is not None:
            self._rows.append(f"{time!r} {variable(part)} {APP} {raw!r}\n")

    def flush(self, clock: float, at_once: bool = False) -> None:
        """Write what is buffered, if it is time; `clock` in s."""
        if self._file is None or not (at_once or clock - self._written >= FLUSH):
            return
        rows, self._rows, self._written = "".join(self._rows), [], clock
        try:
            self._file.write(rows)
            self._file.flush()
        except OSError as error:
            self._stop(error)

    def close(self) -> None:
        """Write the rest, and close the file."""
        self.flush(math.inf, at_once=True)
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
        self._file = None

    def _stop(self, error: OSError) -> None:
        self.problem = f"the record {self.path.name} ends here ({error.strerror or error}): make room on the disk"
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
        self._file, self._rows = None, []


def _begin(path: Path, boat: str, leaves: dict[str, Any], facts: dict[str, Any]) -> Path:
    """Write the checkpoint with which a record begins; returns what train.py resumes from."""
    facts = {**facts, "run": RECORDED}
    if facts["kernel"]["kind"] != PLANAR:
        return checkpoint.save(path.with_suffix(SUFFIX), leaves, **facts)
    folder = path.with_suffix("")
    for begin, tree, known in ((folder, *surge_alone(leaves, facts)), (folder / PLANAR, leaves, facts)):
        checkpoint.save(begin / "checkpoints" / printable(boat) / f"start{SUFFIX}", tree, **known)
    return folder


def configuration(path: Path, setup: Setup, boat: str, start: Path, fit: Sequence[float] = ()) -> str:
    """The YAML that describes a record to train.py, which resumes from `start`, with the table of a fit that forecasts.

    JSON values are YAML. A surge that the node has computed is recorded as SURGE, in m/s, and not computed anew.
    """
    channels: dict[str, Any] = {}
    for name, given in setup.json()["channels"].items():
        if isinstance(given["name"], list):
            given = {**given, "name": [variable(f"{name}[{k}]") for k in range(len(given["name"]))], "field": None}
        else:
            given = {**given, "name": variable(name), "field": None}
        channels[name] = given
    if SURGE not in channels:
        source = setup.aligned[SURGE]
        channels[SURGE] = {"name": variable(SURGE), "unit": "m/s", "window": source.window, "period": source.period}
    data = {
        "_target_": "usvlearn.logs.read.read_recordings", "_convert_": "all", "path": path.name,
        "boat": printable(boat), "reader": {"_target_": "usvlearn.logs.formats.moos.alog.Alog"}, "channels": channels,
    }  # fmt: skip
    settings: Mapping[str, Any] = {
        "vehicle": {"mass": setup.mass, "surge_max": setup.surge_max}, "align": dict(setup.align), "data": data,
    }  # fmt: skip
    if fit:
        settings = {**settings, "forecasts": {"_target_": FITTED, FIT: list(fit)}}
    if setup.unconfirmed:  # under its own names, so that only a person closes them
        settings = {**settings, SECTION: {key: {**each, "written": {}} for key, each in setup.unconfirmed.items()}}
    lines = [f"{key}: {json.dumps({k: v for k, v in each.items() if v is not None})}" for key, each in settings.items()]
    stem = path.stem
    return "\n".join(
        [
            "# @package _global_",
            f"# A recorded session. In the folder of this file, `usvlearn train data={stem}.yaml",
            f"# resume={start.name}` replays it, with the same predictions.",
            *lines,
            "",
        ]
    )
