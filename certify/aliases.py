"""Modules that have moved can still be imported by the names that were documented before."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class Moved(MetaPathFinder, Loader):
    """Finds a module under its former name. Python asks it for the names that no file has.

    Args:
        names: former name -> the name of today.

    >>> sys.meta_path.append(Moved({"fractions_before": "fractions"}))
    >>> import fractions, fractions_before
    >>> fractions_before is fractions
    True
    """

    def __init__(self, names: Mapping[str, str]):
        self.names = names

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """What imports a module of the table; None for others."""
        return ModuleSpec(name, self) if name in self.names else None

    def create_module(self, spec: ModuleSpec) -> None:
        """Let Python make an empty module, which `exec_module` replaces."""

    def exec_module(self, module: ModuleType) -> None:
        """Put the module of today into the place of the empty one."""
        sys.modules[module.__name__] = importlib.import_module(self.names[module.__name__])
