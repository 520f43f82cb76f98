"""What the pages of docs/reference list: everything behind `:::`."""

from __future__ import annotations

import functools
import importlib
import inspect
import re
from typing import Any, NamedTuple

import yaml
from site_hooks import with_families

from tests.support import ROOT

PAGES = sorted((ROOT / "docs" / "reference").glob("*.md"))


class Listed(NamedTuple):
    value: Any
    page: str
    members: Any  # the option: True, False or a list of names


@functools.cache
def blocks() -> dict[str, Listed]:
    """Everything behind `:::` by its name."""
    listed = {}
    for page in PAGES:
        for name, block in re.findall(r"^::: (\S+)((?:\n    .*)*)", with_families(page.read_text()), re.MULTILINE):
            options = (yaml.safe_load(block) or {}).get("options", {})
            listed[name] = Listed(load(name), page.stem, options.get("members", True))
    return listed


@functools.cache
def listed() -> dict[str, Listed]:
    """Every function and class behind `:::` by its name; those of a module in its place."""
    names: dict[str, Listed] = {}
    for name, (value, page, members) in blocks().items():
        if not inspect.ismodule(value):
            names[name] = Listed(value, page, members)
        elif members:
            inner = {f"{name}.{key}": each for key, each in vars(value).items() if not key.startswith("_")}
            names |= {
                path: Listed(each, page, True)
                for path, each in inner.items()
                if (inspect.isfunction(each) or inspect.isclass(each)) and each.__module__ == value.__name__
            }
    return names


def load(name: str) -> Any:
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            value = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        return functools.reduce(getattr, parts[count:], value)
    raise AssertionError(f"{name} is not there")
