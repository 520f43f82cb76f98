"""Turns paths on the command line into `data=` and `runs=`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from usvlearn.cli.configs import configs_folder
from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.runs.file_names import CHECKPOINTS, RUNS

SUFFIXES = (".yaml", ".yml")  # of a configuration of data
SETS = (".safetensors", ".json")  # of files in a run
RUN_KEYS = ("runs=", "run=")  # which `evaluate` needs, and plan, export and controller do not


def with_keys(name: str, arguments: Sequence[str], overrides: Sequence[str]) -> list[str]:
    """The arguments of a command of Hydra, in which a file or folder without a key has the key that it is meant for.

    Args:
        name: of the command: train, evaluate or delay.
        arguments: all of them.
        overrides: those that are no flags.

    Raises:
        ConfigError: a file or folder does not exist, or is not what the command takes.

    >>> with_keys("train", ["-m", "align.dt=0.2,0.4"], ["align.dt=0.2,0.4"])
    ['-m', 'align.dt=0.2,0.4']
    >>> with_keys("evaluate", ["nowhere"], ["nowhere"])
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: runs: found 'nowhere', but there is no such folder: name one that `train` has written
    """
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


def hint_of_data(word: str) -> str:
    """What to do with a path that is no configuration of data: what it is, and the command for it.

    >>> hint_of_data("nowhere.yaml")
    ': correct the path, or let usvlearn inspect LOGS write one'
    """
    path, quoted = Path(word).expanduser(), shlex.quote(word)
    if not path.exists():
        return ": correct the path, or let usvlearn inspect LOGS write one"
    if (path / RUNS).exists() or (path / CHECKPOINTS).exists():
        return f", the folder of a run: to judge it: usvlearn evaluate {quoted}; to continue it: resume={quoted}"
    if any(path.glob(f"*/{RUNS}")):
        return f", a folder of runs: to judge them: usvlearn evaluate {quoted}"
    if path.suffix in SETS:
        return ", a file of a run: expected the configuration of logs, such as my_boat.yaml"
    inspect = f"first run usvlearn inspect {quoted}, which writes my_boat.yaml; then give my_boat.yaml"
    return f", expected the configuration of logs: {inspect}"


def without_key(word: str) -> str:
    """The folder of a run, also where a user writes `runs=FOLDER`, as for evaluate.

    >>> without_key("runs=outputs/heron")
    'outputs/heron'
    """
    for key in RUN_KEYS:
        word = word.removeprefix(key)
    return word
