"""Checks the folder of a sweep before it starts, and makes its leaderboard after, also if the sweep was interrupted."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from functools import cache, partial, wraps
from pathlib import Path
from typing import Any, ClassVar

import yaml
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import usvlearn
from usvlearn.cli.signals import defer_signals, end_deferral
from usvlearn.composition.errors import in_one_sentence
from usvlearn.core.lock import Lock
from usvlearn.core.safe_yaml import has_alias
from usvlearn.display.terminal import Activity, console
from usvlearn.errors import ConfigError, exit_on_user_error
from usvlearn.evaluation.objective import measure_of
from usvlearn.runs.files import JOURNAL, RUNS, check_own
from usvlearn.sweeps.jobs import SweepNote, check_sweep, note_sweep, noted_sweep, run_job
from usvlearn.sweeps.launchers import check_launcher, prepare_workers
from usvlearn.sweeps.leaderboard import check_own_board, leaderboard
from usvlearn.sweeps.progress import Progress

PERIOD = 60  # s between two questions to Slurm, at most; results are files, and are seen without a question
QUEUE = ["squeue", "--noheader", "--array", "--format=%i"]  # the numbers of the jobs that have not ended
NUMBER = 2  # the place of a job's number among the arguments of Hydra's launcher


def load(path: Path) -> Any:
    """A YAML file as lists and dictionaries; a ConfigError if it is damaged, or Hydra has not written it."""
    try:
        if has_alias(path.read_text()):
            raise ValueError("it has a YAML alias; a few of them can expand to gigabytes")
        return OmegaConf.to_container(OmegaConf.load(path))
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ConfigError(f"{path}: is damaged ({' '.join(str(error).split())[:200]}): run that job again") from error


def do_job(cfg: DictConfig, work: Callable[..., float]) -> float:
    """Run train.py's work, alone or as one job of a sweep. Returns the objective, or what a sweep minimises."""
    job, folder = HydraConfig.get(), Path(HydraConfig.get().runtime.output_dir)
    several = job.mode is RunMode.MULTIRUN
    ask = partial(work, cfg, folder, job.overrides.task, quiet=several)
    if not several:
        return ask()
    settings: Any = OmegaConf.to_container(cfg)
    return run_job(folder, settings, job.overrides.task, ask, noted_sweep(Path(job.sweep.dir)))


def jobs_of(hydra: DictConfig) -> tuple[list[str], list[dict[str, str]]]:
    """The keys with several values in a sweep's command or file, and the settings of its jobs, by key."""
    params = hydra.sweeper.get("params") or {}
    given = [*(f"{key}={values}" for key, values in params.items()), *hydra.overrides.task]
    parsed = {each.get_key_element(): each for each in OverridesParser.create().parse_overrides(given)}
    swept = [key for key, each in parsed.items() if each.is_sweep_override()]  # the command overrides the file
    if any(not parsed[key].is_discrete_sweep() for key in swept):  # of another sweeper, which draws them
        return swept, []
    (batch,) = BasicSweeper.split_arguments(list(parsed.values()), None)
    return swept, [{key: value for key, _, value in (each.partition("=") for each in overrides)} for overrides in batch]


def note_of(config: DictConfig, swept: Sequence[str]) -> SweepNote:
    """What is noted of a sweep before it starts, from a configuration composed without the swept keys."""
    choices, defaults = config.hydra.runtime.choices, {}
    for key in swept:
        if key.startswith(("+", "~")):
            continue
        value = choices[key] if key in choices else OmegaConf.select(config, key)
        if value is not None and not isinstance(value, DictConfig):
            defaults[key] = as_value(value)
    return SweepNote(tuple(swept), defaults, config.get("objective"))


def check_objective(config: DictConfig, swept: Sequence[str]) -> None:
    """Raise a ConfigError before any job starts if the objective has another form, or is swept itself."""
    if "objective" in swept:
        raise ConfigError("objective: found several, expected one that ranks all jobs: evaluate.py ranks them anew")
    if (given := config.get("objective")) is not None:
        measure_of(given, "")


def as_value(value: Any) -> str:
    """A value as a command gives it."""
    if OmegaConf.is_list(value):
        return f"[{','.join(map(as_value, value))}]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def compose_every_value(sweeper: BasicSweeper, jobs: Sequence[Sequence[str]]) -> None:
    """Compose jobs that contain every value of a sweep, with every combination of its configuration files.

    Hydra itself composes each job of a grid here, one after the other, before the first starts (a third of a second for
    each), and once more where the job runs. Which keys a job has depends on its files, not on its other values.
    """
    assert sweeper.hydra_context is not None
    loader: Any = sweeper.hydra_context.config_loader

    @cache
    def is_file(key: str) -> bool:
        return loader.repository.group_exists(key.lstrip("+~").partition("@")[0])

    composed: set[tuple[tuple[str, ...], str]] = set()
    for job in jobs:
        files = tuple(each for each in job if is_file(each.partition("=")[0]))
        if not composed.issuperset(values := {(files, each) for each in job}):
            loader.load_sweep_config(master_config=sweeper.config, sweep_overrides=list(job))
            composed |= values


class Sweep(Callback):
    """Lock a run's folder; tell the jobs of a sweep, show its leaderboard, and end with code 2 where a job failed."""

    folder: Path | None = None  # of the sweep that this process has started
    lock: Lock | None = None  # of the run
    progress: Progress | None = None
    shown: ClassVar[ExitStack] = ExitStack()  # what a terminal shows while the jobs run
    lost: ClassVar[list[int]] = []  # jobs of the sweep whose process was killed
    outlived = ""  # what a signal does not end

    def on_run_start(self, config: DictConfig, **_: Any) -> None:
        with exit_on_user_error(), in_one_sentence():  # a search is made by several processes together
            if not config.hydra.run.dir:
                raise ConfigError("hydra.run.dir: found nothing, expected a folder: leave it out, or name one")
            check_own(Path(config.hydra.run.dir))
            Sweep.lock = Lock(Path(config.hydra.run.dir), "hydra.run.dir", shared=config.get("search") is not None)

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        settings: Any = OmegaConf.to_container(config.hydra)
        Sweep.shown.enter_context(Activity(console(), "the jobs"))
        with exit_on_user_error(), in_one_sentence():
            check_launcher([f"hydra/launcher={config.hydra.runtime.choices['hydra/launcher']}"])  # of any file
            check_sweep(folder, load, settings)
            check_own_board(folder, "hydra.sweep.dir")
            swept, jobs = jobs_of(config.hydra)
            check_objective(config, swept)
            note = note_of(config, swept)
            note_sweep(folder, note)
            prepare_workers(Path(usvlearn.__file__).parents[1])
        from hydra._internal.core_plugins import basic_sweeper  # Hydra has made the class anew as it looked for plugins

        basic_sweeper.BasicSweeper.validate_batch_is_legal = compose_every_value  # type: ignore[assignment, method-assign]
        Sweep.folder = folder
        if "joblib" in config.hydra.launcher._target_:
            defer_signals()  # a signal is passed on to the workers, which finish their chunk
        if settings["sweep"]["subdir"] == "${hydra.job.num}":
            Sweep.progress = Progress(folder, jobs, note, partial(print, flush=True))
            Sweep.progress.start()
        if "submitit" in config.hydra.launcher._target_:
            wait_for_all(Sweep.lost)
        if "Slurm" in config.hydra.launcher._target_:
            Sweep.outlived = f", but not its jobs in Slurm, which scancel --name={config.hydra.launcher.name} ends"

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        end_progress()
        end_deferral()
        folder = Path(config.hydra.sweep.dir)
        with exit_on_user_error():
            if leaderboard(folder, load):
                return
            if Sweep.lost:
                raise ConfigError(
                    f"hydra/launcher: jobs {Sweep.lost} were killed; continue with: {again(folder, None)}"
                )
            sys.exit(2)


def end_progress() -> None:
    """Say what happened to the last jobs, if a sweep is told; a terminal shows no activity any more."""
    if Sweep.progress is not None:
        Sweep.progress.stop()
        Sweep.progress = None
    Sweep.shown.close()


def cut_short(error: BaseException) -> str | None:
    """The sentence if a launcher has lost a worker or could not start one; None for any other error."""
    text = " ".join(str(error).split())
    if isinstance(error, BrokenProcessPool):
        return "hydra/launcher=joblib: a worker was killed, perhaps for want of memory: set fewer hydra.launcher.n_jobs"
    if type(error).__module__.startswith("submitit"):
        return f"hydra/launcher: {text[:300]}: see whether the cluster can be reached, and the jobs' logs"
    return None


def again(sweep: Path | None, run: Path | None) -> str:
    """The command that continues in the folder of a sweep, or of a run, or starts anew if nothing was saved."""
    more = []
    if sweep is not None:
        more = [f"hydra.sweep.dir={sweep}"]
    elif run is not None and (run / RUNS).exists():
        more = [f"hydra.run.dir={run}", "resume=latest"]
    elif run is not None and (run / JOURNAL).exists():
        more = [f"hydra.run.dir={run}"]
    keys, script, *arguments = [each.partition("=")[0] for each in more], *sys.argv
    overrides = [each for each in arguments if each.startswith("~") or ("=" in each and not each.startswith("-"))]
    flags = [each for each in arguments if each not in overrides]  # flags must not stand between overrides
    staying = [each for each in overrides if each.partition("=")[0] not in keys]
    program = ["python", script] if script.endswith(".py") else script.split(" ")  # else the command `usvlearn train`
    return shlex.join([*program, *flags, *staying, *more])


def wait_for_all(lost: list[int]) -> None:
    """Let the launchers of submitit wait until every job has ended, on Slurm or here; `lost` gets the killed ones.

    Submitit raises an error for the first job that left no result, while others still run. Here the job is noted, its
    objective is NaN, and the others are waited for. Submitit asks `sacct` which jobs have ended. That needs a database,
    which not every cluster has, and without it a killed job would be waited for without end. Here `squeue` is asked.
    """
    from submitit.core.core import Job
    from submitit.core.utils import FailedJobError, UncompletedJobError
    from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

    class Queue(SlurmInfoWatcher):
        def _make_command(self) -> list[str] | None:
            return [*QUEUE, f"--user={os.getuid()}"] if self._registered - self._finished else None

        def read_info(self, string: bytes | str) -> dict[str, dict[str, str]]:
            queued = (string if isinstance(string, str) else string.decode()).split()
            return {job: {"State": "RUNNING" if job in queued else "ENDED"} for job in self._registered}

    results = getattr(Job.results, "__wrapped__", Job.results)

    @wraps(results)
    def results_or_nan(job: Job) -> list[Any]:
        try:
            return results(job)
        except (UncompletedJobError, FailedJobError):
            number = job.submission().args[NUMBER]
            lost.append(number)
            print(f"error: job {number}: its process has ended before the job: see {job.paths.stderr}", file=sys.stderr)
            return [JobReturn(status=JobStatus.COMPLETED, _return_value=float("nan"))]

    job_class: Any = Job  # a type checker allows no other method in the place of one
    job_class.results = results_or_nan
    SlurmJob.watcher = Queue(PERIOD)
