"""Where the configurations lie."""

from __future__ import annotations

from pathlib import Path

import usvlearn


def configs_folder() -> Path:
    """The folder configs/: in an installed package inside it, in a checkout beside it.

    >>> (configs_folder() / "train.yaml").is_file()
    True
    """
    package = Path(usvlearn.__file__).resolve().parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"
