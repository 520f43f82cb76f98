"""The frame of a sweep: check its folder before, and make its leaderboard after, also if the sweep was interrupted."""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import usvlearn
from usvlearn.cli.mistakes import in_one_sentence
from usvlearn.cli.stopping import defer_signals, end_deferral
from usvlearn.errors import ConfigError, exit_on_user_error
from usvlearn.lock import Lock
from usvlearn.sweeps.jobs import check_sweep, run_job
from usvlearn.sweeps.launchers import check_launcher, prepare_workers
from usvlearn.sweeps.leaderboard import leaderboard


def load(path: Path) -> Any:
    """A YAML file as lists and dictionaries.

    Raises:
        ConfigError: it is damaged, or Hydra has not written it.
    """
    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(path.read_text())):
            raise ValueError("it has a YAML alias; a few of them can expand to gigabytes")
        return OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: is damaged ({' '.join(str(error).split())[:200]}): run that job again") from error


def do_job(cfg: DictConfig, work: Callable[..., float]) -> float:
    """Run train.py's work, alone or as one job of a sweep. Returns the objective, m/s."""
    job, folder = HydraConfig.get(), Path(HydraConfig.get().runtime.output_dir)
    ask = partial(work, cfg, folder, job.overrides.task, quiet=job.runtime.choices["hydra/launcher"] == "joblib")
    if job.mode is not RunMode.MULTIRUN:
        return ask()
    settings: Any = OmegaConf.to_container(cfg)
    return run_job(folder, settings, job.overrides.task, ask, swept(Path(job.sweep.dir)))


def swept(folder: Path) -> list[str]:
    """The keys with several values in the command of a sweep, as Hydra records it in the sweep's folder."""
    if not (folder / "multirun.yaml").exists():
        return []
    noted = load(folder / "multirun.yaml")["hydra"]
    given = [f"{key}={values}" for key, values in (noted["sweeper"].get("params") or {}).items()]
    parsed = OverridesParser.create().parse_overrides([*given, *noted["overrides"]["task"]])
    last = {each.get_key_element(): each for each in parsed}  # the command overrides the file
    return [key for key, each in last.items() if each.is_sweep_override()]


class Sweep(Callback):
    """Lock a run's folder; at the end of a sweep show its leaderboard, and end with code 2 where a job failed."""

    folder: Path | None = None  # of the sweep that this process has started
    lock: Lock | None = None  # of the run

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        with exit_on_user_error(), in_one_sentence():  # a search is made by several processes together
            if not config.hydra.run.dir:
                raise ConfigError("hydra.run.dir: found nothing, expected a folder: leave it out, or name one")
            Sweep.lock = Lock(Path(config.hydra.run.dir), "hydra.run.dir", shared=config.get("search") is not None)

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        own: Any = OmegaConf.to_container(config.hydra)
        with exit_on_user_error():
            check_launcher([f"hydra/launcher={config.hydra.runtime.choices['hydra/launcher']}"])  # of any file
            check_sweep(folder, load, own)
            prepare_workers(Path(usvlearn.__file__).parents[1])
        Sweep.folder = folder
        if "joblib" in config.hydra.launcher._target_:
            defer_signals()  # a signal is passed on to the workers, which finish their chunk

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        end_deferral()
        with exit_on_user_error():
            if not leaderboard(Path(config.hydra.sweep.dir), load):
                sys.exit(2)


def cut_short(error: BaseException) -> str | None:
    """The sentence if a launcher has lost a worker or could not start one; None for any other error."""
    text = " ".join(str(error).split())
    if isinstance(error, BrokenProcessPool):
        return "hydra/launcher=joblib: a worker was killed, perhaps for want of memory: set fewer hydra.launcher.n_jobs"
    if type(error).__module__.startswith("submitit"):
        return f"hydra/launcher: {text[:300]}: see whether the cluster can be reached, and the jobs' logs"
    return None
