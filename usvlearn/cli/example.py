"""The command `usvlearn example FOLDER`: logs of a simulated boat, to try everything on before there are own ones."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from usvlearn.cli.plain_command import out_folder
from usvlearn.core.checkpoint import write_atomically
from usvlearn.errors import ConfigError

USAGE = "usage: usvlearn example FOLDER [--minutes 10] [--seed 7]"


def parser() -> argparse.ArgumentParser:
    """The arguments of the command."""
    parser = argparse.ArgumentParser("usvlearn example", description=__doc__, allow_abbrev=False)
    parser.add_argument("folder", metavar="FOLDER", help="where the logs are written; is made if it does not exist")
    parser.add_argument("--minutes", type=float, default=10.0, help="length of each of the three missions (10)")
    parser.add_argument("--seed", type=int, default=7, help="of the boat and its missions (7)")
    return parser


def work(arguments: Sequence[str]) -> None:
    """Write the logs, and say what can be done with them."""
    from usvlearn.display import terminal
    from usvlearn.display.terminal import Activity

    given = parser().parse_args(arguments)
    folder = out_folder(given.folder, "FOLDER")
    with Activity(terminal.console(), "simulating"):
        from usvlearn.simulate.example_logs import example_logs

        texts = example_logs(given.minutes, given.seed)
    for name in texts:
        if (folder / name).exists():
            raise ConfigError(f"{folder / name}: found a log there already: choose another folder")
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    try:
        for name, text in texts.items():
            written.append(folder / name)
            write_atomically(written[-1], text.encode())
    except BaseException:  # Ctrl-C, too: some of the logs alone would be refused by the next call
        for path in written:
            path.unlink(missing_ok=True)
        raise
    next_one = f"a simulated boat; next: usvlearn inspect {shlex.quote(given.folder)} --name heron"
    terminal.show(*map(str, written), next_one)
