"""The missions of a node, kept in its folder, and the batch fit of all of them after each.

A mission ends where all channels fall silent, where the clock begins anew, and with the node; a long one is kept in
parts. The fit is a process of its own, `usvlearn fit FOLDER`: no step waits for it, and its failure ends nothing.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.core.events import Event
from usvlearn.core.unconfirmed import SECTION
from usvlearn.display.json_values import finite
from usvlearn.errors import CheckpointError, printable
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING
from usvlearn.estimators.ensemble.forecasts.state import TABLE
from usvlearn.live.background import Background
from usvlearn.live.health import Refit
from usvlearn.live.message_buffer import Columns, Recent
from usvlearn.live.node_folder import status_of
from usvlearn.live.start import Options
from usvlearn.logs.channels.channel import COMMANDS, SURGE
from usvlearn.logs.setup import KEY, Setup

MISSIONS, FIT, RESULT, SAID = "missions", "fit", "refit.json", "fit.log"  # in the folder of a node, and in `fit`
MOST, SHORTEST, MOVES = 32_000_000, 60.0, 0.01  # bytes of all missions; s of one, and a command in it, at least
LONGEST = 3600.0  # s, of a fit


def settings_of(setup: Setup) -> Any:
    """What a fit depends on, as JSON values: not what nobody has confirmed."""
    return finite({key: each for key, each in setup.json().items() if key != SECTION})


def sizes_of(folder: Path) -> dict[Path, int]:
    """The bytes of each mission in a folder, from the oldest; without those that are removed meanwhile."""
    sizes = {}
    for path in checkpoint.checkpoints(folder):
        with suppress(FileNotFoundError):
            sizes[path] = path.stat().st_size
    return sizes


def read_refit(folder: Path, setup: Setup | None = None) -> Refit:
    """What the last fit in a node's folder says; of another setup, nothing."""
    try:
        result = status_of(folder / FIT, RESULT)
        if not result or (setup is not None and result[KEY] != settings_of(setup)):
            return Refit()
        rows = {
            printable(name): (float(value), float(low), float(high), printable(unit))
            for name, (value, low, high, unit) in result["quantities"].items()
        }
        table = tuple(float(x) for x in result.get("table", ()))
        if len(table) not in (0, TABLE) or not np.isfinite(table).all():
            raise ValueError("its table is none")
        return Refit(result["use"] is True, int(result["missions"]), rows, printable(result["sentence"]), table)
    except (CheckpointError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        return Refit(sentence=f"{folder / FIT / RESULT} cannot be read ({error!r:.80}): remove it")


class Missions:
    """Keeps the messages of a node by missions, and has them fitted; `told` is what the last fit says, or None."""

    def __init__(self, options: Options, setup: Setup, recent: Recent, background: Background):
        self._options, self._setup, self._recent, self._background = options, setup, recent, background
        self._folder, self._lost = options.folder / MISSIONS, False  # whether a thruster lost thrust in this mission
        numbers = [int(each.stem) for each in checkpoint.checkpoints(self._folder) if each.stem.isdecimal()]
        self._path = self._folder / f"{1 + max(numbers, default=0):08d}{checkpoint.SUFFIX}"  # of this mission
        self._process: subprocess.Popen[bytes] | None = None
        self._began = 0.0  # of the process, on the monotonic clock, s
        self._problem, self._due, self._tried = "", True, dict[str, int]()  # sizes of the missions that were fitted
        self._found = read_refit(options.folder, setup)
        self.told = self._found if options.refit else None

    def tick(self, saves: bool, silent: bool, loss: Event | None) -> str:
        """Write this mission where a checkpoint is saved; end it where all channels are silent, or it is long. A
        mission with a loss of thrust is not kept, nor a fit used meanwhile. Returns why the last fit failed, or "".
        """
        self._lost |= loss is not None
        late = time.monotonic() - self._began > LONGEST
        if late and self._process is not None:
            self._process.kill()
            self._process.wait()
        if self._process is not None and (code := self._process.poll()) is not None:
            self._process, self._found = None, read_refit(self._options.folder, self._setup)
            how = "" if code in (0, 2) else f"signal {-code}" if code < 0 else f"exit code {code}"  # 2: too little data
            how = f"nothing after {LONGEST / 60:g} min" if late else how
            why = f"the next mission tries again, see {self._options.folder / FIT / SAID}"
            self._problem = how and f"the fit of the missions ended with {how}: {why}"
            self._due = True  # of missions that have ended meanwhile
        if self._options.refit:
            self.told = Refit(sentence=f"use those learned online: {loss.sentence}") if loss else self._found
        if saves or silent or self._recent.full:
            self.keep(ended=silent or self._recent.full)
        if self._due and self._process is None:
            self._due = not self._background.submit("refit", self._start)  # once the mission is written
        return self._problem

    def keep(self, ended: bool, anew: bool = False) -> None:
        """Have this mission written, unless it is short or lay still; another begins if it has ended, or the clock."""
        columns = self._recent.copy()
        moves = any(np.abs(columns[name][1]).max() > MOVES for name in COMMANDS if name in columns)
        long = SURGE in columns and np.ptp(columns[SURGE][0]) > SHORTEST
        if long and moves and self._options.refit and not self._lost:
            name = f"mission {self._path.stem} end" if ended else "mission"  # each end is written
            self._background.submit(name, self._write, self._path, columns)
        if anew or (ended and (SURGE in columns or self._recent.full)):
            self._recent.clear(keep_held=not anew)
            if self._lost:
                self._background.submit(f"drop {self._path.stem}", self._path.unlink, True)  # behind its last writing
            self._path, self._lost = self._path.with_stem(f"{int(self._path.stem) + 1:08d}"), False
            self._due = True

    def turning(self, known: Collection[str]) -> dict[str, Any]:
        """Those of the known quantities that are of turning, by the last fit; {} if it is not to be used."""
        fitted = self.told.quantities if self.told is not None and self.told.use else {}
        return {name: each for name, each in fitted.items() if name in TURNING and name in known}

    def _write(self, path: Path, columns: Columns) -> None:
        leaves = {name: np.stack(each) for name, each in columns.items()}
        checkpoint.save(path, leaves, boat=self._options.boat, **{KEY: self._setup.json()})
        sizes = sizes_of(self._folder)
        while sum(sizes.values()) > MOST:
            sizes.pop(oldest := next(iter(sizes)))
            oldest.unlink(missing_ok=True)

    def _start(self) -> None:
        """Fit all missions in a process, unless that was tried."""
        sizes = {path.name: size for path, size in sizes_of(self._folder).items()}
        with suppress(CheckpointError, TypeError, ValueError):
            self._tried |= status_of(self._options.folder / FIT, RESULT).get("seen", {})
        if self._options.refit and not sizes.items() <= self._tried.items():
            self._tried = sizes
            search = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))))
            said = self._options.folder / FIT / SAID
            said.parent.mkdir(exist_ok=True)
            with said.open("wb") as file:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "usvlearn", "fit", str(self._options.folder.absolute())],
                    start_new_session=True, env={**os.environ, "PYTHONPATH": search}, stdin=subprocess.DEVNULL,
                    stdout=file, stderr=file,
                )  # fmt: skip
            self._began = time.monotonic()
            threading.Thread(target=self._process.wait, daemon=True).start()  # ends behind the node, too
            with suppress(OSError, AttributeError):  # not on Windows; where memory is short, this process ends first
                os.setpriority(os.PRIO_PROCESS, self._process.pid, 19)
                Path(f"/proc/{self._process.pid}/oom_score_adj").write_text("1000")
