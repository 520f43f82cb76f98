"""Replay runs through an ensemble, online: predict, then learn, then save what was learned.

python train.py data=blueboat data.path=LOGS              logs
python train.py -m estimators.rls.memory=10,30            a sweep; those of configs/sweep by name, sweep=inputs
"""

import shlex
import sys
import time
import warnings
from functools import partial
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress

from usvlearn import Ensemble, __version__
from usvlearn.errors import check_positive, one_sentence
from usvlearn.evaluation.metrics import alarms, fleet_scores, mean_mae
from usvlearn.evaluation.stability import stability
from usvlearn.evaluation.tables import report
from usvlearn.learning.replay import replay
from usvlearn.learning.run_folder import RunFolder, save_results
from usvlearn.learning.sweep import check_launcher, run_job
from usvlearn.learning.watch import Watch
from usvlearn.logs.fleet import align_fleet

warnings.formatwarning = lambda message, *_: f"warning: {message}\n"


def train(cfg: DictConfig, folder: Path, resume: str | None = None, quiet: bool = False) -> float:
    """Replay what the configuration names into the run's folder; returns the ensemble's MAE, m/s."""
    console = Console(markup=False, quiet=quiet)  # of its own: what a worker is sent must be picklable
    began, settings = time.perf_counter(), {**OmegaConf.to_container(cfg, resolve=True), "resume": None}
    torch.set_num_threads(max(1, int(check_positive("threads", cfg.threads))))
    save_every = 60 * check_positive("save_minutes", cfg.save_minutes, "of min") / check_positive("dt", cfg.align.dt)
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    with console.status("reading and aligning"):
        fleet = align_fleet(instantiate(cfg.data), **cfg.align)
    run = RunFolder(folder, fleet, {"configuration": settings, "version": __version__})
    console.print((start := run.begin(ensemble.init((len(fleet.boats),)), resume or cfg.resume)).note)
    with Watch(folder / "tensorboard", fleet, ensemble) as watch, Progress(console=console) as progress:
        bar = progress.add_task("replaying", total=fleet.steps)
        for chunk in replay(ensemble, fleet, start.state, start.position, watch.every, max(1, round(save_every))):
            run.save(chunk)
            watch.show(chunk)
            progress.update(bar, completed=fleet.steps_before(*chunk.end))
        boats, raised = fleet_scores(fleet, run.published, ensemble.names), alarms(fleet, run.published)
        objective, seconds = mean_mae(boats)[ensemble.output], time.perf_counter() - began
        found = {"boats": boats, "alarms": raised, "rejected": fleet.rejected}
        save_results(folder, {**found, "seconds": seconds, "objective": objective})
        watch.finish(settings, mean_mae(boats), run.published, raised)
    console.print(report(boats, fleet.rejected, raised))
    told = f"{seconds:.1f} s; MAE of {ensemble.output}: {objective:.4f} m/s; results and parameter sets: {folder}"
    look = f"To look at the run: tensorboard --logdir {shlex.quote(str(folder))}"
    console.print(*stability(ensemble, run.state, fleet.boats), told, look, sep="\n", soft_wrap=True)
    return objective


@hydra.main(version_base="1.3", config_path="configs", config_name="train")
def main(cfg: DictConfig) -> float:
    """One job: bad input ends it with one sentence and code 2; in a sweep it is noted, and the rest go on."""
    job, folder = HydraConfig.get(), Path(HydraConfig.get().runtime.output_dir)
    work = partial(train, cfg, folder, quiet=job.runtime.choices["hydra/launcher"] == "joblib")  # in one terminal
    with one_sentence(InstantiationException):
        if job.mode.name != "MULTIRUN":
            return work()
        return run_job(folder, OmegaConf.to_container(cfg), job.overrides.task, work, InstantiationException)


if __name__ == "__main__":
    with one_sentence():
        check_launcher(sys.argv[1:])
    main()
