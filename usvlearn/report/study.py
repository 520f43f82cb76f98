"""The paper's study on a simulated fleet: tune members on one season, learn it and the next one, which is judged.

tune/MEMBER   settings of a member, on the tuning season, each member with the same budget
initial       the ensemble with these settings, over the tuning season, learning from nothing
season        the season, all boats from that last checkpoint of `initial` which serves all of them best

Each stage is a run of `train.py` with some overrides. A finished stage is not made again; a killed one continues.
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
from usvlearn.errors import ConfigError
from usvlearn.runs.files import RESULTS, RUNS, TUNING
from usvlearn.runs.trust import check_setting

PLAN = "study.json"


def make_study(
    folder: Path,
    plan: Mapping[str, Any],
    say: Callable[[str], object],
    run: Callable[[Sequence[str], Path], Any],
    choose: Callable[[Path], Path],
) -> tuple[Path, list[str]]:
    """Make all stages; returns the folder of the season, and the commands that make them again."""
    commands: list[str] = []

    def stage(name: str, overrides: Sequence[str], results: str) -> Path:
        path = folder / name
        commands.append(f"python train.py {shlex.join(overrides)} hydra.run.dir={path}")
        if (path / results).exists() and "partial" not in _read(path / results):
            say(f"{path}: is there")
            return path
        say(commands[-1])
        if (path / RUNS).exists():  # it was stopped
            overrides = [*(each for each in overrides if not each.startswith("resume=")), f"resume={path}"]
        with Lock(path, "folder"):
            run(overrides, path)
        return path

    with Lock(folder, "folder"):
        path, plan = folder / PLAN, {**plan, "version": usvlearn.__version__}
        if path.exists() and _read(path) != plan:
            raise ConfigError(
                f"{path}: found a study of another plan or version, expected the same: choose another folder=DIR, or "
                "remove this one"
            )
        write_atomically(path, json.dumps(plan, indent=2).encode())
        tuning, settings = [*plan["common"], *plan["tuning"]], list[str]()
        for member in plan["members"]:
            asked = [*tuning, f"grid={member}", f"tuning.evaluations={plan['evaluations']}"]
            tuned = stage(f"tune/{member}", asked, TUNING) / TUNING
            setting = _read(tuned)["best"]["setting"]
            check_setting(str(tuned), setting)
            settings += [f"estimators.{member}.{key}={value}" for key, value in setting.items()]
        initial = stage("initial", [*tuning, *settings], RESULTS)
        start = f"resume={choose(initial)}"
        return stage("season", [*plan["common"], *plan["season"], *settings, start], RESULTS), commands


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ConfigError(f"{path}: is damaged ({error}): remove it, and give the same command again") from error
