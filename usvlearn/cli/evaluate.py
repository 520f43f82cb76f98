"""The job of evaluate.py and `usvlearn evaluate`: judge saved runs, compare those of a sweep, or make a study."""

from functools import partial
from pathlib import Path

import hydra
from omegaconf import DictConfig, OmegaConf

from usvlearn.cli.fit import fit_on_the_way
from usvlearn.cli.hydra_command import command
from usvlearn.cli.sweep import load
from usvlearn.composition.alignment import CheckedAlignment
from usvlearn.composition.configuration import ensemble_of, instantiate, plain
from usvlearn.core.unconfirmed import open_questions, unconfirmed
from usvlearn.display.terminal import Activity, console, show
from usvlearn.errors import ConfigError  # what needs torch is imported where it is used: --help is quick
from usvlearn.logs.recordings import align_fleet
from usvlearn.sweeps.launchers import set_threads
from usvlearn.sweeps.leaderboard import leaderboard


def study(cfg: DictConfig, tools) -> None:
    """Tune on one season, learn the next one, and judge it; goes on where it stopped."""
    from usvlearn.cli.train import work
    from usvlearn.report.build import evaluate, start_of
    from usvlearn.report.study import make_study

    def run(overrides, folder: Path) -> None:
        work(hydra.compose("train", list(overrides)), folder, overrides)

    season, commands = make_study(Path(cfg.folder), plain(cfg.study), tools.say, run, lambda at: start_of(at, tools))
    evaluate([season], Path(cfg.folder, "report"), tools, commands=commands, paper=True)


@command("evaluate")
def main(cfg: DictConfig) -> None:
    if cfg.study is None and cfg.runs is None:
        raise ConfigError("runs is not set: set runs=FOLDER, or give a run of `train`: usvlearn evaluate FOLDER")
    for key in ("runs", "report", "folder"):
        if OmegaConf.is_config(cfg[key]):
            raise ConfigError(f"{key}: found {cfg[key]!r}, expected a folder")
        cfg[key] = None if cfg[key] is None else str(cfg[key])  # 3 is a folder, too
    if cfg.study is not None and cfg.folder is None:
        raise ConfigError("folder is not set: take an experiment that makes a study, such as experiment=paper_small")
    if isinstance(cfg.trust, int | float):
        raise ConfigError(f"trust: found {cfg.trust!r}, expected a module, or a list")
    board = console()
    with Activity(board, "loading"):
        from usvlearn.report.build import Tools, evaluate
        from usvlearn.runs.saved import is_sweep, questions_of_runs, run_folders

        set_threads(1)
    tools = Tools(instantiate, ensemble_of, align_fleet, board, cfg.trust, partial(CheckedAlignment, console=board))
    if cfg.study is not None:
        study(cfg, tools)
    elif is_sweep(Path(cfg.runs)):
        leaderboard(Path(cfg.runs), load, cfg.objective)
    elif cfg.objective is not None:
        raise ConfigError(f"objective: ranks the jobs of a sweep, and {cfg.runs} is none: leave it out")
    else:
        data = cfg.get("data")
        inside = Path(cfg.runs, "report" if data is None else "report_of_other_logs")
        folders, asked = run_folders(cfg.runs), {} if data is None else open_questions(plain(cfg))
        show(*unconfirmed(questions_of_runs(folders, cfg.trust) | asked))
        if data is None and not (folders[-1] / "fit").exists():
            with Activity(board, "fitting the missions"):
                fit_on_the_way(folders[-1], console(quiet=True), cfg.trust)
        report = Path(cfg.report or inside)
        evaluate(folders, report, tools, data, asked=asked, animate=bool(cfg.animate), latex=bool(cfg.paper))
