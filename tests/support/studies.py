"""A study whose stages are made by no command."""

import json
from pathlib import Path

from usvlearn.report.study import Study

PLAN = {"members": ["aid"], "evaluations": 4, "common": ["data.n=2"], "tuning": ["data.seed=1"], "season": ["x=3"]}


STAGES = ["tune/aid", "default/initial", "default/season", "tuned/initial", "tuned/season"]


def maes(mae: float) -> dict:
    return {"heron": {"aid": {"mae": mae}}}


class Recorder:
    """Stands for `train.py`: leaves what a stage leaves, and fails where it is told to."""

    def __init__(self, fails: str | None = None):
        self.stages: list[tuple[str, list[str]]] = []
        self.fails = fails

    def __call__(self, overrides, folder: Path) -> None:
        stage = f"{folder.parent.name}/{folder.name}"
        self.stages.append((stage, list(overrides)))
        folder.mkdir(parents=True, exist_ok=True)
        if stage == self.fails:
            (folder / "runs.json").write_text("{}")
            (folder / "results.json").write_text('{"partial": {}}')
            raise KeyboardInterrupt
        if stage.startswith("tune/"):
            best = {"mae": 0.1, "gain": 50.0, "setting": {"gain": 3.0}}
            (folder / "tuning.json").write_text(
                json.dumps({"evaluations": 4, "default": {"mae": 0.2}, "best": best, "way": "grid"})
            )
        else:
            (folder / "results.json").write_text(json.dumps({"boats": maes(0.3 if stage[0] == "d" else 0.2)}))


def made(folder: Path, recorder: Recorder, plan=PLAN) -> Study:
    return Study(folder, plan, lambda text: None, recorder, lambda where: where / "best", lambda overrides: None)
