"""Reads YAML that may come from anybody: plain data, of bounded size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from usvlearn.errors import ConfigError

LARGEST = 1_000_000  # bytes
DEEPEST = 100  # levels: reading takes a time that grows with their square
OPENED = (
    yaml.FlowSequenceStartToken,
    yaml.FlowMappingStartToken,
    yaml.BlockSequenceStartToken,
    yaml.BlockMappingStartToken,
)
CLOSED = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken, yaml.BlockEndToken)


def has_alias(text: str) -> bool:
    """Whether YAML has an alias; a few of them can expand to gigabytes. A RecursionError if it is nested too deeply."""
    depth = 0
    for token in yaml.scan(text):
        if isinstance(token, yaml.AliasToken):
            return True
        depth += isinstance(token, OPENED) - isinstance(token, CLOSED)
        if depth > DEEPEST:
            raise RecursionError("it is nested too deeply")
    return False


def read_yaml(key: str, path: Path) -> dict[Any, Any]:
    """The content of the file that an option (`key`) names, as dictionaries, lists, scalars; {} if it is no mapping."""
    try:
        if path.stat().st_size > LARGEST:
            raise ConfigError(f"{key}: {path} has more than {LARGEST // 1000} kB: name a configuration")
        text = path.read_text(encoding="utf-8")
        if has_alias(text):
            raise ConfigError(
                f"{key}: {path}: has a YAML alias, which can expand to gigabytes: write out what it names"
            )
        content = yaml.safe_load(text)
    except OSError as error:
        raise ConfigError(f"{key}: {path} cannot be read ({error.strerror or error}): correct the path") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{key}: {path} is no text in UTF-8: name a file that usvlearn inspect wrote") from error
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f", line {error.problem_mark.line + 1}"
        raise ConfigError(f"{key}: {path}{line}: is not legal YAML ({error.problem}): correct that line") from error
    except RecursionError as error:
        raise ConfigError(f"{key}: {path}: is nested too deeply: name a configuration") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{key}: {path}: {str(error).splitlines()[0]}: correct the file") from error
    return content if isinstance(content, dict) else {}
