"""Judge saved runs.

python evaluate.py runs=multirun/DIR     the jobs of a sweep, or any folder of runs: one table, the best first
"""

import os
import sys
from pathlib import Path

import hydra
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from usvlearn.errors import ConfigError, one_sentence
from usvlearn.evaluation.tables import sweep_table
from usvlearn.learning.leaderboard import write_leaderboard
from usvlearn.learning.sweep import THREADS, Job, jobs


def leaderboard(folder: Path) -> list[Job]:
    """Show and write the leaderboard of the runs below a folder."""
    found = jobs(folder, lambda path: OmegaConf.to_container(OmegaConf.load(path)))
    Console(markup=False).print(sweep_table([(job.settings, job.results) for job in found]))
    write_leaderboard(folder, found)
    return found


class Sweep(Callback):
    """What train.py does around a sweep; at its end the leaderboard, and exit code 2 where a job failed."""

    def on_multirun_start(self, config: DictConfig, **_) -> None:
        """One thread per worker, which finds this file wherever the sweep was started."""
        os.environ |= dict.fromkeys(THREADS, "1")
        os.environ["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])

    def on_multirun_end(self, config: DictConfig, **_) -> None:
        with one_sentence():
            if any("boats" not in job.results for job in leaderboard(Path(config.hydra.sweep.dir))):
                sys.exit(2)


@hydra.main(version_base="1.3", config_path="configs", config_name="evaluate")
def main(cfg: DictConfig) -> None:
    with one_sentence():
        if cfg.runs is None:
            raise ConfigError("runs is not set: set runs=FOLDER, a folder that train.py has written")
        leaderboard(Path(cfg.runs))


if __name__ == "__main__":
    main()
