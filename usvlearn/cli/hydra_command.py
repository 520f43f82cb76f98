"""The start and the end of train.py and evaluate.py: Hydra's `main`, with our own messages, signals and exit codes.

exit code   0 done   1 a bug, with its traceback   2 bad input, or a disk that is full, in one sentence
            130 Ctrl-C   143 SIGTERM, with the command that continues
"""

from __future__ import annotations

import argparse
import functools
import logging
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from usvlearn.cli.signals import Stopped, in_program, stoppable, stoppable_worker, was_stopped
from usvlearn.cli.sweep import Sweep, again, cut_short, end_progress, load
from usvlearn.composition.configuration import configs_folder
from usvlearn.composition.data_files import SUFFIXES, hint_of_data, with_data_files
from usvlearn.composition.errors import in_one_sentence, known_names
from usvlearn.display import terminal
from usvlearn.errors import ConfigError, UsvlearnError, complain, did_you_mean, exit_on_user_error
from usvlearn.sweeps.launchers import check_launcher
from usvlearn.sweeps.leaderboard import leaderboard
from usvlearn.sweeps.seeds import with_seeds

FULL_ERROR = "HYDRA_FULL_ERROR"  # of Hydra: errors are raised, not printed


def command(name: str) -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make a command from a function of the configuration configs/NAME.yaml."""

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
        configs = configs_folder()

        @functools.wraps(task)
        def job(cfg: DictConfig) -> Any:  # a launcher sends this function to its workers
            return _in_program(task, cfg) if in_program() else _in_worker(task, cfg)

        start = hydra.main(version_base="1.3", config_path=str(configs), config_name=name)(job)

        @functools.wraps(task)
        def main() -> None:
            with exit_on_user_error(), stoppable():
                terminal.asked[:] = [each for each in sys.argv[1:] if each == terminal.ALL]
                sys.argv[1:] = flags_first([each for each in sys.argv[1:] if each != terminal.ALL])
                if name == "train":
                    sys.argv[1:] = with_seeds(sys.argv[1:])
                sys.argv[1:] = with_data_files(with_keys(name, sys.argv[1:], parse(sys.argv[1:]).overrides))
                flags = parse(sys.argv[1:])
                check_launcher(flags.overrides)
                folder, main_file = configs.parent / (flags.config_path or configs), flags.config_name or name
                _run(start, known_names(folder, main_file, flags.overrides, flags.config_dir))

        return main

    return decorate


def _in_program(task: Callable[[DictConfig], Any], cfg: DictConfig) -> Any:
    try:
        with exit_on_user_error(), in_one_sentence():
            return task(cfg)
    except (Exception, KeyboardInterrupt, Stopped) as error:
        if (stopped := _stopped_by(error)) is None:
            raise
        stopped.folder = Path(HydraConfig.get().runtime.output_dir)
        raise stopped from None


def _in_worker(task: Callable[[DictConfig], Any], cfg: DictConfig) -> Any:
    try:
        with stoppable_worker():
            return task(cfg)
    except Stopped:
        return float("nan")


def _run(start: Callable[[], None], names: Callable[[str], Sequence[str]]) -> None:
    """Run Hydra; if anything ends it early, print one sentence."""
    Sweep.folder, Sweep.lock, Sweep.lost, Sweep.outlived = None, None, [], ""
    try:
        with _raising(), in_one_sentence(names):
            start()
    except (Exception, KeyboardInterrupt, Stopped) as error:
        end_progress()
        if stopped := _stopped_by(error):
            _end(stopped)
        if Sweep.folder is None or (sentence := cut_short(error)) is None:
            raise
        _show_sweep()
        raise ConfigError(f"{sentence}; continue with: {again(Sweep.folder, None)}") from error
    finally:
        end_progress()
        if Sweep.lock is not None:
            Sweep.lock.release()


def _stopped_by(error: BaseException) -> Stopped | None:
    """The signal that caused an error: raised where it arrived, or by breaking a worker or a compilation."""
    return error if isinstance(error, Stopped) else was_stopped()


@contextmanager
def _raising() -> Iterator[None]:
    """Let Hydra raise its errors."""
    before = os.environ.get(FULL_ERROR)
    os.environ[FULL_ERROR] = "1"
    try:
        yield
    finally:
        os.environ.pop(FULL_ERROR)
        if before is not None:
            os.environ[FULL_ERROR] = before


def _end(stopped: Stopped) -> NoReturn:
    """Print the command that continues, and exit."""
    logging.getLogger("torch").setLevel(logging.ERROR)  # a half-imported torch would log at exit
    _show_sweep()
    complain(f"{stopped}{Sweep.outlived}; continue with: {again(Sweep.folder, stopped.folder)}")
    sys.exit(stopped.code)


def _show_sweep() -> None:
    """Show the leaderboard of the finished jobs."""
    if Sweep.folder is not None:
        with suppress(UsvlearnError, OSError):
            leaderboard(Sweep.folder, load)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Hydra's flags and the overrides; a ConfigError where a flag is unknown, or lacks its value."""
    parser = get_args_parser()
    flags = re.findall(r"--[\w-]+", parser.format_usage())

    def refuse(message: str) -> NoReturn:
        wrong = re.search(r"unrecognized arguments: (\S+)", message)
        raise ConfigError(f"{message}{(wrong and did_you_mean(wrong[1], flags)) or ': see the flags by --hydra-help'}")

    parser.error = refuse  # type: ignore[method-assign]  # argparse calls this method, and would end the program
    return parser.parse_intermixed_args(arguments)


def flags_first(arguments: Sequence[str]) -> list[str]:
    """The arguments, flags before overrides: Hydra reads no flag between two overrides."""
    overrides, flags = parse(arguments).overrides, list(arguments)
    for each in overrides:
        flags.remove(each)
    return [*flags, *overrides]


def with_keys(name: str, arguments: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """The arguments of train or evaluate, in which a file or folder without a key has the key that it is meant for."""
    meant = {each: _meant(name, each) for each in overrides if "=" not in each and not each.startswith("~")}
    given = [each for each in meant.values() if each.startswith("runs=")]
    if len(given) > 1:
        raise ConfigError(f"runs: found {len(given)} folders, expected one: give one that holds all of them")
    return [meant.get(each, each) for each in arguments]


def _meant(name: str, word: str) -> str:
    path = Path(word).expanduser()
    if path.suffix in SUFFIXES:
        if not path.is_file():
            raise ConfigError(f"data: found {word!r}, but there is no such file{hint_of_data(word)}")
        return f"data={shlex.quote(word) if set(word) & set(' ,') else word}"
    if name == "evaluate":
        if path.is_file():
            raise ConfigError(f"runs: found the file {word!r}, expected a folder that `train` has written")
        if not path.is_dir():
            wanted = "name one that `train` has written"
            raise ConfigError(f"runs: found {word!r}, but there is no such folder: {wanted}")
        return f"runs={word}"
    if path.exists():
        raise ConfigError(f"data: found {word!r}{hint_of_data(word)}")
    if "/" in word or path.suffix:
        raise ConfigError(f"data: found {word!r}, but there is no such file: correct the path")
    names = [f"data.{each.stem}" for each in (configs_folder() / "data").glob("*.yaml")]
    hint = did_you_mean(word, names).replace("data.", "data=")
    raise ConfigError(f"{word}: found no value, expected KEY=VALUE, or a file such as my_boat.yaml{hint}")
