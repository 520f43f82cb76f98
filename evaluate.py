"""Judge saved runs.

python evaluate.py runs=multirun/DIR     the jobs of a sweep, or any folder of runs: one table, the best first
"""

import sys
from pathlib import Path

import hydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from usvlearn.errors import ConfigError, one_sentence
from usvlearn.learning.leaderboard import leaderboard
from usvlearn.learning.sweep import prepare_workers


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


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    with one_sentence():
        if cfg.runs is None:
            raise ConfigError("runs is not set: set runs=FOLDER, a folder that train.py has written")
        compare(cfg.runs)


if __name__ == "__main__":
    main()
