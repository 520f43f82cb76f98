"""The command `usvlearn`, also `python -m usvlearn`: from any folder what train.py and evaluate.py do in a checkout."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Sequence

import usvlearn
from usvlearn.cli.commands import COMMANDS, begin
from usvlearn.errors import complain, drop_output

USAGE = "usage: usvlearn COMMAND ARGUMENTS, COMMAND --help or --version"


def main(arguments: Sequence[str] | None = None) -> int:
    """Hand the arguments to a command; returns the exit code.

    >>> main(["--version"])
    usvlearn 0.3.0
    0
    """
    try:
        code = _main(sys.argv[1:] if arguments is None else arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except BrokenPipeError:
        drop_output()
        return 0


def _main(arguments: Sequence[str]) -> int:
    name, *rest = arguments or ["--help"]
    if name in ("-h", "--help"):
        print(USAGE, "", *(f"  {each:12}{what}" for each, (_, what) in COMMANDS.items()), sep="\n")
        return 0
    if name == "--version":
        print("usvlearn", usvlearn.__version__)
        return 0
    if name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {close[0]}?" if close else "see usvlearn --help"
        complain(f"error: found the command {name!r}, expected one of {', '.join(COMMANDS)}: {hint}")
        return 2
    sys.argv = [f"usvlearn {name}", *rest]
    begin(name)
    try:
        return importlib.import_module(COMMANDS[name][0]).main() or 0
    except ModuleNotFoundError as error:
        if (package := (error.name or "").partition(".")[0]) in ("", "usvlearn", "certify"):
            raise
        complain(
            f"error: usvlearn {name} needs the package {package}, which is not installed (usvlearn-aboard leaves it "
            "out): use an environment where all of usvlearn is installed, by `pip install .`"
        )
        return 2


if __name__ == "__main__":
    sys.exit(main())
