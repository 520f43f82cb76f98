"""Replay runs through an ensemble, online: predict, then learn, then save what was learned.

python train.py data=blueboat data.path=LOGS              logs
python train.py -m estimators.rls.memory=10,30            a sweep
"""

import sys
import time
import warnings
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress

from usvlearn import Ensemble, __version__
from usvlearn.errors import bad_input, check_positive
from usvlearn.evaluation.stability import stability
from usvlearn.evaluation.tables import closing, report
from usvlearn.learning import tuning
from usvlearn.learning.replay import replay
from usvlearn.learning.run_folder import RunFolder, save_results
from usvlearn.learning.watch import Watch
from usvlearn.logs.fleet import align_fleet

console = Console(markup=False)
warnings.formatwarning = lambda message, *_: f"warning: {message}\n"


def train(cfg: DictConfig, folder: Path) -> float:
    """Replay what the configuration names into the run's folder; returns the ensemble's MAE, m/s."""
    began, settings = time.perf_counter(), {**OmegaConf.to_container(cfg, resolve=True), "resume": None}
    torch.set_num_threads(max(1, int(check_positive("threads", cfg.threads))))
    save_every = 60 * check_positive("save_minutes", cfg.save_minutes, "of min") / check_positive("dt", cfg.align.dt)
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    with console.status("reading and aligning"):
        fleet = align_fleet(instantiate(cfg.data), **cfg.align)
    run = RunFolder(folder, fleet, {"configuration": settings, "version": __version__})
    console.print((start := run.begin(ensemble.init((len(fleet.boats),)), cfg.resume)).note)
    with Watch(folder / "tensorboard", fleet, ensemble) as watch, Progress(console=console) as progress:
        bar = progress.add_task("replaying", total=fleet.steps)
        for chunk in replay(ensemble, fleet, start.state, start.position, watch.every, max(1, round(save_every))):
            run.save(chunk)
            watch.show(chunk)
            progress.update(bar, completed=fleet.steps_before(*chunk.end))
        found = run.finish(ensemble, time.perf_counter() - began)
        watch.finish(settings, found["boats"], run.published, found["alarms"])
    console.print(report(found["boats"], fleet.rejected, found["alarms"]))
    console.print(*stability(ensemble, run.state, fleet.boats), *closing(found, folder), sep="\n", soft_wrap=True)
    return found["objective"]


def tune(cfg: DictConfig, folder: Path) -> float:
    """Tune the one estimator that `grid`, `learn` or `search` names; returns its best MAE, m/s."""
    settings, overrides = OmegaConf.to_container(cfg, resolve=True), HydraConfig.get().overrides.task
    return tuning.tune(settings, folder, instantiate, align_fleet, overrides, console)


@hydra.main(version_base="1.3", config_path="configs", config_name="train")
def main(cfg: DictConfig) -> float:
    """One job: bad input ends it with one sentence and code 2; in a sweep it is noted, and the rest go on."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        return (tune if tuning.asked(cfg) else train)(cfg, folder)
    except Exception as error:
        if (cause := bad_input(error, hydra.errors.InstantiationException)) is None:
            raise
        print(f"error: {cause}", file=sys.stderr)
        if HydraConfig.get().mode.name != "MULTIRUN":
            sys.exit(2)
        save_results(folder, {"error": cause})
        return float("nan")


if __name__ == "__main__":
    main()
