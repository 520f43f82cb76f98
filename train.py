"""Replay runs through an ensemble, online: predict, then learn, then save what was learned.

python train.py                                           a simulated boat
python train.py data=blueboat data.path=LOGS              logs
python train.py -m estimators.rls.forgetting=0.99,0.995   a sweep
"""

import json
import sys
import time
import warnings
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress

from usvlearn import Ensemble, __version__
from usvlearn.errors import bad_input
from usvlearn.evaluation.metrics import fleet_scores, mean_mae
from usvlearn.evaluation.tables import report
from usvlearn.learning.replay import replay
from usvlearn.learning.run_folder import RESULTS, RunFolder
from usvlearn.learning.watch import Watch
from usvlearn.logs.fleet import align_fleet

console = Console()
warnings.formatwarning = lambda message, *_: f"warning: {message}\n"


def train(cfg: DictConfig, folder: Path) -> float:
    """Replay what the configuration names into the run's folder; returns the ensemble's MAE, m/s."""
    began, settings = time.perf_counter(), OmegaConf.to_container(cfg, resolve=True)
    torch.set_num_threads(cfg.threads)
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    with console.status("reading and aligning"):
        fleet = align_fleet(instantiate(cfg.data), **cfg.align)
    run = RunFolder(folder, fleet, {"configuration": settings, "version": __version__})
    start = run.begin(ensemble.init((len(fleet.boats),)), cfg.resume)
    console.print(start.note, end="\n" if start.note else "")
    save_every = max(1, round(60 * cfg.save_minutes / cfg.align.dt))
    with Watch(folder / "tensorboard", fleet, ensemble) as watch, Progress(console=console) as progress:
        bar = progress.add_task("replaying", total=fleet.steps)
        for chunk in replay(ensemble, fleet, start.state, start.position, watch.every, save_every):
            run.save(chunk)
            watch.show(chunk)
            progress.update(bar, completed=fleet.steps_before(*chunk.end))
        boats = fleet_scores(fleet, run.predictions, ensemble.names)
        watch.finish(settings, mean_mae(boats), run.predictions)
    objective, seconds = mean_mae(boats)[cfg.output], time.perf_counter() - began
    run.finish({"boats": boats, "rejected": fleet.rejected, "seconds": seconds, "objective": objective})
    console.print(report(boats, fleet.rejected))
    console.print(f"{seconds:.1f} s; MAE of {cfg.output}: {objective:.4f} m/s; results and parameter sets: {folder}")
    console.print(f"To look at the run: tensorboard --logdir {folder}", soft_wrap=True)
    return objective


@hydra.main(version_base="1.3", config_path="configs", config_name="train")
def main(cfg: DictConfig) -> float:
    """One job: bad input ends it with one sentence and exit code 2; in a sweep it is noted, and the rest go on."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        return train(cfg, folder)
    except Exception as error:
        if (cause := bad_input(error)) is None:
            raise
        print(f"error: {cause}", file=sys.stderr)
        if HydraConfig.get().mode != RunMode.MULTIRUN:
            sys.exit(2)
        (folder / RESULTS).write_text(json.dumps({"error": str(cause)}))
        return float("nan")


if __name__ == "__main__":
    main()
