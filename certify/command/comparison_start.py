"""The start of python -m certify compare: what it lacks is told before anything that takes long is imported."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence

from certify.errors import CertifyError


def start(arguments: Sequence[str], say: Callable) -> int:
    """Do what `certify.command.compare.main` does, whose arguments these are."""
    check_extras(arguments)
    from certify.display.printed import busy

    with busy("loading"):
        from certify.command.compare import main

    return main(arguments, say)


def check_extras(arguments: Sequence[str]) -> None:
    """Refuse a comparison for which packages are missing.

    Args:
        arguments: of `python -m certify compare`.

    Raises:
        CertifyError: a package is not installed.

    >>> check_extras(["--no-lmi"])
    """
    if {"-h", "--help"} & {*arguments}:
        return
    drawn = any(each.startswith(("--page", "--plot")) for each in arguments)
    needed = {"cvxpy": "lmi"} if "--no-lmi" not in arguments else {}
    needed |= {"matplotlib": "plot"} if drawn else {}
    missing = [package for package in needed if importlib.util.find_spec(package) is None]
    if missing:
        extras = ",".join(dict.fromkeys(needed[package] for package in missing))
        leave = ", or give --no-lmi" if "lmi" in extras else ""
        are = f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'}"
        raise CertifyError(f"compare: {are} not installed: run pip install 'usvlearn[{extras}]'{leave}")
