"""Loads `data=my_boat.yaml`, a file outside configs/, as `usvlearn inspect` writes it.

Hydra finds options of a group in the folders of its search path only. So the file is given to Hydra's store of
configurations under its absolute path, which the override then names.

Such a file may come from anybody: it must be plain data that names only classes of usvlearn. A folder that is given by
--config-dir may name any class.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from usvlearn.core.former_names import today
from usvlearn.core.safe_yaml import read_yaml
from usvlearn.core.unconfirmed import SECTION as UNCONFIRMED
from usvlearn.core.unconfirmed import questions_in
from usvlearn.errors import CheckpointError, ConfigError, did_you_mean
from usvlearn.logs.inspection.config_writer import hydra_text
from usvlearn.runs.files import CHECKPOINTS, RUNS
from usvlearn.runs.trust import check_settings

GROUP, SUFFIXES = "data", (".yaml", ".yml")
SECTIONS = ("data", "vehicle", "align")  # of such a file
OF_A_RUN = (".safetensors", ".json")  # the files in its folder


def with_data_files(overrides: Iterable[str]) -> list[str]:
    """The overrides, in which each file that `data=FILE.yaml` names is known to Hydra by its absolute path.

    A relative path would be found below configs/data, too, if there is a file of that name.
    """
    return [_known(each) for each in overrides]


def _known(override: str) -> str:
    key, _, given = override.partition("=")
    if key.lstrip("+") != GROUP or not any(suffix in given for suffix in SUFFIXES):
        return override
    try:
        value = OverridesParser.create().parse_override(override).value()
    except HydraException:
        return override  # Hydra reports it
    values = [str(getattr(each, "text", each)) for each in (value.list if isinstance(value, ChoiceSweep) else [value])]
    return f"{key}={','.join(map(_place, values))}"


def _place(value: str) -> str:
    """A value of the override: the absolute path of a file, quoted if need be; other values unchanged."""
    path = Path(value).expanduser()
    if not value.endswith(SUFFIXES) or (path.name == value and not path.is_file()):
        return value
    if not path.is_file():
        raise ConfigError(f"data: found {value!r}, but there is no such file: correct the path")
    _register(path := path.resolve())
    return hydra_text(str(path))


def _register(path: Path) -> None:
    try:
        content = read_yaml(GROUP, path)
        if asked := questions_in(content, path):
            content[UNCONFIRMED] = asked
        node = OmegaConf.create(today(content))
    except OmegaConfBaseException as error:
        raise ConfigError(f"data: {path}: {str(error).splitlines()[0]}: correct the file") from error
    if GROUP not in node:
        raise ConfigError(f"data: {path}: has no section data, expected what usvlearn inspect writes: name such a file")
    if wrong := [str(key) for key in node if key not in (*SECTIONS, UNCONFIRMED)]:
        hint = did_you_mean(wrong[0], SECTIONS)
        raise ConfigError(f"data: {path}: found {wrong[0]!r}, expected only {', '.join(SECTIONS)}{hint}")
    try:
        check_settings(f"data: {path}", OmegaConf.to_container(node))
    except CheckpointError as error:
        what = str(error).rpartition(": ")[0]
        raise ConfigError(f"{what}: if you trust it, put it into FOLDER/data and give --config-dir FOLDER") from error
    group = "/".join([GROUP, *path.parent.parts[1:]])
    ConfigStore.instance().store(group=group, name=path.name, node=node, package="_global_")


def hint_of_data(word: str) -> str:
    """What to do with a path that is no configuration of data: what it is, and the command for it."""
    path, quoted = Path(word).expanduser(), shlex.quote(word)
    if not path.exists():
        return ": correct the path, or let usvlearn inspect LOGS write one"
    if (path / RUNS).exists() or (path / CHECKPOINTS).exists():
        return f", the folder of a run: to judge it: usvlearn evaluate {quoted}; to continue it: resume={quoted}"
    if any(path.glob(f"*/{RUNS}")):
        return f", a folder of runs: to judge them: usvlearn evaluate {quoted}"
    if path.suffix in OF_A_RUN:
        return ", a file of a run: expected the configuration of logs, such as my_boat.yaml"
    inspect = f"first run usvlearn inspect {quoted}, which writes my_boat.yaml; then give my_boat.yaml"
    return f", expected the configuration of logs: {inspect}"
