"""Files of configs/ are read once, which halves the time of a command that is refused."""

import copy
import os
from collections.abc import Iterator

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from omegaconf import OmegaConf

from tests.support import ROOT


@pytest.fixture(scope="package", autouse=True)
def read_once() -> Iterator[None]:
    """Each file, and the configuration without overrides, of which an error takes the nearest name."""
    load, compose, kept = OmegaConf.load, ConfigLoaderImpl.load_configuration, {}

    def once(key, make):
        if key not in kept:
            kept[key] = make()
        return copy.deepcopy(kept[key])

    def load_once(file):
        name = str(getattr(file, "name", ""))
        return once(name, lambda: load(file)) if name.startswith(f"{ROOT}/configs/") else load(file)

    def compose_once(self, config_name, overrides, *options, **named):
        def make():
            return compose(self, config_name, overrides, *options, **named)

        return (
            make()
            if overrides
            else once((os.getcwd(), config_name, str(self.config_search_path), options, *named.items()), make)
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(load_once))
        patch.setattr(ConfigLoaderImpl, "load_configuration", compose_once)
        yield
