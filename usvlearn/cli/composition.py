"""The configurations that come with usvlearn: where they are, and what they compose for a program in Python."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from usvlearn.cli.config_errors import in_one_sentence, known_names
from usvlearn.cli.configs import configs_folder
from usvlearn.cli.data_configs import with_data_files
from usvlearn.cli.settings import check_settings, instantiate
from usvlearn.logs.channels.channel import Recording


def recordings_of(data: str, changes: Mapping[str, Any]) -> tuple[Iterable[Recording], dict[str, Any]]:
    """The recordings that a data configuration describes, and all that train.py composes with it.

    Args:
        data: name of a file in configs/data, or the path of a file of one's own that ends in .yaml.
        changes: values by key, mappings of them where keys are nested, which replace those of the files or are added.

    Raises:
        ConfigError: there is no such file, or an option is outside its legal values.
        LogFormatError: no log can be read as it is described.

    >>> recordings, settings = recordings_of("simulated", {"data": {"hours": 0.1}, "vehicle": {"mass": 20.0}})
    >>> [recording.boat for recording in recordings], settings["estimators"]["aid"]["mass"]
    (['heron'], 20.0)
    """
    settings = compose_train([f"data={data}"], changes)
    return instantiate(settings.data), plain(settings)


def compose_train(overrides: Sequence[str], changes: Mapping[str, Any] | None = None) -> DictConfig:
    """The configuration of train.py with overrides, as on its command line, and changes, as of `recordings_of`."""
    configs = configs_folder()
    overrides = with_data_files(overrides)
    with in_one_sentence(known_names(configs, "train", overrides)):
        with initialize_config_dir(str(configs), version_base="1.3"):
            settings = compose("train", list(overrides))
        if changes:
            OmegaConf.set_struct(settings, False)
            settings.merge_with(OmegaConf.create(dict(changes)))
    check_settings(settings)
    return settings


def plain(cfg: Any) -> dict[str, Any]:
    """A configuration as dictionaries, lists and scalars, with its references resolved."""
    found = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}
