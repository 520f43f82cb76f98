"""A line for each job of a sweep as it finishes, read from the jobs' folders, so that any launcher may run them."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from usvlearn.errors import printable
from usvlearn.report.tables import short_settings
from usvlearn.runs.files import JOB, RESULTS
from usvlearn.sweeps.jobs import SweepNote, by_key, ranked_alone

PERIOD = 0.5  # s between two looks


class Progress:
    """Watches the folders of a sweep's jobs in a thread, and says what happens to them."""

    def __init__(self, folder: Path, settings: Sequence[dict[str, str]], note: SweepNote, say: Callable[[str], object]):
        self.folder, self.settings, self.note, self.say = folder, settings, note, say
        self._began = time.monotonic()
        self._before = {k: stamp for k in range(len(settings)) if (stamp := self._stamp(k))}  # results of earlier times
        self._done = {k for k in self._before if "boats" in self._results(k)}
        self._finished, self._failed = 0, 0  # since the start
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def start(self) -> None:
        """Say how many jobs there are, and watch."""
        before = f", {len(self._done)} of them finished before" if self._done else ""
        self.say(f"{len(self.settings)} job{'s' * (len(self.settings) != 1)}{before}: {self.folder}")
        self._thread.start()

    def stop(self) -> None:
        """Say what happened last, and end."""
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._end.wait(PERIOD):
            self._look()
        self._look()

    def _look(self) -> None:
        for k in range(len(self.settings)):
            if k not in self._done and (stamp := self._stamp(k)) and stamp != self._before.get(k):
                self._before[k] = stamp
                if results := self._results(k):
                    self._tell(k, results)

    def _tell(self, k: int, results: dict[str, Any]) -> None:
        """One line of one job."""
        shown = short_settings(self._own(k), self.note.swept) if self.note.swept else ""
        if "error" in results:
            self._failed += 1
            what = f"failed: {printable(str(results['error']))}"
        else:
            self._done.add(k)
            self._finished += 1
            measure, value = ranked_alone(results, self.note)
            best = f"best {printable(str(results['best']))}: " if "best" in results else ""  # of a tuning
            what = f"{best}{measure.shown(value)}, {results.get('seconds') or 0:.1f} s"
        self.say(f"job {k}{f' ({shown})' * bool(shown)}: {what}; {self._rest()}")

    def _rest(self) -> str:
        """How many jobs are done, have failed and run, and the time that is left."""
        left = len(self.settings) - len(self._done) - self._failed
        parts = [f"{len(self._done)} of {len(self.settings)} done"]
        parts += [f"{self._failed} failed"] if self._failed else []
        running = sum(
            (self.folder / str(k) / JOB).exists() and not self._stamp(k)
            for k in range(len(self.settings))
            if k not in self._done
        )
        parts += [f"{running} running"] if running else []
        if left > 0 and (ended := self._finished + self._failed):
            parts.append(f"{duration((time.monotonic() - self._began) * left / ended)} left")
        return ", ".join(parts)

    def _own(self, k: int) -> Mapping[str, str]:
        """The settings of a job as it noted them: Hydra may have shuffled the values since the command was read."""
        try:
            noted = json.loads((self.folder / str(k) / JOB).read_text())["overrides"]
            return by_key(noted)
        except (OSError, ValueError, TypeError, KeyError, RecursionError):
            return self.settings[k]

    def _stamp(self, k: int) -> int | None:
        """When the results of a job were written, in ns."""
        try:
            return (self.folder / str(k) / RESULTS).stat().st_mtime_ns
        except OSError:
            return None

    def _results(self, k: int) -> dict[str, Any]:
        """The results of a job; {} while there are none, or only those of a part."""
        try:
            results = json.loads((self.folder / str(k) / RESULTS).read_text())
        except (OSError, ValueError, RecursionError):
            return {}
        return results if isinstance(results, dict) and ("boats" in results or "error" in results) else {}


def duration(seconds: float) -> str:
    """A time in words."""
    return (
        f"{seconds:.0f} s"
        if seconds < 90
        else f"{seconds / 60:.0f} min"
        if seconds < 5400
        else f"{seconds / 3600:.1f} h"
    )
