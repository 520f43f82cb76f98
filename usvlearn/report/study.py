"""A study from nothing on a simulated fleet: tune on one season, start the next from the result, and evaluate it.

Each stage has its own folder and is a run of `train.py` with some overrides:

tune/MEMBER        settings of a member, on the tuning season, each member with the same budget
tuned/initial      the ensemble with these settings, over the tuning season, learning from nothing
tuned/season       the season, all boats from one checkpoint: of the last checkpoints of the tuning season's boats that
                   which serves all of them best
default/initial, default/season     the same without tuning: what was gained

A finished stage is not made again; a killed one continues where it stopped.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import usvlearn
from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.lock import Lock
from usvlearn.display.figures import themed
from usvlearn.display.terminal import ResultTable
from usvlearn.errors import ConfigError
from usvlearn.evaluation.metrics import by_error, mean_mae
from usvlearn.report.sections.section import Section
from usvlearn.runs.files import RESULTS, RUNS, TUNING
from usvlearn.runs.saved import results
from usvlearn.runs.trust import check_setting

PLAN, START = "study.json", "start.json"
PAPER_RESULT = (
    "A coarse grid search and refinement by hand on 29 h of the season before. The authors found a fair comparison "
    "difficult: each method's performance depends on its tuning parameters."
)
Job = Callable[[Sequence[str], Path], Any]  # overrides of train.yaml, folder


class Study:
    """Runs the stages of a study.

    Args:
        folder: of the study.
        plan: overrides of train.yaml that are `common` to both seasons, and those of `tuning` and `season`; `members`
            to tune; `evaluations` of each.
        say: prints what is being done.
        run: does the work of `train.py OVERRIDES` in a folder.
        check: raises an error if overrides that ask for tuning are wrong.
        choose: the checkpoint of a finished folder from which the next season starts.

    Raises:
        ConfigError: a member cannot be tuned in this way.
    """

    def __init__(
        self,
        folder: Path,
        plan: Mapping[str, Any],
        say: Callable[[str], object],
        run: Job,
        choose: Callable[[Path], Path],
        check: Callable[[Sequence[str]], object],
    ):
        self.folder, self.commands = folder, list[str]()
        self.plan = {**plan, "version": usvlearn.__version__}
        self._run, self._choose, self._say = run, choose, say
        with themed():  # fail now if the report cannot be drawn later
            pass
        for member in self.plan["members"]:
            check(self._tuning(member))

    def make(self) -> tuple[Path, Section]:
        """Make all stages; returns the folder of the season with tuned settings, and the section on the gain of tuning.

        Raises:
            ConfigError: the folder holds a study of another plan, or another process is at work there.
        """
        with Lock(self.folder, "folder"):
            self._keep_plan()
            found = {member: self._tuned(member) for member in self.plan["members"]}
            settings = [
                f"estimators.{member}.{path}={value}"
                for member, each in found.items()
                for path, value in each["best"]["setting"].items()
            ]
            before, after = self._learned("default", []), self._learned("tuned", settings)
            return after, tuning_section(found, results(after)["boats"], results(before)["boats"])

    def _keep_plan(self) -> None:
        path = self.folder / PLAN
        if path.exists() and _read(path) != self.plan:
            raise ConfigError(
                f"{path}: found a study of another plan or version, expected the same: choose another folder=DIR, or "
                "remove this one"
            )
        write_atomically(path, json.dumps(self.plan, indent=2).encode())

    def _tuned(self, member: str) -> dict[str, Any]:
        folder = self.folder / "tune" / member
        path = folder / TUNING
        self._stage(self._tuning(member), folder, path)
        found = _read(path)
        check_setting(str(path), found["best"]["setting"])
        return found

    def _tuning(self, member: str) -> list[str]:
        return [*self._season("tuning"), f"grid={member}", f"tuning.evaluations={self.plan['evaluations']}"]

    def _season(self, name: str) -> list[str]:
        return [*self.plan["common"], *self.plan[name]]

    def _learned(self, kind: str, settings: Sequence[str]) -> Path:
        initial, season = self.folder / kind / "initial", self.folder / kind / "season"
        self._stage([*self._season("tuning"), *settings], initial, initial / RESULTS)
        chosen = self.folder / kind / START
        if not chosen.exists():
            write_atomically(chosen, json.dumps(str(self._choose(initial))).encode())
        start = f"resume={_read(chosen)}"
        self._stage([*self._season("season"), *settings, start], season, season / RESULTS)
        return season

    def _stage(self, overrides: Sequence[str], folder: Path, done: Path) -> None:
        self.commands.append(f"python train.py {shlex.join(overrides)} hydra.run.dir={folder}")
        if done.exists() and "partial" not in _read(done):
            self._say(f"{folder}: is there")
            return
        self._say(self.commands[-1])
        if (folder / RUNS).exists():  # it was stopped
            overrides = [*(each for each in overrides if not each.startswith("resume=")), f"resume={folder}"]
        with Lock(folder, "folder"):
            self._run(overrides, folder)


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ConfigError(f"{path}: is damaged ({error}): remove it, and give the same command again") from error


def tuning_section(
    tuned: Mapping[str, Mapping], after: Mapping[str, Mapping], before: Mapping[str, Mapping]
) -> Section:
    """The gain of tuning each member: on the season of the tuning, and of all estimators on the next one.

    Args:
        tuned: the content of `tuning.json`, by member.
        after: scores of the season with the tuned settings, `boats` of `results.json`.
        before: the same with the default settings.
    """
    rows, maes, without = [], mean_mae(after), mean_mae(before)
    for name in by_error(maes):
        best = tuned[name]["best"] if name in tuned else {"setting": {}, "gain": None}
        settings = ", ".join(f"{key} {value:.4g}" for key, value in best["setting"].items())
        rows.append((name, settings, best["gain"], without[name], maes[name], 100 * (1 - maes[name] / without[name])))
    columns = ("method", "tuned to", "gain on the tuning season, %", "next season: default, m/s", "tuned, m/s",
               "gain, %")  # fmt: skip
    here = [f"Tuned on the season before alone: {', '.join(tuned)}."]
    return Section("tuning", "What tuning gained", PAPER_RESULT, here, (), [ResultTable("tuning", columns, rows)])
