"""A file of one's own in place of a name of configs/data: `data=my_boat.yaml`, as `usvlearn inspect` writes it.

Hydra finds options of a group in the folders of its search path only. So the file is given to Hydra's store of
configurations under the name that the override has, and each command that names it works, in a sweep, too.

Such a file may come from anybody: it must be plain data that names only classes of usvlearn. A folder that is given by
--config-dir may name any class.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.runs.trust import check_settings

GROUP, SUFFIXES = "data", (".yaml", ".yml")
PACKAGE = re.compile(r"^\s*#\s*@package\s+(\S+)", re.MULTILINE)


def register_data_files(overrides: Iterable[str]) -> None:
    """Give every file that an override `data=FILE.yaml` names to Hydra.

    Raises:
        ConfigError: there is no such file, or it is no legal YAML.

    >>> register_data_files(["data=nowhere/my_boat.yaml"])
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: data: found 'nowhere/my_boat.yaml', but there is no such file: correct the path
    """
    for value in _values(overrides):
        path = Path(value).expanduser()
        if path.is_file():
            _register(value, path)
        elif path.name != value:
            raise ConfigError(f"data: found {value!r}, but there is no such file: correct the path")


def _values(overrides: Iterable[str]) -> Iterator[str]:
    """The values of overrides of the group that name a file."""
    for each in overrides:
        if each.lstrip("+").partition("=")[0] != GROUP:
            continue
        try:
            value = OverridesParser.create().parse_override(each).value()
        except HydraException:
            continue  # it is reported when Hydra reads it
        for found in value.list if isinstance(value, ChoiceSweep) else [value]:
            if (text := str(getattr(found, "text", found))).endswith(SUFFIXES):
                yield text


def _register(value: str, path: Path) -> None:
    try:
        text = path.read_text(encoding="utf-8")
        node = OmegaConf.create(yaml.safe_load(text) or {})
    except UnicodeDecodeError as error:
        raise ConfigError(f"data: {path} is no text in UTF-8: name a file that usvlearn inspect wrote") from error
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        raise ConfigError(f"data: {path}{line}: is not legal YAML ({error.problem}): correct that line") from error
    except (OmegaConfBaseException, ValueError, yaml.YAMLError) as error:
        raise ConfigError(f"data: {path}: {str(error).splitlines()[0]}: correct the file") from error
    if not OmegaConf.is_dict(node):
        raise ConfigError(f"data: {path}: expected keys such as data and vehicle, found none: name another file")
    try:
        check_settings(f"data: {path}", OmegaConf.to_container(node))
    except CheckpointError as error:
        what = str(error).rpartition(": ")[0]
        raise ConfigError(f"{what}: if you trust it, put it into FOLDER/data and give --config-dir FOLDER") from error
    found = PACKAGE.search(text)
    package = found[1] if found else "_global_" if GROUP in node else None
    folders = [part for part in value.split("/")[:-1] if part]
    name = value.rpartition("/")[2]
    ConfigStore.instance().store(group="/".join([GROUP, *folders]), name=name, node=node, package=package)
