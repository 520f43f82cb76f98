"""The configurations that come with usvlearn: where they are, what they compose, its checks, the objects it describes.

What is heavy is imported where it is used, so that a mistake is told at once. Constructors check their values.
"""

from __future__ import annotations

import inspect
import pydoc
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import hydra
from hydra import compose, initialize_config_dir
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf

import usvlearn
from usvlearn.composition.data_files import with_data_files
from usvlearn.composition.errors import in_one_sentence, known_names
from usvlearn.core.former_names import today
from usvlearn.core.samples import LIMIT, speed_limit
from usvlearn.errors import ConfigError, UsvlearnError, check_positive, did_you_mean, under
from usvlearn.live.prior import with_limit
from usvlearn.logs.alignment.align import Aligner
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.checks.data_check import check_level

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble
    from usvlearn.estimators.planar.layer import Planar

SECTIONS = ("data", "estimators", "combiners", "align", "tuning")


def configs_folder() -> Path:
    """The folder configs/: in an installed package inside it, in a checkout beside it."""
    package = Path(usvlearn.__file__).resolve().parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def recordings_of(data: str, changes: Mapping[str, Any]) -> tuple[Iterable[Recording], dict[str, Any]]:
    """The recordings that a data configuration (a name, or a .yaml file) describes, and all that it composes."""
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
    container = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(container, dict)
    return {str(key): value for key, value in container.items()}


def check_settings(cfg: DictConfig) -> None:
    """Raise a ConfigError if a section of train.yaml is missing, or a value refers to itself or to a missing key."""
    given: Any = OmegaConf.to_container(cfg)
    for name in SECTIONS:
        if not isinstance(given.get(name), dict):
            value = repr(given[name]) if name in given else "nothing"
            raise ConfigError(f"{name}: found {value}, expected {name}.KEY=VALUE: leave out {name}=… or ~{name}")
    for name, node in given.items():
        if (named := today(node)) != node:
            given[name] = cfg[name] = named
    with in_one_sentence():
        settings: Any = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    check_level(settings.get("check"))
    options = [name for name in inspect.signature(Aligner).parameters if name != "channels"]
    for name in settings["align"]:
        if name not in options:
            hint = did_you_mean(f"align.{name}", [f"align.{each}" for each in options])
            raise ConfigError(f"align.{name}: found no such option, expected one of {', '.join(options)}{hint}")
    top = (settings.get("vehicle") or {}).get("surge_max")
    if isinstance(top, int | float) and speed_limit(top) > LIMIT:
        for name in ("align", "estimators", "combiners"):
            cfg[name] = with_limit(given[name], speed_limit(top))


def instantiate(node: Any, **options: Any) -> Any:
    """Make the objects that a node describes, like Hydra; an error begins with the full path of its key."""
    try:
        return hydra.utils.instantiate(node, **options)
    except InstantiationException as error:
        _retell(error, _names(OmegaConf.to_container(node) if OmegaConf.is_config(node) else node))


@contextmanager
def as_written(cfg: DictConfig) -> Iterator[None]:
    """A context in which an error about a key that only refers to another one names that one: a user has set it."""
    try:
        yield
    except UsvlearnError as error:
        key, colon, said = str(error).partition(": ")
        while (target := _reference(OmegaConf.to_container(cfg), key)) is not None:
            key = target
        error.args = (f"{key}{colon}{said}",)
        raise


def _reference(node: Any, key: str) -> str | None:
    """The key to which the value of another one refers as a whole."""
    for name in key.split("."):
        node = node.get(name) if isinstance(node, dict) else None
    match = re.fullmatch(r"\$\{([\w.]+)\}", node) if isinstance(node, str) else None
    return match[1] if match else None


def ensemble_of(cfg: Mapping[str, Any]) -> Ensemble:
    """The ensemble that a configuration describes, with its combiners, forecasts and intervals."""
    from usvlearn.estimators.ensemble.layer import Ensemble

    members, rules = instantiate(cfg["estimators"]), instantiate(cfg["combiners"], _convert_="all")
    settings = cfg.get("forecasts")
    ahead, knows = settings and instantiate(settings, _convert_="all"), bool(cfg.get("conditional", False))
    limit = speed_limit(check_positive("vehicle.surge_max", cfg["vehicle"]["surge_max"], "of m/s"))
    return Ensemble(members, rules, cfg["output"], surge_max=limit, forecasts=ahead, conditional=knows)


def planar_of(cfg: Mapping[str, Any], ensemble: Ensemble) -> tuple[Planar | None, str]:
    """The ensembles of sway and yaw rate beside that of the surge, which make tracks; or None, and why."""
    if not cfg.get("tracks"):
        return None, ""
    from usvlearn.estimators.planar.layer import Planar

    if not isinstance(cfg["tracks"], Mapping):
        raise ConfigError(f"tracks: found {cfg['tracks']!r}, expected horizons and overlap, or null: without tracks")
    given: dict[str, Any] = {
        str(name): list(x) if isinstance(x, ListConfig) else x for name, x in cfg["tracks"].items()
    }
    if unknown := [name for name in given if name not in ("horizons", "overlap")]:
        raise ConfigError(f"tracks.{unknown[0]}: found no such option, expected horizons or overlap, or tracks: null")
    with under("tracks", given):
        planar = Planar(ensemble, surge_max=cfg["vehicle"]["surge_max"], **given)
    try:
        planar.description()
    except ConfigError as error:
        return None, f"no tracks: {error} (tracks=null asks for none)"
    return planar, ""


def _retell(error: InstantiationException, names: set[str]) -> NoReturn:
    """Raise a constructor's own error about its arguments; an error that is a bug is raised unchanged."""
    text, cause = " ".join(str(error).split()), error.__cause__
    match, named = re.search(r"full_key: (\S+)", text), re.search(r"target '([^']+)'", text)
    key, target = match[1] if match else "", named[1] if named else ""
    place = f"{key}." if key else ""
    if isinstance(cause, UsvlearnError):
        with under(key, names):
            raise cause
    if argument := re.search(r"unexpected keyword argument '(\w+)'", str(cause)):
        called: Any = pydoc.locate(target)
        known = [f"{place}{name}" for name in inspect.signature(called).parameters]
        name = f"{place}{argument[1]}"
        raise ConfigError(f"{name}: {target} has no such argument{did_you_mean(name, known)}") from error
    if "Error locating target" in text:
        module, _, name = target.rpartition(".")
        hint = did_you_mean(name, vars(pydoc.locate(module) or type).keys())
        raise ConfigError(f"{place}_target_: found {target!r}, which cannot be imported{hint}") from error
    if isinstance(cause, TypeError | ValueError):
        raise ConfigError(f"{key or target}: {' '.join(str(cause).split())}: correct this key") from error
    if cause is not None:
        raise cause
    if "blocklisted" in text:
        raise ConfigError(f"{place}_target_: found {target!r}, which may not be called: name a class") from error
    raise ConfigError(f"{key or 'configuration'}: {str(error).splitlines()[0]}: correct this key") from error


def _names(node: Any) -> set[str]:
    """All keys of a tree."""
    children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else []
    return set(node if isinstance(node, dict) else []).union(*map(_names, children))
