"""Judge saved runs, or make a whole study.

python evaluate.py runs=outputs/RUN                 a report: errors, free runs, certificates, parameters
python evaluate.py runs=multirun/DIR                the jobs of a sweep: the leaderboard
python evaluate.py experiment=paper                 the paper's study from nothing, on a simulated fleet
"""

from functools import partial
from pathlib import Path

import hydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from usvlearn.errors import one_sentence  # what needs torch is imported where it is used: --help is quick
from usvlearn.evaluation.terminal import console
from usvlearn.learning.launchers import prepare_workers, set_threads
from usvlearn.learning.leaderboard import leaderboard
from usvlearn.learning.sweep import check_sweep
from usvlearn.lock import Lock
from usvlearn.logs.fleet import align_fleet


def load(path: Path) -> object:
    return OmegaConf.to_container(OmegaConf.load(path))


class Sweep(Callback):
    """What train.py does around a run: lock its folder; after a sweep the leaderboard, and code 2 if a job failed."""

    def on_run_start(self, config: DictConfig, **_) -> None:
        with one_sentence():  # a search is made by several processes together
            self.lock = Lock(Path(config.hydra.run.dir), "hydra.run.dir", shared=config.get("search") is not None)

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        with one_sentence():
            check_sweep(Path(config.hydra.sweep.dir), load, OmegaConf.to_container(config.hydra))
            prepare_workers(Path(__file__).parent)

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        with one_sentence():
            if not leaderboard(Path(config.hydra.sweep.dir), load):
                raise SystemExit(2)


def study(cfg: DictConfig, tools) -> None:
    """Tune on one season, learn the next one, and judge it; goes on where it stopped."""
    from train import work
    from usvlearn.learning.reports import evaluate, start_of
    from usvlearn.learning.study import Study
    from usvlearn.learning.tuning import request

    plain = partial(OmegaConf.to_container, resolve=True)
    made = Study(
        Path(cfg.folder), plain(cfg.study), tools.say, choose=lambda folder: start_of(folder, tools),
        run=lambda overrides, folder: work(hydra.compose("train", overrides), folder, overrides),
        check=lambda overrides: request(plain(hydra.compose("train", overrides)), hydra.utils.instantiate),
    )  # fmt: skip
    season, gained = made.make()
    evaluate([season], Path(cfg.folder, "report"), tools, more=[gained], commands=made.commands)


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    from usvlearn.learning.reports import Tools, evaluate
    from usvlearn.learning.saved import is_sweep, run_folders
    from usvlearn.simulate.truth import truth_of

    set_threads(1)
    tools = Tools(hydra.utils.instantiate, align_fleet, truth_of, console(), cfg.trust)
    with one_sentence(hydra.errors.InstantiationException):
        if cfg.study is not None:
            study(cfg, tools)
        elif is_sweep(cfg.runs):
            leaderboard(Path(cfg.runs), load)
        else:
            evaluate(run_folders(cfg.runs), Path(cfg.report or Path(cfg.runs, "report")), tools, cfg.get("data"))


if __name__ == "__main__":
    main()
