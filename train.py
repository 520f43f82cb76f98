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
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress

from usvlearn import Ensemble, __version__
from usvlearn.checkpoint import write_atomically
from usvlearn.errors import MissingExtraError, bad_input
from usvlearn.evaluation.metrics import fleet_scores, mean_mae
from usvlearn.evaluation.tables import fleet_table, rejection_table, score_table
from usvlearn.learning.replay import replay
from usvlearn.learning.run_folder import RunFolder
from usvlearn.learning.watch import Watch, interval
from usvlearn.logs.fleet import align_fleet
from usvlearn.tensorboard import Board

console = Console()
warnings.formatwarning = lambda message, *_: f"warning: {message}\n"


def train(cfg: DictConfig, folder: Path) -> float:
    """Replay what the configuration names into the run's folder; returns the ensemble's MAE, m/s."""
    began = time.perf_counter()
    torch.set_num_threads(cfg.threads)
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    with console.status("reading and aligning"):
        fleet = align_fleet(instantiate(cfg.data), **cfg.align)
    save_every = max(1, round(60 * cfg.save_minutes / cfg.align.dt))
    settings = OmegaConf.to_container(cfg, resolve=True)
    run = RunFolder(folder, fleet, {"configuration": settings, "version": __version__})
    start = run.begin(ensemble.init((len(fleet.boats),)), cfg.resume)
    if start.note:
        console.print(start.note)

    predictions = start.predictions
    with Board(folder / "tensorboard") as board, Progress(console=console) as progress:
        watch = Watch(board, fleet, ensemble)
        bar = progress.add_task("replaying", total=fleet.steps)
        for chunk in replay(ensemble, fleet, start.state, start.position, interval(fleet), save_every):
            run.save(chunk)
            watch.show(chunk)
            predictions[chunk.end.run].append(chunk.predictions)
            progress.update(bar, completed=fleet.steps_before(*chunk.end))
        whole = [np.concatenate(chunks) for chunks in predictions]
        boats = fleet_scores(fleet, whole, ensemble.names)
        try:
            watch.finish(settings, mean_mae(boats), whole)
        except MissingExtraError as error:
            console.print(f"no figure: {error}")

    tables = [rejection_table(fleet.rejected), score_table(boats), fleet_table(boats) if len(boats) > 1 else None]
    for table in filter(None, tables):
        console.print(table)
    objective = mean_mae(boats)[cfg.output]
    results = {"boats": boats, "rejected": fleet.rejected, "seconds": time.perf_counter() - began}
    results |= {"objective": None if objective != objective else objective, "output": cfg.output}
    write_atomically(folder / "results.json", json.dumps(results, indent=2, allow_nan=False).encode())
    console.print(f"{results['seconds']:.1f} s; results and parameter sets: {folder}")
    console.print(f"To look at the run: tensorboard --logdir {folder}", soft_wrap=True)
    return objective


@hydra.main(version_base="1.3", config_path="configs", config_name="train")
def main(cfg: DictConfig) -> float:
    """One job: bad input ends it with one sentence and exit code 2; in a sweep it is noted, and the rest go on."""
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    try:
        return train(cfg, folder)
    except Exception as error:
        if (cause := bad_input(error)) is None:
            raise
        print(f"error: {cause}", file=sys.stderr)
        if job.mode != RunMode.MULTIRUN:
            sys.exit(2)
        write_atomically(folder / "results.json", json.dumps({"error": str(cause)}).encode())
        return float("nan")


if __name__ == "__main__":
    main()
