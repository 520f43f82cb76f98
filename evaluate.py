"""Judge saved runs, or make a whole study.

python evaluate.py runs=outputs/RUN                 a report: errors, free runs, certificates, parameters
python evaluate.py runs=outputs/RUN data=blueboat data.path=LOGS      on other logs of the same boats
python evaluate.py runs=multirun/DIR                the jobs of a sweep: the leaderboard
python evaluate.py experiment=paper                 the paper's study from nothing, on a simulated fleet
"""

import sys
from pathlib import Path

import hydra
import torch
from hydra import compose
from hydra.errors import InstantiationException
from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from usvlearn import __version__
from usvlearn.errors import ConfigError, one_sentence
from usvlearn.learning.leaderboard import leaderboard
from usvlearn.learning.reports import Tools, evaluate, start_of
from usvlearn.learning.saved import is_sweep, run_folders
from usvlearn.learning.study import Study
from usvlearn.learning.sweep import prepare_workers
from usvlearn.logs.fleet import align_fleet
from usvlearn.simulate.truth import truth_of

TOOLS = Tools(instantiate, align_fleet, truth_of, Console(markup=False))


def compare(folder: str) -> bool:
    """The leaderboard of the runs below a folder; whether all are finished."""
    return leaderboard(Path(folder), lambda path: OmegaConf.to_container(OmegaConf.load(path)))


class Sweep(Callback):
    """What train.py does around a sweep: at its end the leaderboard, and exit code 2 where a job failed."""

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        prepare_workers(Path(__file__).parent)

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        with one_sentence():
            if not compare(config.hydra.sweep.dir):
                sys.exit(2)


def study(cfg: DictConfig) -> None:
    """Tune on one season, learn the next one, and judge it; goes on where it stopped."""
    from train import work

    def run(overrides: list[str], where: Path) -> None:
        work(compose("train", overrides), where, overrides)

    folder, plan = Path(cfg.folder), {**OmegaConf.to_container(cfg.study), "version": __version__}
    made = Study(folder, plan, TOOLS.say, run, choose=lambda where: start_of(where, TOOLS))
    season, gained = made.make()
    evaluate([season], folder / "report", TOOLS, more=[gained], commands=made.commands)


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    torch.set_num_threads(1)
    with one_sentence(InstantiationException):
        if cfg.study is not None:
            study(cfg)
        elif cfg.runs is None:
            raise ConfigError("runs is not set: set runs=FOLDER, a folder that train.py has written")
        elif is_sweep(Path(cfg.runs)):
            compare(cfg.runs)
        else:
            report = Path(cfg.report or Path(cfg.runs, "report"))
            evaluate(run_folders(cfg.runs), report, TOOLS, cfg.get("data"))


if __name__ == "__main__":
    main()
