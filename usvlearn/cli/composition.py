"""The configurations that come with usvlearn: where they are, and what they compose for a program in Python."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

import usvlearn
from usvlearn.cli.mistakes import in_one_sentence, known_names


def configs_folder() -> Path:
    """The folder configs/: in an installed package inside it, in a checkout beside it.

    >>> (configs_folder() / "train.yaml").is_file()
    True
    """
    package = Path(usvlearn.__file__).resolve().parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def composed(data: str, changes: Mapping[str, Any]) -> DictConfig:
    """What train.py composes for a data configuration, with some values replaced or added.

    Args:
        data: name of a file in configs/data.
        changes: values by key, mappings of them where keys are nested.

    Raises:
        ConfigError: there is no such file, or a value is none that YAML has.

    >>> composed("csv", {"vehicle": {"mass": 20.0}}).estimators.aid.mass
    20.0
    """
    configs = configs_folder()
    with in_one_sentence(known_names(configs, "train", [])):
        with initialize_config_dir(str(configs), version_base="1.3"):
            settings = compose("train", [f"data={data}"])
        OmegaConf.set_struct(settings, False)
        return OmegaConf.merge(settings, OmegaConf.create(dict(changes)))
