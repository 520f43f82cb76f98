"""Replay runs through an ensemble, online: predict, then learn, then save what was learned.

python train.py data=blueboat data.path=LOGS              logs
python train.py grid=aid                                  tune a member; learn=aid and search=aid, too
python train.py -m estimators.rls.memory=10,30            a sweep; or sweep=inputs, of configs/sweep
"""

import sys
import time
from functools import partial
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.progress import Progress

import usvlearn  # what needs torch is imported where it is used: --help must not wait for it
from usvlearn.errors import check_positive, one_sentence
from usvlearn.evaluation import terminal
from usvlearn.evaluation.tables import closing, report
from usvlearn.learning.launchers import check_launcher, set_threads
from usvlearn.learning.sweep import run_job
from usvlearn.logs.fleet import align_fleet


def work(cfg: DictConfig, folder: Path, overrides: list[str], resume: str | None = None, quiet=False) -> float:
    """Do what is asked for, a replay or tuning; quiet where workers share the terminal. Returns the MAE, m/s."""
    from usvlearn.learning import tuning

    console = terminal.console(quiet)  # of its own: what a worker is sent must be picklable
    if not tuning.asked(cfg):
        return train(cfg, folder, console, resume or cfg.resume)
    return tuning.tune(OmegaConf.to_container(cfg, resolve=True), folder, instantiate, align_fleet, overrides, console)


def train(cfg: DictConfig, folder: Path, console: Console, resume: str | None) -> float:
    """Replay what the configuration names into the run's folder; returns the ensemble's MAE, m/s."""
    from usvlearn.evaluation.members import explained, remarks
    from usvlearn.evaluation.stability import stability
    from usvlearn.learning.replay import replay
    from usvlearn.learning.run_folder import RunFolder
    from usvlearn.learning.watch import Watch

    began, settings = time.perf_counter(), {**OmegaConf.to_container(cfg, resolve=True), "resume": None}
    set_threads(cfg.threads)
    save_every = 60 * check_positive("save_minutes", cfg.save_minutes, "of min") / check_positive("dt", cfg.align.dt)
    ensemble = usvlearn.Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
    with console.status("reading and aligning"):
        fleet = align_fleet(instantiate(cfg.data), **cfg.align)
    run = RunFolder(folder, fleet, {"configuration": settings, "kernel": ensemble.kernel()})
    console.print((start := run.begin(ensemble.init((len(fleet.boats),)), resume)).note)
    with run, Watch(folder / "tensorboard", fleet, ensemble) as watch, Progress(console=console) as progress:
        bar = progress.add_task("replaying", total=fleet.steps)
        for chunk in replay(ensemble, fleet, start.state, start.position, watch.every, max(1, round(save_every))):
            run.save(chunk)
            watch.show(chunk)
            progress.update(bar, completed=fleet.steps_before(*chunk.end))
        found = run.finish(ensemble, time.perf_counter() - began)
        watch.finish(settings, found["boats"], run.published, found["alarms"])
    console.print(report(found["boats"], fleet.rejected, found["alarms"], remarks(ensemble), explained(ensemble)))
    console.print(*stability(ensemble, run.state, fleet.boats), *closing(found, folder), sep="\n", soft_wrap=True)
    return found["objective"]


def swept(folder: Path) -> list[str]:
    """The keys to which the command of a sweep gives several values, as Hydra notes it in the sweep's folder."""
    if not (folder / "multirun.yaml").exists():
        return []
    noted = OmegaConf.to_container(OmegaConf.load(folder / "multirun.yaml"))["hydra"]
    given = [f"{key}={values}" for key, values in (noted["sweeper"].get("params") or {}).items()]
    parsed = OverridesParser.create().parse_overrides([*given, *noted["overrides"]["task"]])
    last = {each.get_key_element(): each for each in parsed}  # the command's own stand above the file's
    return [key for key, each in last.items() if each.is_sweep_override()]


@hydra.main(version_base="1.3", config_path="configs", config_name="train")
def main(cfg: DictConfig) -> float:
    """One job: bad input ends it with one sentence and code 2; in a sweep it is noted, and the rest go on."""
    job, folder = HydraConfig.get(), Path(HydraConfig.get().runtime.output_dir)
    ask = partial(work, cfg, folder, job.overrides.task, quiet=job.runtime.choices["hydra/launcher"] == "joblib")
    with one_sentence(InstantiationException):
        if job.mode.name != "MULTIRUN":
            return ask()
        keys = swept(Path(job.sweep.dir))
        return run_job(folder, OmegaConf.to_container(cfg), job.overrides.task, ask, InstantiationException, keys)


if __name__ == "__main__":
    check_launcher(sys.argv[1:])
    main()
