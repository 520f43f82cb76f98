"""Turns errors of Hydra and OmegaConf into one sentence: key, found, expected, the nearest name."""

from __future__ import annotations

import re
import shlex
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    InterpolationKeyError,
    InterpolationResolutionError,
    OmegaConfBaseException,
)

from usvlearn.composition.data_files import hint_of_data
from usvlearn.core.unconfirmed import SECTION as UNCONFIRMED
from usvlearn.errors import ConfigError, did_you_mean

MEANT = {"lr": "rate", "learning_rate": "rate", "hidden": "neurons", "hidden_size": "neurons", "units": "neurons"}
KEY = re.compile(r"Could not (?:override|delete(?: from config\.)?) '([^']+)'|config group '([^']+)' does not exist")


@contextmanager
def in_one_sentence(names: Callable[[str], Iterable[str]] = lambda wrong: []) -> Iterator[None]:
    """Raise a ConfigError in place of an error of Hydra or OmegaConf about a command line or a file.

    `names` tells the existing keys and groups for a mistyped key.
    """
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(_sentence(error, names)) from error
    except yaml.MarkedYAMLError as error:
        place = "a file" if error.problem_mark is None else f"{error.problem_mark.name}:{error.problem_mark.line + 1}"
        raise ConfigError(f"{place}: is not legal YAML ({error.problem}): correct that line") from error
    except (ValueError, AssertionError) as error:
        where = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        if Path(hydra.__file__).parent not in where.parents:
            raise
        raise ConfigError(f"{_first_line(error)}: correct the command line") from error


def _sentence(error: Exception, names: Callable[[str], Iterable[str]]) -> str:
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    if isinstance(error, OverrideParseException):
        what = _first_line(error, but=("Error parsing", "See "))
        expected = "expected KEY=VALUE, with brackets and quotes closed"
        return f"{error.override}: cannot be read ({what}): {expected}{_in_quotes(str(error.override))}"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        if (given := error.missing_cfg_file.removeprefix("data/")) != error.missing_cfg_file:
            if Path(given).exists():
                return f"data: found {given!r}{hint_of_data(given)}"
            if given.endswith((".yaml", ".yml")):
                return f"data: found {given!r}, but there is no such file{hint_of_data(given)}"
        group, _, name = error.missing_cfg_file.rpartition("/")
        options = list(error.options or names(""))
        hint = did_you_mean(name, options)
        return f"{group or '--config-name'}: found {name!r}, expected one of {', '.join(sorted(options))}{hint}"
    if match := KEY.search(str(error)):
        key = match[1] or match[2]
        return f"{key}: found no such key{_instead_of(key, list(names(key)))}"
    if match := re.search(r"config directory '(.+?)'", str(error)):
        return f"{match[1]}: found no such folder: correct --config-dir or --config-path"
    if match := re.search(r"already at '([^']+)'|Multiple values for (\S+)\.", str(error)):
        return f"+{match[1] or match[2]}: found that key set already, expected a new one: leave out the +"
    if match := re.search(r"(?:argument|parameters) '(.+?)'", _first_line(error)):
        return f"{match[1]}: found several values: add -m for a sweep over them, or put a list into brackets"
    if isinstance(cause, OmegaConfBaseException):
        return _of_value(cause, error)
    return f"{_first_line(error)}: correct the command line or the file"


def _instead_of(key: str, every: Sequence[str]) -> str:
    """The key that was meant, or else those of the same section."""
    section, _, last = key.rpartition(".")
    meant = f"{section}.{MEANT.get(last, last)}"
    if meant not in every:
        close = did_you_mean(key, [each for each in every if each != section])
        if close or not section:
            return close or ": see the keys by --cfg job, or add a new one by +KEY=VALUE"
    beside = [
        each.removeprefix(f"{section}.") for each in every if each.rpartition(".")[0] == section and each[-1] != "_"
    ]
    return f"{f': did you mean {meant}?' * (meant in every) or ':'} {section} has {', '.join(beside)}"


def _in_quotes(override: str) -> str:
    """How to write an override whose value is a text with other signs than letters and digits, for a POSIX shell."""
    key, sign, value = override.partition("=")
    if not value or value[0] in "[{'\"":
        return ""
    written = shlex.quote('{}{}"{}"'.format(key, sign, value.replace('"', '\\"')))
    return f", and a text with brackets or other signs in quotes: {written}"


def _of_value(cause: OmegaConfBaseException, error: Exception) -> str:
    """The sentence for an illegal value of an existing key."""
    key = cause.full_key or "the configuration"
    if isinstance(cause, InterpolationKeyError):
        missing = re.search(r"'(.+?)'", _first_line(cause))
        name = missing[1] if missing else "a key"
        return f"{key}: refers to {name}, which does not exist: set that, or give {key} a value"
    if isinstance(cause, InterpolationResolutionError) and "Recursive" in str(cause):
        return f"{key}: refers to itself: give it a value"
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        return f"{key}: is missing: leave out the override that removes it, such as ~{key}"
    override = re.search(r"Error merging override (.+)", str(error))
    return f"{override[1] if override else key}: {_first_line(cause)}: correct this value"


def _first_line(error: BaseException, but: tuple[str, ...] = ()) -> str:
    lines = [line.strip() for line in str(error).splitlines()]
    return next((line for line in lines if line and not line.startswith(but or ("\0",))), type(error).__name__)


def known_names(
    configs: Path, name: str, overrides: Iterable[str], added: str | None = None
) -> Callable[[str], list[str]]:
    """A function from a mistyped name to the keys and groups that exist, given the other overrides; "": to files."""
    search = [] if added is None else [f"hydra.searchpath=['file://{Path(added).resolve()}']"]

    def find(wrong: str) -> list[str]:
        if not wrong:
            return [path.stem for path in configs.glob("*.yaml")]
        others = [each for each in overrides if not each.lstrip("+~").startswith(wrong)]
        for each in (others, []):
            try:
                with initialize_config_dir(str(configs.resolve()), version_base="1.3"):
                    cfg = compose(name, [*search, *each], return_hydra_config=True)
            except (HydraException, OmegaConfBaseException, ValueError):
                continue
            tree: Any = OmegaConf.to_container(cfg)
            tree.pop(UNCONFIRMED, None)
            return [*cfg.hydra.runtime.choices, *_dotted(tree)]
        return []

    return find


def _dotted(tree: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The dotted keys of a tree: align, align.dt, …"""
    for key, value in tree.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{prefix}{key}.")
