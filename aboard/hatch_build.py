"""Takes the packages from the folder above; from this one in a source distribution, which contains them."""

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class Packages(BuildHookInterface):
    """Adds usvlearn and certify to whatever is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by hatchling before it builds."""
        here = Path(self.root)
        for name in ("usvlearn", "certify"):
            folder = here / name if (here / name).is_dir() else here.parent / name
            build_data["force_include"][str(folder)] = name
