"""A study whose stages are made by no command."""

import json
from pathlib import Path

from usvlearn.report.study import make_study

PLAN = {"members": ["aid"], "evaluations": 4, "common": ["data.n=2"], "tuning": ["data.seed=1"], "season": ["x=3"]}
STAGES = ["tune/aid", "initial", "season"]


class Recorder:
    """Stands for `train.py`: leaves what a stage leaves, and fails where it is told to."""

    def __init__(self, fails: str | None = None):
        self.stages: dict[str, list[str]] = {}
        self.root, self.fails = Path(), fails

    def __call__(self, overrides, folder: Path) -> None:
        stage = folder.relative_to(self.root).as_posix()
        self.stages[stage] = list(overrides)
        folder.mkdir(parents=True, exist_ok=True)
        if stage == self.fails:
            (folder / "runs.json").write_text("{}")
            (folder / "results.json").write_text('{"partial": {}}')
            raise KeyboardInterrupt
        name = "tuning.json" if stage.startswith("tune/") else "results.json"
        (folder / name).write_text(json.dumps({"best": {"setting": {"gain": 3.0}}}))


def made(folder: Path, recorder: Recorder, plan=PLAN) -> tuple[Path, list[str]]:
    recorder.root = folder
    return make_study(folder, plan, lambda text: None, recorder, lambda where: where / "best")
